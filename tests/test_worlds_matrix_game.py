"""The N-step matrix game."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.worlds import make_worlds


def matrix_game(num_agents=4, num_worlds=3, **settings):
    return make_worlds(TaskSettings(task='matrix_game', num_agents=num_agents, num_worlds=num_worlds, **settings))


def test_only_the_action_of_the_agent_whose_turn_it_is_counts():
    worlds = matrix_game()
    worlds.reset(seed=1, rollout=0)
    draw = np.random.default_rng(0)
    for step in range(8):
        actions = draw.integers(4, size=(3, 4))
        reward = worlds.step(actions).reward
        np.testing.assert_array_equal(reward, actions[:, step % 4] + 1 - 2.5)
        assert reward.dtype == np.float32


def test_agents_and_state_see_the_step_one_hot():
    worlds = matrix_game()
    assert (worlds.spec.observation_size, worlds.spec.state_size, worlds.spec.state_is_observations) == (4, 4, False)
    joint = worlds.reset(seed=1, rollout=0)
    for step in range(6):
        expected = np.eye(4, dtype=np.float32)[step % 4]
        np.testing.assert_array_equal(joint.observations, np.broadcast_to(expected, (3, 4, 4)))
        np.testing.assert_array_equal(joint.state, np.broadcast_to(expected, (3, 4)))
        assert (joint.episode_start == (step % 4 == 0)).all()
        joint = worlds.step(np.zeros((3, 4), dtype=np.int64)).next


def test_an_episode_terminates_when_every_agent_had_its_turn():
    worlds = matrix_game()
    worlds.reset(seed=1, rollout=0)
    ends = [worlds.step(np.zeros((3, 4), dtype=np.int64)) for _ in range(8)]
    assert [transition.terminated.all() for transition in ends] == [False, False, False, True] * 2
    assert not any(transition.truncated.any() for transition in ends)


def test_one_agent_plays_a_game_of_one_action():
    worlds = matrix_game(num_agents=1)
    worlds.reset(seed=1, rollout=0)
    transition = worlds.step(np.zeros((3, 1), dtype=np.int64))
    assert transition.terminated.all() and not transition.reward.any()


@pytest.mark.parametrize('settings, complaint', [
    ({'episode_steps': 5}, 'episode_steps must be at most num_agents = 4'),
    ({'observe_others': True}, 'observe_others'),
])
def test_settings_that_do_not_fit_the_game_are_refused(settings, complaint):
    with pytest.raises(SettingsError, match=complaint):
        matrix_game(**settings)
