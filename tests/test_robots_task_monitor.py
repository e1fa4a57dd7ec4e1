"""The task seen on robots from outside is the simulator's, bit for bit."""

import dataclasses

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.robots.geometry import TaskFrame
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.worlds import make_worlds

TASKS = [TaskSettings(task=task, num_agents=agents, observe_others=others, num_worlds=8)
         for task, agents, others in (('navigation', 3, False), ('navigation', 5, False), ('formation', 4, False),
                                      ('formation', 3, True), ('line', 4, True), ('line', 2, False))]


@pytest.mark.parametrize('task', TASKS, ids=lambda task: f'{task.task} {task.num_agents} {task.observe_others}')
def test_observations_state_and_reward_are_those_of_the_simulator(task):
    worlds, monitor = make_worlds(task), TaskMonitor(task)
    draw = np.random.default_rng(1)
    worlds.reset(3, 0)
    for _ in range(10):
        seen = worlds.step(draw.integers(5, size=(8, task.num_agents)))
        for world in range(8):
            sight = monitor.see(worlds.positions[world], worlds.velocities[world], worlds.landmarks[world])
            np.testing.assert_array_equal(sight.observations, seen.next.observations[world])
            np.testing.assert_array_equal(sight.state, seen.next.state[world])
            assert np.float32(sight.reward) == seen.reward[world]
            np.testing.assert_array_equal(monitor.targets, worlds.targets[world])


def test_a_sight_does_not_change_with_the_next_one():
    monitor = TaskMonitor(TaskSettings(num_agents=2))
    first = monitor.see(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)))
    kept = first.observations.copy()
    monitor.see(np.ones((2, 2)), np.ones((2, 2)), np.ones((2, 2)))
    np.testing.assert_array_equal(first.observations, kept)


def test_robots_that_live_at_another_scale_look_alike_to_the_policy():
    monitor, frame = TaskMonitor(TaskSettings(num_agents=3)), TaskFrame(scale=4.0, origin=(10.0, -3.0), slowness=2.0)
    draw = np.random.default_rng(2)
    positions, velocities, landmarks = draw.standard_normal((3, 3, 2))
    there = monitor.see(frame.positions(4.0 * positions + [10.0, -3.0]), frame.velocities(4.0 / 2.0 * velocities),
                        frame.positions(4.0 * landmarks + [10.0, -3.0]))
    here = monitor.see(positions, velocities, landmarks)
    np.testing.assert_allclose(there.observations, here.observations, atol=1e-6)
    assert there.reward == pytest.approx(here.reward)


def test_sizes_are_the_tasks():
    monitor = TaskMonitor(TaskSettings(task='line', num_agents=4, episode_steps=40))
    assert (monitor.num_landmarks, monitor.episode_steps, monitor.spec.num_agents) == (2, 40, 4)


@pytest.mark.parametrize('task', ['matrix_game', 'pettingzoo:mpe2.simple_spread_v3'])
def test_a_task_without_robots_in_the_plane_is_refused_by_name(task):
    with pytest.raises(SettingsError, match=f"'{task}' is not one of robots in the plane"):
        TaskMonitor(dataclasses.replace(TaskSettings(), task=task))


def test_a_wrong_number_of_robots_is_an_error():
    with pytest.raises(ValueError, match='where .* is needed'):
        TaskMonitor(TaskSettings(num_agents=3)).see(np.zeros((2, 2)), np.zeros((3, 2)), np.zeros((3, 2)))
