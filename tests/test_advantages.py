"""The fast recursions against the paper's definitions, summed by hand in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning import advantages


def rollout(steps, worlds, agents, seed, terminations=0.15, truncations=0.15):
    """A random rollout: rewards, values, values of what came after, ends, each [T, W]; expected rewards [T, W, N]."""
    random = np.random.default_rng(seed)
    terminated = random.random((steps, worlds)) < terminations
    truncated = ~terminated & (random.random((steps, worlds)) < truncations)
    rewards, values, cut_off = random.normal(0, 3, (3, steps, worlds))
    bootstrap = np.concatenate([values[1:], random.normal(0, 3, (1, worlds))])
    next_values = np.where(terminated, 0, np.where(truncated, cut_off, bootstrap))
    return rewards, values, next_values, terminated | truncated, random.normal(0, 3, (steps, worlds, agents))


def episode_from(t, ended):
    """The steps from t to the end of its episode, or of the rollout."""
    for step in range(t, len(ended)):
        yield step
        if ended[step]:
            return


def difference_advantages(rewards, values, next_values, ended, expected, beta, gamma, gae_lambda):
    """Eq. (18) as it is written: the discounted sum of r - beta^(l+1) E[r] + gamma V' - V over the episode's steps."""
    result = np.zeros(expected.shape)
    for t, world, agent in np.ndindex(*expected.shape):
        for l, step in enumerate(episode_from(t, ended[:, world])):
            delta = (rewards[step, world] - beta**(l + 1) * expected[step, world, agent]
                     + gamma * next_values[step, world] - values[step, world])
            result[t, world, agent] += (gamma * gae_lambda)**l * delta
    return result


def estimate(rewards, values, next_values, ended, expected, beta, gamma, gae_lambda):
    """The same by the functions under test."""
    team = gae(rewards, values, next_values, ended, gamma, gae_lambda)[..., None]
    baselines = advantages.credit_baselines(torch.tensor(expected), torch.tensor(1.0 - ended), beta, gamma, gae_lambda)
    return team - baselines.numpy()


def gae(rewards, values, next_values, ended, gamma, gae_lambda):
    tensors = map(torch.tensor, (rewards, values, next_values, 1.0 - ended))
    return advantages.generalized_advantages(*tensors, gamma, gae_lambda).numpy()


UNIT = strategies.one_of(strategies.sampled_from([0.0, 1.0]), strategies.floats(0, 1))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(steps=strategies.integers(1, 9), worlds=strategies.integers(1, 3), agents=strategies.integers(1, 4),
       seed=strategies.integers(0, 2**32), beta=UNIT, gamma=UNIT, gae_lambda=UNIT,
       ends=strategies.sampled_from([0, 0.15, 0.5]))
def test_the_recursions_are_eq_18_summed_by_hand(steps, worlds, agents, seed, beta, gamma, gae_lambda, ends):
    data = rollout(steps, worlds, agents, seed, ends, ends)
    np.testing.assert_allclose(estimate(*data, beta, gamma, gae_lambda),
                               difference_advantages(*data, beta, gamma, gae_lambda), rtol=1e-11, atol=1e-11)


def test_the_sum_by_hand_is_right_on_numbers_one_can_check():
    # Two steps of one episode, then one of the next. From the first: 1 - 0.5 * 4 + 0.5 * 20 - 10 = -1 now, and one step
    # on 2 - 0.5^2 * 8 + 0 - 20 = -20, halved.
    data = ([[1.0], [2.0], [3.0]], [[10.0], [20.0], [30.0]], [[20.0], [0.0], [40.0]], [[False], [True], [False]],
            [[[4.0]], [[8.0]], [[16.0]]])
    rewards, values, next_values, ended, expected = map(np.array, data)
    by_hand = [-1 + 0.5 * -20, 2 - 0.5 * 8 - 20, 3 - 0.5 * 16 + 0.5 * 40 - 30]
    for function in (difference_advantages, estimate):
        result = function(rewards, values, next_values, ended, expected, beta=0.5, gamma=0.5, gae_lambda=1.0)
        np.testing.assert_allclose(result.ravel(), by_hand)


def test_beta_0_is_gae_for_every_agent_whatever_the_reward_network_says():
    *data, expected = rollout(12, 4, 3, seed=1)
    team = gae(*data, 0.99, 0.95)
    for prediction in (expected, 1e6 * expected):
        estimated = estimate(*data, prediction, 0.0, 0.99, 0.95)
        np.testing.assert_array_equal(estimated, np.repeat(team[..., None], 3, axis=-1))


def test_beta_1_is_gae_on_difference_rewards():
    rewards, values, next_values, ended, expected = rollout(12, 4, 3, seed=2)
    estimated = estimate(rewards, values, next_values, ended, expected, 1.0, 0.99, 0.95)
    for agent in range(3):
        of_difference_rewards = gae(rewards - expected[..., agent], values, next_values, ended, 0.99, 0.95)
        np.testing.assert_allclose(estimated[..., agent], of_difference_rewards, rtol=1e-12, atol=1e-12)


def test_lambda_1_without_ends_is_the_discounted_return_less_the_value():
    rewards, values, next_values, ended, _ = rollout(10, 2, 1, seed=3, terminations=0, truncations=0)
    team = gae(rewards, values, next_values, ended, 0.9, 1.0)
    for t in range(10):
        discounts = 0.9**np.arange(10 - t)
        returns = discounts @ rewards[t:] + 0.9**(10 - t) * next_values[-1]
        np.testing.assert_allclose(team[t], returns - values[t], rtol=1e-12, atol=1e-12)


def test_nothing_passes_the_end_of_an_episode_backwards():
    rewards, values, next_values, ended, expected = rollout(8, 1, 2, seed=4, terminations=0, truncations=0)
    ended[4] = True
    before = estimate(rewards, values, next_values, ended, expected, 0.95, 0.99, 0.95)
    rewards[5:] += 7
    values[5:] -= 3
    next_values[5:] += 2
    expected[5:] *= 5
    after = estimate(rewards, values, next_values, ended, expected, 0.95, 0.99, 0.95)
    np.testing.assert_array_equal(after[:5], before[:5])
    assert (after[5:] != before[5:]).all()


def test_an_agent_s_baseline_is_its_own():
    rewards, values, next_values, ended, expected = rollout(8, 2, 3, seed=5)
    before = estimate(rewards, values, next_values, ended, expected, 0.95, 0.99, 0.95)
    expected[..., 1] += 1
    after = estimate(rewards, values, next_values, ended, expected, 0.95, 0.99, 0.95)
    np.testing.assert_array_equal(after[..., [0, 2]], before[..., [0, 2]])
    assert (after[..., 1] < before[..., 1]).all()


@pytest.mark.parametrize('shape', [(5,), (4, 3, 2)])
def test_the_expected_reward_is_the_mean_over_the_whole_distribution(shape):
    random = np.random.default_rng(6)
    predicted = random.normal(size=(*shape, 6))
    probabilities = random.dirichlet(np.ones(6), shape)
    expected = advantages.expected_rewards(torch.tensor(predicted), torch.tensor(probabilities)).numpy()
    assert expected.shape == shape
    for index in np.ndindex(*shape):
        assert expected[index] == pytest.approx(sum(p * r for p, r in zip(probabilities[index], predicted[index])))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32), scale=strategies.floats(1e-2, 1e4), shift=strategies.floats(-100, 100))
def test_normalised_advantages_have_mean_0_and_deviation_1_over_everything(seed, scale, shift):
    estimated = np.random.default_rng(seed).normal(shift, scale, (5, 4, 3))
    normalised = advantages.normalized(torch.tensor(estimated), None).numpy()
    by_hand = (estimated - estimated.mean()) / (estimated.std() + 1e-5)
    np.testing.assert_allclose(normalised, by_hand, rtol=1e-9, atol=1e-9)


def test_advantages_that_are_all_equal_are_normalised_to_zero():
    np.testing.assert_array_equal(advantages.normalized(torch.full((3, 2, 2), 5.0), None), np.zeros((3, 2, 2)))
