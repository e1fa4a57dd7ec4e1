"""Our simulator as robots: they start as the task says, obey commands within their limits, and do not run through each other."""

import math

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.robots.bodies import Bodies
from dae_ros.robots.geometry import TaskFrame
from dae_ros.robots.motion import Command, Limits
from dae_ros.robots.pace import PATIENCE, Pace
from dae_ros.worlds import make_worlds

LIMITS = Limits(0.5, 2.0, 1.0, 5.0)
FRAME = TaskFrame(scale=2.0, origin=(10.0, 0.0))


def bodies(differential=False, robots=3, frame=TaskFrame()):
    return Bodies(TaskSettings(num_agents=robots), frame, LIMITS, differential, seed=4)


def run(one, seconds, now=0.0, period=0.02):
    for index in range(round(seconds / period)):
        one.move(now + index * period, period)


@pytest.mark.parametrize('episode', [0, 3])
def test_robots_and_landmarks_begin_where_the_tasks_episode_does(episode):
    one, worlds = bodies(frame=FRAME), make_worlds(TaskSettings(num_worlds=1))
    one.place(episode)
    worlds.reset(4, episode)
    np.testing.assert_allclose(one.positions, 2.0 * worlds.positions[0] + [10.0, 0.0])
    np.testing.assert_allclose(one.landmarks, 2.0 * worlds.landmarks[0] + [10.0, 0.0])
    np.testing.assert_allclose(one.targets, one.landmarks)
    assert one.radius == 0.3 and not one.velocities.any()


def test_a_robot_moves_as_told_in_its_own_frame_and_no_faster_than_it_can():
    one = bodies(robots=1)
    start = one.positions[0].copy()
    one.headings[0] = math.pi / 2
    one.obey(0, Command(0.3, 0.2, 0.0), now=0.0)
    run(one, 0.4)
    np.testing.assert_allclose(one.positions[0] - start, [-0.08, 0.12])
    np.testing.assert_allclose(one.pose(0, 1.0).velocity, [-0.2, 0.3])
    one.obey(0, Command(30.0, 40.0, 5.0), now=0.0)
    run(one, 0.02)
    assert math.hypot(*one.velocities[0]) == pytest.approx(0.5) and one.turns[0] == 1.0


def test_a_differential_robot_does_not_move_sideways():
    one = bodies(differential=True, robots=1)
    one.obey(0, Command(0.0, 0.4, 0.0), now=0.0)
    run(one, 0.2)
    assert not one.velocities.any()


def test_a_robot_that_is_told_nothing_for_long_stands():
    one = bodies(robots=1)
    one.obey(0, Command(0.3, 0.0, 0.3), now=0.0)
    one.move(0.5, 0.02)
    assert one.velocities.any()
    one.move(0.52, 0.02)
    assert not one.velocities.any() and one.turns[0] == 0.0


def test_robots_that_meet_push_each_other_and_stay_apart():
    one = bodies(robots=2)
    one.positions = np.array([[-0.5, 0.0], [0.5, 0.0]])
    for now in np.arange(0.0, 4.0, 0.02):
        one.obey(0, Command(0.4, 0.0, 0.0), now)
        one.move(now, 0.02)
    assert np.ptp(one.positions[:, 0]) >= 2 * one.radius - 0.01 and one.positions[1, 0] > 0.6


def test_a_simulated_clock_waits_at_the_end_of_a_period_for_who_is_driven_and_was_not_told_anything_in_it():
    one = bodies(robots=2)
    pace = Pace(one, tick=0.05, control_period=0.1, factor=math.inf)
    assert pace.goes_on(1.05, 0.0)           # nobody is driven yet
    one.obey(0, Command(0.1, 0.0, 0.0), now=1.0)
    assert pace.goes_on(1.05, 0.0)           # told in this period
    assert pace.goes_on(1.10, 0.0)           # the next one goes on for another tick
    assert not pace.goes_on(1.15, 0.0) and not pace.goes_on(1.15, 0.9 * PATIENCE)
    one.obey(0, Command(0.1, 0.0, 0.0), now=1.15)
    assert pace.goes_on(1.15, 0.95 * PATIENCE)
    assert not pace.goes_on(1.25, 3.0) and pace.goes_on(1.25, 3.0 + PATIENCE)  # whom nobody drives any more
    assert pace.goes_on(1.85, 4.0)


def test_a_clock_that_ticks_once_a_period_waits_each_time_and_a_new_episode_changes_nothing_about_it():
    one = bodies(robots=1)
    pace = Pace(one, tick=0.1, control_period=0.1, factor=math.inf)
    one.obey(0, Command(0.1, 0.0, 0.0), now=2.4)
    assert pace.goes_on(2.4, 0.0) and not pace.goes_on(2.5, 0.0)
    one.place(1)
    assert not pace.goes_on(2.5, 0.01)


def test_a_clock_that_lost_time_makes_up_for_a_second_of_it_at_most_and_is_never_ahead():
    pace = Pace(bodies(), tick=0.1, control_period=0.1, factor=4.0)

    def moments(*when):
        return [pace.goes_on(1.0, real) for real in when]

    assert moments(7.0, 7.0, 7.01, 7.024, 7.03) == [True, False, False, True, False]  # each 25 ms, give or take a timer's jitter
    assert moments(*[7.2] * 10) == [True] * 7 + [False] * 3                           # it stood still for 150 ms and more
    assert sum(moments(*[90.0] * 100)) == 41                                          # for a minute, of which a second counts
