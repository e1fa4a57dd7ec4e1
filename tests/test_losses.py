"""The losses against their formulas, row by row in float64, and the gradients that clipping is there for."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning import losses

SHAPE = (4, 3, 2)
CASES = dict(seed=strategies.integers(0, 2**32), clip=strategies.floats(0, 1))


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def some_weights(seed, *shape):
    """Weights of which some are zero, as for filling."""
    random = np.random.default_rng(seed)
    return random.random(shape) * (random.random(shape) < 0.8)


def tensors(*arrays):
    return [torch.tensor(array) for array in arrays]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**CASES)
def test_the_policy_loss_is_the_negated_clipped_surrogate(seed, clip):
    log_ratio, advantages = 0.5 * normal(seed, *SHAPE), normal(seed + 1, *SHAPE)
    weights = some_weights(seed, *SHAPE)
    by_hand = 0.0
    for index in np.ndindex(*SHAPE):
        ratio = math.exp(log_ratio[index])
        clipped = min(max(ratio, 1 - clip), 1 + clip)
        by_hand -= weights[index] * min(ratio * advantages[index], clipped * advantages[index])
    loss = losses.policy_loss(*tensors(log_ratio, advantages, weights), clip)
    assert float(loss) == pytest.approx(by_hand, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize('ratio, advantage, pushed', [
    (1.0, 1.0, True), (1.0, -1.0, True), (1.5, 1.0, False), (0.5, -1.0, False), (1.5, -1.0, True), (0.5, 1.0, True)])
def test_a_ratio_is_pushed_no_further_out_of_the_clip_range_but_always_back(ratio, advantage, pushed):
    log_ratio = torch.tensor([math.log(ratio)], dtype=torch.float64, requires_grad=True)
    loss = losses.policy_loss(log_ratio, *tensors([advantage], [2.0]), 0.2)
    gradient, = torch.autograd.grad(loss, log_ratio)
    assert float(gradient) == pytest.approx(-2.0 * advantage * ratio if pushed else 0.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32), actions=strategies.integers(1, 6))
def test_the_entropy_bonus_is_the_weighted_entropy_of_each_distribution(seed, actions):
    probabilities = np.random.default_rng(seed).dirichlet(np.ones(actions), SHAPE)
    weights = some_weights(seed, *SHAPE)
    by_hand = sum(weights[index] * -sum(p * math.log(p) for p in probabilities[index] if p > 0)
                  for index in np.ndindex(*SHAPE))
    bonus = losses.entropy_bonus(*tensors(np.log(probabilities + 1e-300), weights))
    assert float(bonus) == pytest.approx(by_hand, rel=1e-9, abs=1e-9)


def test_the_entropy_of_a_uniform_choice_is_the_logarithm_of_the_number_of_actions():
    bonus = losses.entropy_bonus(torch.full((2, 5), math.log(0.2)), torch.tensor([0.5, 0.5]))
    assert float(bonus) == pytest.approx(math.log(5))


def huber(error, delta):
    return 0.5 * error**2 if abs(error) <= delta else delta * (abs(error) - 0.5 * delta)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**CASES, delta=strategies.floats(0.1, 10))
def test_the_value_loss_is_the_worse_huber_loss_of_moving_freely_and_within_the_clip_range(seed, clip, delta):
    values, old_values, targets = 3 * normal(seed, 3, *SHAPE)
    weights = some_weights(seed, *SHAPE)
    by_hand = 0.0
    for index in np.ndindex(*SHAPE):
        value, old, target = values[index], old_values[index], targets[index]
        near = old + min(max(value - old, -clip), clip)
        by_hand += weights[index] * max(huber(value - target, delta), huber(near - target, delta))
    loss = losses.value_loss(*tensors(values, old_values, targets, weights), clip, delta)
    assert float(loss) == pytest.approx(by_hand, rel=1e-11, abs=1e-11)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32))
def test_the_reward_loss_is_half_the_squared_error_of_the_action_taken(seed):
    predicted, rewards, weights = normal(seed, *SHAPE, 5), normal(seed + 1, *SHAPE[:2]), some_weights(seed, *SHAPE[:2])
    actions = np.random.default_rng(seed).integers(0, 5, SHAPE)
    by_hand = 0.0
    for t, world, agent in np.ndindex(*SHAPE):
        error = predicted[t, world, agent, actions[t, world, agent]] - rewards[t, world]
        by_hand += 0.5 * weights[t, world] * error**2
    loss = losses.reward_loss(*tensors(predicted, actions, rewards[..., None], weights[..., None]))
    assert float(loss) == pytest.approx(by_hand, rel=1e-11, abs=1e-11)


def losses_of(rows):
    """Every loss on some of eight rows."""
    values, old_values, targets, weights, *_ = tensors(*normal(1, 4, 8))
    log_probabilities, predicted = torch.log_softmax(torch.tensor(normal(2, 8, 5)), -1), torch.tensor(normal(3, 8, 5))
    actions = torch.arange(8) % 5
    return torch.stack([
        losses.policy_loss(values[rows], targets[rows], weights[rows], 0.2),
        losses.entropy_bonus(log_probabilities[rows], weights[rows]),
        losses.value_loss(values[rows], old_values[rows], targets[rows], weights[rows], 0.2, 10.0),
        losses.reward_loss(predicted[rows], actions[rows], targets[rows], weights[rows]),
    ])


def test_the_losses_of_shards_add_up_to_the_loss_of_the_batch():
    rows = torch.arange(8)
    torch.testing.assert_close(losses_of(rows[:3]) + losses_of(rows[3:7]) + losses_of(rows[7:]), losses_of(rows))
