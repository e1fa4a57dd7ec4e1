"""A robot moves only while everything it needs is there, and says why it stands; time is given, so this is exact."""

import math

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import Refused
from dae_ros.robots.geometry import Pose, TaskFrame
from dae_ros.robots.motion import STOP, Limits, Motion
from dae_ros.robots.pilot import Pilot, stamp_at
from dae_ros.robots.safety import Bounds, Safety, Stop
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.types import Action, Stamp

BOUNDS = Bounds(odometry_timeout=0.15, teammate_hold=1.0, action_timeout=0.25, jump_distance=0.2, jump_speed=5.0)
PERIOD = 0.1
LANDMARKS = np.array([[0.5, 0.0], [0.0, 0.5]])
EAST = 1


def pose(time, x=0.0, y=0.0, heading=0.0, velocity=(0.0, 0.0)):
    return Pose((x, y), heading, velocity, time)


def answer(observation, action=EAST):
    probabilities = np.full((1, 5), 0.2, np.float32)
    return Action(observation.stamp, observation.robot, 7, np.array([action], np.uint16), probabilities)


class Team:
    """Robot 0 of two, its pilot, and a clock."""

    def __init__(self, landmarks=LANDMARKS, enabled=True, go_on=False):
        self.safety = Safety(0, 2, BOUNDS, enabled, go_on)
        self.pilot = Pilot(0, 1, TaskMonitor(TaskSettings(num_agents=2)),
                           Motion(False, Limits(2.0, 5.0, 1.0, 1.0), TaskFrame()), TaskFrame(), PERIOD, self.safety)
        self.now = 100.0
        if landmarks is not None:
            self.pilot.on_landmarks(landmarks)

    def hear(self, *robots):
        for robot in robots:
            self.pilot.on_odometry(robot, pose(self.now, x=float(robot)), self.now)

    def step(self, *robots, answers=True):
        """One control period in which `robots` are heard; what was sent, and the command of the agent's answer."""
        self.now = round(self.now + PERIOD, 6)
        self.hear(*robots)
        turn = self.pilot.look(self.now)
        command = self.pilot.on_action(answer(turn.observation)) if turn.observation and answers else None
        return turn, command


def test_while_everything_is_there_each_period_has_one_observation_and_one_command():
    team = Team()
    for index in range(30):
        turn, command = team.step(0, 1)
        assert turn.command is None and command.forward > 0.0 and team.pilot.stop is None
        assert turn.observation.values.shape == (1, 12)
        for fraction in (0.25, 0.5, 0.75):
            assert team.pilot.look(team.now + fraction * PERIOD) == (None, None)


def test_the_observation_is_the_tasks_for_this_robot():
    team = Team()
    team.pilot.on_odometry(0, pose(100.05, x=1.0, y=2.0, velocity=(0.3, 0.4)), 100.1)
    team.pilot.on_odometry(1, pose(100.05, x=3.0, y=1.0), 100.1)
    values = team.pilot.look(100.1).observation.values[0]
    np.testing.assert_allclose(values[:10], [0.3, 0.4, 1, 2, -0.5, -2, -1, -1.5, 2, -1], atol=1e-6)


def test_steps_follow_the_clock_and_episodes_begin_together():
    stamps = [stamp_at(100.0 + 0.1 * index, PERIOD, 25, 9) for index in range(60)]
    assert [stamp.step for stamp in stamps] == [index % 25 for index in range(60)]
    assert [stamp.rollout for stamp in stamps] == [40 + index // 25 for index in range(60)]
    assert stamps[0] == Stamp(9, 40, 0, 0)
    team, starts = Team(), []
    for _ in range(60):
        turn, _ = team.step(0, 1)
        starts += [turn.observation.stamp.step] if turn.observation.episode_start[0] else []
    assert starts == [1, 0, 0]  # the first one is when the robot began to move


def test_a_robot_that_is_not_enabled_is_told_to_stand_once_and_left_alone():
    team = Team(enabled=False)
    turn, _ = team.step(0, 1)
    assert turn == (STOP, None) and team.pilot.stop == Stop('disabled', 'not enabled')
    for _ in range(5):
        assert team.step(0, 1) == ((None, None), None)
    team.pilot.enable(True)
    turn, command = team.step(0, 1)
    assert turn.observation.episode_start[0] and command.forward > 0.0
    team.pilot.enable(False)
    assert team.step(0, 1)[0] == (STOP, None)


def test_a_robot_whose_odometry_is_cut_stands_within_two_periods_and_moves_again_with_it():
    team = Team()
    for _ in range(5):
        team.step(0, 1)
    assert team.step(1)[0].command is None
    turn, _ = team.step(1)
    assert turn == (STOP, None)
    assert team.pilot.stop.reason == 'own_odometry' and '0.20 s old' in team.pilot.stop.detail
    assert team.step(1)[0] == (STOP, None)  # each period again, for whoever missed it
    turn, command = team.step(0, 1)
    assert turn.observation.episode_start[0] and 0.0 < command.forward <= 0.5


def test_within_a_period_a_stale_odometry_stops_the_robot_without_waiting_for_the_next():
    team = Team()
    team.step(0, 1)
    assert team.pilot.look(team.now + 0.14).command is None
    assert team.pilot.look(team.now + 0.16).command == STOP


def test_a_team_mates_last_position_holds_for_a_while_and_then_the_robot_stands():
    team = Team()
    for _ in range(3):
        team.step(0, 1)
    for _ in range(9):
        turn, command = team.step(0)
        assert command is not None and turn.observation.values[0, 8] == 1.0
    for _ in range(2):
        turn, _ = team.step(0)
    assert turn.command == STOP and team.pilot.stop.reason == 'teammate' and 'robot 1' in team.pilot.stop.detail
    assert team.step(0, 1)[1] is not None


@pytest.mark.parametrize('team, heard, reason', [(Team(landmarks=None), (0, 1), 'landmarks'), (Team(), (1,), 'own_odometry'),
                                                 (Team(), (0,), 'teammate'), (Team(enabled=False), (0, 1), 'disabled')])
def test_whatever_has_not_come_yet_keeps_the_robot_standing(team, heard, reason):
    for _ in range(3):
        turn, command = team.step(*heard)
        assert turn.observation is None and command is None and team.pilot.stop.reason == reason


def test_an_agent_that_falls_silent_stops_the_robot_which_goes_on_when_it_is_back():
    team = Team()
    team.step(0, 1)
    commands = [team.step(0, 1, answers=False)[0].command for _ in range(5)]
    assert commands == [None, None, None, STOP, STOP] and team.pilot.stop.reason == 'agent'
    turn, command = team.step(0, 1)
    assert turn.observation.episode_start[0] and command.forward > 0.0
    turn, _ = team.step(0, 1)
    assert turn == (None, turn.observation) and not turn.observation.episode_start[0] and team.pilot.stop is None


def test_other_landmarks_begin_an_episode():
    team = Team()
    team.step(0, 1)
    team.pilot.on_landmarks(LANDMARKS.copy())
    assert not team.step(0, 1)[0].observation.episode_start[0]
    team.pilot.on_landmarks(LANDMARKS + 1.0)
    assert team.step(0, 1)[0].observation.episode_start[0]


@pytest.mark.parametrize('wrong, reason', [
    (pose(100.3, x=math.nan), Refused.NOT_FINITE), (pose(100.3, velocity=(math.inf, 0.0)), Refused.NOT_FINITE),
    (pose(100.3, heading=math.nan), Refused.NOT_FINITE), (pose(100.3, x=1.3), Refused.JUMP),
    (pose(100.2), Refused.DUPLICATE), (pose(100.1), Refused.STALE), (pose(101.0), Refused.OUT_OF_RANGE)])
def test_odometry_that_cannot_be_right_is_refused_and_changes_nothing(wrong, reason):
    team = Team()
    team.step(0, 1)
    team.step(0, 1)
    with pytest.raises(Refused) as refused:
        team.pilot.on_odometry(0, wrong, 100.3)
    assert refused.value.reason == reason
    assert team.safety.tracks[0].pose == pose(team.now)


def test_a_robot_that_was_carried_away_is_believed_after_the_time_it_would_have_needed():
    team, believed = Team(), []
    team.step(0, 1)
    for _ in range(8):
        team.now += PERIOD
        try:
            team.pilot.on_odometry(0, pose(team.now, x=2.5), team.now)
        except Refused:
            believed.append(False)
        else:
            believed.append(True)
        team.pilot.look(team.now)
    assert believed == [False] * 4 + [True] * 4 and team.pilot.stop.reason != 'own_odometry'


def test_a_clock_that_was_set_back_begins_anew():
    team = Team()
    team.step(0, 1)
    team.now = 0.0
    team.step(0, 1)
    assert team.step(0, 1)[1] is not None


@pytest.mark.parametrize('landmarks, reason', [(np.zeros((3, 2)), Refused.WRONG_SHAPE),
                                               (np.array([[0, 0], [0, math.nan]]), Refused.NOT_FINITE)])
def test_landmarks_that_do_not_fit_are_refused(landmarks, reason):
    with pytest.raises(Refused) as refused:
        Team().pilot.on_landmarks(landmarks)
    assert refused.value.reason == reason


@pytest.mark.parametrize('change, reason', [
    ({'robot': 1}, Refused.WRONG_ROBOT), ({'stamp': Stamp(1, 40, 0, 0)}, Refused.STALE),
    ({'actions': np.array([5], np.uint16)}, Refused.OUT_OF_RANGE),
    ({'probabilities': np.full((1, 5), math.nan, np.float32)}, Refused.NOT_FINITE),
    ({'probabilities': np.full((1, 4), 0.25, np.float32)}, Refused.WRONG_SHAPE)])
def test_an_answer_no_honest_agent_gives_is_refused(change, reason):
    team = Team()
    turn, _ = team.step(0, 1, answers=False)
    with pytest.raises(Refused) as refused:
        team.pilot.on_action(answer(turn.observation)._replace(**change))
    assert refused.value.reason == reason


def test_an_answer_counts_once_and_not_after_a_stop():
    team = Team()
    turn, _ = team.step(0, 1, answers=False)
    team.pilot.on_action(answer(turn.observation))
    with pytest.raises(Refused):
        team.pilot.on_action(answer(turn.observation))
    turn, _ = team.step(0, 1, answers=False)
    team.pilot.enable(False)
    team.pilot.look(team.now + 0.01)
    with pytest.raises(Refused):
        team.pilot.on_action(answer(turn.observation))


def test_where_it_goes_on_without_lost_team_mates_it_has_met_all_of_them_once():
    team = Team(go_on=True)
    for _ in range(3):
        team.step(0)
    assert team.pilot.stop.reason == 'teammate' and 'has not come yet' in team.pilot.stop.detail
    team.step(0, 1)
    for _ in range(30):
        turn, command = team.step(0)
        assert command is not None and turn.observation.values[0, 8] == 1.0
    assert team.pilot.lost(team.now) == [1] and team.pilot.lost(team.now - 2.5) == []
    team.step(1)
    assert team.step(1)[0] == (STOP, None)  # its own odometry it cannot do without


def test_a_late_answer_counts_within_the_timeout_and_not_once_a_later_one_came():
    team = Team()
    first, second, third, fourth = (team.step(0, 1, answers=False)[0].observation for _ in range(4))
    assert [one.episode_start[0] for one in (first, second, third)] == [True, False, False]
    for late in (answer(first), answer(second)._replace(robot=1)):  # 0.3 s old
        with pytest.raises(Refused):
            team.pilot.on_action(late)
    assert team.pilot.stop.reason == 'agent'
    assert team.pilot.on_action(answer(third)).forward > 0.0
    with pytest.raises(Refused):
        team.pilot.on_action(answer(second))
    team.pilot.on_action(answer(fourth))
    turn, _ = team.step(0, 1)
    assert team.pilot.stop is None and not turn.observation.episode_start[0]
