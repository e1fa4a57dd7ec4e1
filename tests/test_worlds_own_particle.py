"""A particle task in a module of its own: simulated, seen on robots and trained like those of the package."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from dae_ros import config
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.rollout.in_process import train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds
from dae_ros.worlds.yardsticks import yardstick_returns

TASK = TaskSettings(task='particle:examples.escort', num_agents=4, num_worlds=8)
CORNERS = np.array([[0.4, 0.0], [-0.2, 0.12**0.5], [-0.2, -0.12**0.5]])  # of the guards' circle, from robot 0


def test_the_guards_in_their_places_around_robot_0_at_the_landmark_cost_nothing_and_each_distance_its_share():
    monitor, goal, still = TaskMonitor(TASK), np.array([0.3, -0.2]), np.zeros((4, 2))
    places = np.concatenate([goal[None], goal + CORNERS[[1, 2, 0]]])
    assert monitor.see(places, still, goal[None]).reward == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(sorted(monitor.targets.tolist()), sorted(places.tolist()))
    assert monitor.see(places, still, goal[None] + [[0.0, 0.5]]).reward == pytest.approx(-0.5)
    places[1] += CORNERS[1] / 0.4 * 0.3  # away from the circle
    assert monitor.see(places, still, goal[None]).reward == pytest.approx(-0.1)


def test_every_robot_sees_where_robot_0_is_from_it():
    worlds = make_worlds(TASK)
    for shown in (worlds.reset(1, 0), worlds.step(np.full((8, 4), 3)).next):
        expected = worlds.positions[:, :1] - worlds.positions
        np.testing.assert_allclose(shown.observations[:, :, -2:], expected, atol=1e-6)


def test_its_monitor_on_robots_sees_what_its_simulator_shows_bit_for_bit():
    worlds, monitor, draw = make_worlds(TASK), TaskMonitor(TASK), np.random.default_rng(1)
    worlds.reset(3, 0)
    for _ in range(10):
        seen = worlds.step(draw.integers(5, size=(8, 4)))
        for world in range(8):
            sight = monitor.see(worlds.positions[world], worlds.velocities[world], worlds.landmarks[world])
            np.testing.assert_array_equal(sight.observations, seen.next.observations[world])
            assert np.float32(sight.reward) == seen.reward[world]


def test_the_credit_of_its_actions_is_known_as_of_any_particle_task():
    worlds, draw = make_worlds(TASK), np.random.default_rng(2)
    worlds.reset(3, 0)
    actions = draw.integers(5, size=(8, 4))
    alternatives = worlds.alternative_rewards(actions)
    taken = np.take_along_axis(alternatives, actions[:, :, None], axis=2)[:, :, 0]
    np.testing.assert_array_equal(taken.astype(np.float32), np.repeat(worlds.step(actions).reward[:, None], 4, axis=1))


@pytest.mark.slow  # a training
def test_a_short_training_in_process_beats_the_untrained_teams(tmp_path):
    settings = config.from_flat({'task': TASK.task, 'num_agents': 3, 'num_worlds': 64, 'total_steps': 80_000, 'epochs': 5,
                                 'reward_network.epochs': 2, 'reward_network.hidden_size': 32, 'learning_rate': 2e-3,
                                 'evaluation_episodes': 64})
    worlds = make_worlds(settings.task)
    training = Training(settings, worlds.spec, RunFolder(tmp_path / 'run', settings))
    train(training, worlds, lambda: None)
    training.close()
    returns = yardstick_returns(settings.task, 64, seed=1)
    assert training.evaluation.mean() > max(returns['no-op'][0], returns['random'][0]) + 5.0, returns


@pytest.mark.parametrize('text, found', [
    ('', 'none'), ('from dae_ros.worlds.tasks import Line', 'none'),
    ('from dae_ros.worlds.particle import ParticleWorlds\nclass Mine(ParticleWorlds): pass', 'none'),
    ('from dae_ros.worlds.tasks import Line\nclass A(Line): pass\nclass B(Line): pass', 'A, B')])
def test_a_module_without_the_one_class_is_refused_with_those_it_has(text, found, tmp_path, monkeypatch):
    (tmp_path / 'a_module_of_mine.py').write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, 'a_module_of_mine', raising=False)
    with pytest.raises(WorldError, match=f'must have one class that derives from ParticleWorlds .* has {found}$'):
        make_worlds(TaskSettings(task='particle:a_module_of_mine'))


def test_a_module_that_is_not_there_and_a_team_without_a_guard_are_named():
    with pytest.raises(WorldError, match="cannot import 'nowhere.escort' .* correct the name after particle:"):
        make_worlds(TaskSettings(task='particle:nowhere.escort'))
    with pytest.raises(SettingsError, match='an escort needs a guard'):
        make_worlds(TaskSettings(task=TASK.task, num_agents=1))
