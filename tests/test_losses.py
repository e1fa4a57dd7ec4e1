"""The losses against their formulas, row by row in float64, and the gradients that clipping is there for."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning import losses

L, C, N, A = SHAPE = (4, 3, 2, 5)
CASES = dict(seed=strategies.integers(0, 2**32), clip=strategies.floats(0, 1))


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def some_weights(seed, *shape):
    """Weights of which some are zero, as for filling."""
    random = np.random.default_rng(seed)
    return random.random(shape) * (random.random(shape) < 0.8)


def some_actions(seed):
    return np.random.default_rng(seed).integers(0, A, (L, C, N))


def tensors(*arrays):
    return [torch.tensor(np.asarray(array)) for array in arrays]


def log_softmax(logits):
    return logits - np.log(np.exp(logits).sum(-1, keepdims=True))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**CASES, entropy_coefficient=strategies.floats(0, 1), share=strategies.sampled_from([1.0, 0.6]))
def test_the_policy_loss_is_the_negated_clipped_surrogate_less_the_entropy_bonus(seed, clip, entropy_coefficient, share):
    """Over all actions, or over a share of them that is available."""
    logits, advantages, actions = normal(seed, *SHAPE), normal(seed + 1, L, C, N), some_actions(seed)
    old, weights = normal(seed + 2, L, C, N) / 2 - math.log(A), some_weights(seed, L, C, N)
    available = np.random.default_rng(seed).random(SHAPE) < share
    np.put_along_axis(available, actions[..., None], True, -1)
    by_hand = np.zeros(4)
    for index in np.ndindex(L, C, N):
        log_probabilities = dict(zip(np.flatnonzero(available[index]), log_softmax(logits[index][available[index]])))
        log_ratio = log_probabilities[actions[index]] - old[index]
        ratio = math.exp(log_ratio)
        surrogate = min(ratio * advantages[index], min(max(ratio, 1 - clip), 1 + clip) * advantages[index])
        entropy = -sum(math.exp(log) * log for log in log_probabilities.values())
        by_hand += weights[index] * np.array([-surrogate, entropy, abs(ratio - 1) > clip, -log_ratio])
    loss = losses.PolicyLoss(*tensors(actions, old, advantages, weights), clip, entropy_coefficient,
                             None if available.all() else torch.tensor(available))
    differentiated, sums = loss(torch.tensor(logits))
    assert sums.tolist() == pytest.approx(by_hand, rel=1e-11, abs=1e-11)
    assert float(differentiated) == pytest.approx(by_hand[0] - entropy_coefficient * by_hand[1], rel=1e-11, abs=1e-11)
    assert len(sums) == len(loss.sums) and not sums.requires_grad


@pytest.mark.parametrize('ratio, advantage, pushed', [
    (1.0, 1.0, True), (1.0, -1.0, True), (1.5, 1.0, False), (0.5, -1.0, False), (1.5, -1.0, True), (0.5, 1.0, True)])
def test_a_ratio_is_pushed_no_further_out_of_the_clip_range_but_always_back(ratio, advantage, pushed):
    logits = torch.tensor([[[[0.3, -0.2, 1.0]]]], dtype=torch.float64, requires_grad=True)
    probabilities = torch.softmax(logits.detach(), -1).flatten()
    old = probabilities[1].log() - math.log(ratio)
    loss = losses.PolicyLoss(torch.tensor([[[1]]]), old.view(1, 1, 1), *tensors([[[advantage]]], [[[2.0]]]), 0.2, 0.0)
    gradient, = torch.autograd.grad(loss(logits)[0], logits)
    of_log_probability = -2.0 * advantage * ratio if pushed else 0.0
    expected = of_log_probability * (torch.tensor([0.0, 1.0, 0.0]) - probabilities)
    torch.testing.assert_close(gradient.flatten(), expected)


@pytest.mark.parametrize('entropy_coefficient', [0.0, 0.25])
def test_the_entropy_bonus_of_a_uniform_choice_is_the_logarithm_of_the_number_of_actions(entropy_coefficient):
    actions = torch.zeros(2, 1, 1, dtype=torch.int64)
    loss = losses.PolicyLoss(actions, torch.full((2, 1, 1), -math.log(5)), torch.zeros(2, 1, 1), torch.full((2, 1, 1), 0.5), 0.2,
                             entropy_coefficient)
    differentiated, (surrogate, entropy, clipped, divergence) = loss(torch.full((2, 1, 1, 5), 7.0))
    assert float(entropy) == pytest.approx(math.log(5))
    assert float(differentiated) == pytest.approx(-entropy_coefficient * math.log(5))
    assert surrogate == clipped == 0 and float(divergence) == pytest.approx(0, abs=1e-6)


def test_the_entropy_bonus_pushes_towards_a_uniform_choice_and_not_without_its_coefficient():
    logits = torch.tensor(normal(1, *SHAPE), requires_grad=True)
    loss = losses.PolicyLoss(*tensors(some_actions(1), np.zeros((L, C, N)), np.zeros((L, C, N)), np.ones((L, C, N))), 0.2, 0.5)
    gradient, = torch.autograd.grad(loss(logits)[0], logits)
    with torch.no_grad():
        assert loss(logits - 0.1 * gradient)[1][1] > loss(logits)[1][1] + 0.01
    assert not torch.autograd.grad(loss._replace(entropy_coefficient=0.0)(logits)[0], logits)[0].any()


def test_what_cannot_be_chosen_pushes_nothing_and_is_not_pushed():
    logits, actions = normal(1, *SHAPE), some_actions(1)
    available = np.ones(SHAPE, bool)
    available[..., 1] = actions == 1
    loss = losses.PolicyLoss(*tensors(actions, normal(2, L, C, N), normal(3, L, C, N), np.ones((L, C, N))), 0.2, 0.5,
                             torch.tensor(available))
    found = []
    for score in (-50.0, 0.0, 50.0):
        x = torch.tensor(np.where(available, logits, score), requires_grad=True)
        found.append((loss(x)[1], *torch.autograd.grad(loss(x)[0], x)))
        assert not found[-1][1][~torch.tensor(available)].any()
    for sums, gradient in found[1:]:
        assert torch.equal(sums, found[0][0]) and torch.equal(gradient, found[0][1])


def huber(error, delta):
    return 0.5 * error**2 if abs(error) <= delta else delta * (abs(error) - 0.5 * delta)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**CASES, delta=strategies.floats(0.1, 10), coefficient=strategies.floats(0, 2))
def test_the_value_loss_is_the_worse_huber_loss_of_moving_freely_and_within_the_clip_range(seed, clip, delta, coefficient):
    values, old_values, targets = 3 * normal(seed, 3, L, C)
    weights = some_weights(seed, L, C)
    by_hand = 0.0
    for index in np.ndindex(L, C):
        value, old, target = values[index], old_values[index], targets[index]
        near = old + min(max(value - old, -clip), clip)
        by_hand += weights[index] * max(huber(value - target, delta), huber(near - target, delta))
    loss = losses.ValueLoss(*tensors(old_values, targets, weights), clip, delta, coefficient)
    differentiated, sums = loss(torch.tensor(values)[..., None, None])
    assert sums.tolist() == pytest.approx([by_hand], rel=1e-11, abs=1e-11)
    assert float(differentiated) == pytest.approx(coefficient * by_hand, rel=1e-11, abs=1e-11)
    assert len(sums) == len(loss.sums) and not sums.requires_grad


@pytest.mark.parametrize('value, target, pushed', [
    (0.1, 1.0, -0.9), (0.1, -1.0, 1.0), (0.5, 1.0, 0.0), (-0.5, -1.0, 0.0), (0.5, -1.0, 1.0), (-0.5, 1.0, -1.0)])
def test_a_value_is_pushed_no_further_out_of_the_clip_range_but_always_back_and_by_delta_at_most(value, target, pushed):
    """From an old value of 0, with a clip of 0.2 and a delta of 1."""
    values = torch.tensor([[[[value]]]], dtype=torch.float64, requires_grad=True)
    loss = losses.ValueLoss(*tensors([[0.0]], [[target]], [[2.0]]), 0.2, 1.0, 0.5)
    gradient, = torch.autograd.grad(loss(values)[0], values)
    assert float(gradient) == pytest.approx(2.0 * 0.5 * pushed)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32))
def test_the_reward_loss_is_half_the_squared_error_of_the_action_taken(seed):
    predicted, rewards, weights = normal(seed, *SHAPE), normal(seed + 1, L, C), some_weights(seed, L, C, N)
    actions = some_actions(seed)
    by_hand = 0.0
    for t, world, agent in np.ndindex(L, C, N):
        error = predicted[t, world, agent, actions[t, world, agent]] - rewards[t, world]
        by_hand += 0.5 * weights[t, world, agent] * error**2
    loss = losses.RewardLoss(*tensors(actions, rewards, weights))
    differentiated, sums = loss(torch.tensor(predicted))
    assert float(differentiated) == pytest.approx(by_hand, rel=1e-11, abs=1e-11)
    assert sums.tolist() == [float(differentiated)]
    assert len(sums) == len(loss.sums) and not sums.requires_grad


def losses_of(columns):
    """Every loss, what is differentiated and its sums, of some of eight columns."""
    random = np.random.default_rng(1)
    logits, actions = random.normal(size=(L, 8, N, A)), random.integers(0, A, (L, 8, N))
    parts = logits, actions, *random.normal(size=(3, L, 8, N)), *random.normal(size=(3, L, 8))
    logits, actions, old, advantages, weights, values, old_values, targets = (part[:, columns] for part in tensors(*parts))
    found = [losses.PolicyLoss(actions, old, advantages, weights, 0.2, 0.3)(logits),
             losses.ValueLoss(old_values, targets, weights[..., 0], 0.2, 1.0, 0.5)(values[..., None]),
             losses.RewardLoss(actions, targets, weights)(logits)]
    return torch.cat([torch.cat([differentiated.view(1), sums]) for differentiated, sums in found])


def test_the_losses_of_shards_add_up_to_the_loss_of_the_batch():
    columns = torch.arange(8)
    torch.testing.assert_close(losses_of(columns[:3]) + losses_of(columns[3:7]) + losses_of(columns[7:]), losses_of(columns))


def test_a_loss_of_nothing_is_zero():
    assert not losses_of(torch.arange(0)).any()
