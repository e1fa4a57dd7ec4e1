"""The running normaliser of the value targets against its definition."""

import math

import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning.value_norm import DECAY, ValueNormalizer


def targets(seed, mean=3.0, deviation=2.0):
    return mean + deviation * torch.randn(6, 4, generator=torch.Generator().manual_seed(seed))


def normalizer_after(batches):
    normalizer = ValueNormalizer()
    for batch in batches:
        normalizer.update(batch)
    return normalizer


def test_before_any_target_values_are_left_as_they_are():
    values = targets(1)
    assert torch.equal(ValueNormalizer().normalize(values), values)
    assert torch.equal(ValueNormalizer().denormalize(values), values)


def test_after_one_rollout_its_targets_have_mean_0_and_deviation_1():
    batch = targets(1, mean=-170.0, deviation=30.0)
    normalized = normalizer_after([batch]).normalize(batch)
    assert float(normalized.mean()) == pytest.approx(0, abs=1e-5)
    assert float(normalized.std(correction=0)) == pytest.approx(1, abs=1e-5)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds=strategies.lists(strategies.integers(0, 100), min_size=1, max_size=8))
def test_older_rollouts_fade_by_the_decay_and_the_weights_sum_to_1(seeds):
    batches = [targets(seed, mean=seed, deviation=1 + seed % 3).double() for seed in seeds]
    weights = [DECAY**age for age in reversed(range(len(batches)))]
    mean = sum(weight * batch.mean() for weight, batch in zip(weights, batches)) / sum(weights)
    mean_square = sum(weight * batch.square().mean() for weight, batch in zip(weights, batches)) / sum(weights)
    values = torch.linspace(-50, 50, 7, dtype=torch.float64)
    normalized = normalizer_after(batches).normalize(values)
    torch.testing.assert_close(normalized, (values - mean) / (mean_square - mean**2).sqrt(), rtol=1e-8, atol=1e-8)


def test_the_decay_is_that_of_the_paper_s_authors():
    assert DECAY == 0.99999


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seeds=strategies.lists(strategies.integers(0, 100), max_size=4))
def test_denormalising_undoes_normalising(seeds):
    normalizer = normalizer_after([targets(seed) for seed in seeds])
    values = torch.linspace(-30, 30, 9, dtype=torch.float64)
    torch.testing.assert_close(normalizer.denormalize(normalizer.normalize(values)), values)
    torch.testing.assert_close(normalizer.normalize(normalizer.denormalize(values)), values)


def test_targets_that_are_all_equal_are_not_divided_by_nothing():
    normalizer = normalizer_after([torch.full((3, 2), 5.0)] * 3)
    normalized = normalizer.normalize(torch.tensor([5.0, 5.1], dtype=torch.float64))
    assert normalized.tolist() == pytest.approx([0.0, 1.0], abs=1e-6)  # no deviation below 0.1 is believed


def test_targets_far_from_zero_are_normalised_as_finely_as_others():
    batch = targets(1, mean=20_000.0, deviation=0.5)
    normalized = normalizer_after([batch]).normalize(batch.double())
    assert float(normalized.std(correction=0)) == pytest.approx(1, abs=1e-3)


def test_values_keep_their_shape_and_type():
    normalizer = normalizer_after([targets(1)])
    for change in (normalizer.normalize, normalizer.denormalize):
        changed = change(targets(2))
        assert changed.shape == (6, 4) and changed.dtype == torch.float32


def test_a_normaliser_goes_on_from_its_state_bit_for_bit():
    one = normalizer_after([targets(1), targets(2)])
    other = ValueNormalizer()
    other.load_state(one.state())
    for normalizer in (one, other):
        normalizer.update(targets(3))
    assert torch.equal(one.state(), other.state()) and one.state().dtype == torch.float64
    assert torch.equal(one.normalize(targets(4)), other.normalize(targets(4)))
    assert all(math.isfinite(value) for value in one.state().tolist())
