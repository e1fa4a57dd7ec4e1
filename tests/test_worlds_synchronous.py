"""What all built-in tasks share: when a reward is paid, and what the actions not taken would have brought."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.worlds import BUILT_IN, make_worlds

NUM_STEPS = 20  # three episodes of 6 steps, and the beginning of a fourth
TASKS = pytest.mark.parametrize('task', BUILT_IN)


def six_steps(task, num_agents=6, num_worlds=4, **settings):
    return make_worlds(TaskSettings(task=task, num_agents=num_agents, num_worlds=num_worlds, episode_steps=6, **settings))


def random_actions(worlds):
    shape = (NUM_STEPS, worlds.num_worlds, worlds.spec.num_agents)
    return np.random.default_rng(0).integers(worlds.spec.num_actions, size=shape)


def rollout(worlds, seed=1):
    """Rewards [T, W] and everything else that the worlds showed."""
    shown = list(worlds.reset(seed, rollout=0))
    rewards = []
    for actions in random_actions(worlds):
        reward, *flags, joint = worlds.step(actions)
        rewards.append(reward)
        shown += [*flags, *joint]
    return np.array(rewards), shown


@TASKS
@pytest.mark.parametrize('delay', [0, 1, 4])
def test_a_reward_is_paid_so_many_steps_after_the_action_that_earned_it(task, delay):
    earned, _ = rollout(six_steps(task))
    paid, _ = rollout(six_steps(task, reward_delay=delay))
    for begin in (0, 6, 12):
        assert not paid[begin:begin + delay].any()
        np.testing.assert_array_equal(paid[begin + delay:begin + 5], earned[begin:begin + 5 - delay])
    np.testing.assert_array_equal(paid[18 + delay:], earned[18:NUM_STEPS - delay])


@TASKS
@pytest.mark.parametrize('delay', [1, 4, 5, 6, 1000])
def test_a_delay_changes_neither_the_return_of_an_episode_nor_anything_else_that_is_seen(task, delay):
    earned, shown = rollout(six_steps(task))
    paid, shown_with_delay = rollout(six_steps(task, reward_delay=delay))
    returns, expected = (rewards[:18].reshape(3, 6, -1).sum(axis=1, dtype=np.float64) for rewards in (paid, earned))
    np.testing.assert_allclose(returns, expected, rtol=1e-6, atol=1e-5)
    for ours, without_delay in zip(shown_with_delay, shown, strict=True):
        np.testing.assert_array_equal(ours, without_delay)


@TASKS
def test_what_is_owed_when_a_rollout_is_begun_anew_is_forgotten(task):
    worlds = six_steps(task, reward_delay=3)
    first, _ = rollout(worlds)
    np.testing.assert_array_equal(rollout(worlds)[0], first)
