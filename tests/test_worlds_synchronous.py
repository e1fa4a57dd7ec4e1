"""What all built-in tasks share: when a reward is paid, and what the actions not taken would have brought."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import WorldError
from dae_ros.worlds import BUILT_IN, make_worlds

NUM_STEPS = 20  # three episodes of 6 steps, and the beginning of a fourth
TASKS = pytest.mark.parametrize('task', BUILT_IN)


def six_steps(task, num_agents=6, num_worlds=4, **settings):
    return make_worlds(TaskSettings(task=task, num_agents=num_agents, num_worlds=num_worlds, episode_steps=6, **settings))


def random_actions(worlds):
    shape = (NUM_STEPS, worlds.num_worlds, worlds.spec.num_agents)
    return np.random.default_rng(0).integers(worlds.spec.num_actions, size=shape)


def there(joint):
    """What is shown, without flags that these tasks do not have."""
    return [part for part in joint if part is not None]


def rollout(worlds, seed=1):
    """Rewards [T, W] and everything else that the worlds showed."""
    shown = [*there(worlds.reset(seed, rollout=0))]
    rewards = []
    for actions in random_actions(worlds):
        transition = worlds.step(actions)
        rewards.append(transition.reward)
        shown += [transition.terminated, transition.truncated, transition.final_states, *there(transition.next)]
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


@TASKS
@pytest.mark.parametrize('delay', [0, 2])
@pytest.mark.parametrize('num_agents', [1, 6])
def test_an_alternative_reward_is_what_the_step_pays_with_that_action_instead(task, delay, num_agents):
    settings = {'num_agents': num_agents, 'episode_steps': min(num_agents, 4), 'num_worlds': 3, 'reward_delay': delay}
    worlds, twin = (make_worlds(TaskSettings(task=task, **settings)) for _ in range(2))
    worlds.reset(seed=1, rollout=0)
    taken = random_actions(worlds)[:5]
    for step, actions in enumerate(taken):
        rewards = worlds.alternative_rewards(actions)
        assert rewards.shape == (3, num_agents, worlds.spec.num_actions) and rewards.dtype == np.float64
        for agent in range(num_agents):
            for action in range(worlds.spec.num_actions):
                twin.reset(seed=1, rollout=0)
                for earlier in taken[:step]:
                    twin.step(earlier)
                changed = actions.copy()
                changed[:, agent] = action
                np.testing.assert_array_equal(rewards[:, agent, action].astype(np.float32), twin.step(changed).reward)
        worlds.step(actions)


@TASKS
def test_an_action_bears_on_a_delayed_reward_only_at_the_last_step_of_the_episode(task):
    worlds = six_steps(task, reward_delay=2)
    worlds.reset(seed=1, rollout=0)
    for step, actions in enumerate(random_actions(worlds)):
        spread = np.ptp(worlds.alternative_rewards(actions), axis=-1)
        assert spread.any() == (step % 6 == 5)
        worlds.step(actions)


@TASKS
@pytest.mark.parametrize('delay', [0, 2])
def test_asking_for_alternative_rewards_changes_nothing(task, delay):
    class Asked:
        """Worlds that are asked before every step."""

        def __init__(self):
            self.worlds = six_steps(task, reward_delay=delay)
            self.reset, self.spec, self.num_worlds = self.worlds.reset, self.worlds.spec, self.worlds.num_worlds

        def step(self, actions):
            self.worlds.alternative_rewards(actions)[:] = np.nan
            return self.worlds.step(actions)

    rewards, shown = rollout(Asked())
    expected, expected_shown = rollout(six_steps(task, reward_delay=delay))
    np.testing.assert_array_equal(rewards, expected)
    for ours, without_asking in zip(shown, expected_shown, strict=True):
        np.testing.assert_array_equal(ours, without_asking)


def test_alternative_rewards_need_a_reset_and_actions_as_a_step_does():
    worlds = six_steps('navigation')
    with pytest.raises(WorldError, match='reset'):
        worlds.alternative_rewards(np.zeros((4, 6), dtype=np.int64))
    worlds.reset(seed=1, rollout=0)
    with pytest.raises(ValueError, match=r'0 \.\. 4, not 5'):
        worlds.alternative_rewards(np.full((4, 6), 5))
