"""Cutting a rollout into chunks and shards: nothing lost, nothing doubled, and filling that counts for nothing."""

import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning import losses
from dae_ros.learning.chunks import first_states, shard_bounds, to_chunks

SIZES = {'steps': strategies.integers(1, 12), 'worlds': strategies.integers(1, 6), 'length': strategies.integers(1, 15)}


def numbered(steps, worlds, *more):
    """A rollout whose every entry is its own number, from 1: no two are equal and none is the filling's 0."""
    count = steps * worlds * int(torch.tensor(more).prod()) if more else steps * worlds
    return torch.arange(1, count + 1).view(steps, worlds, *more)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(**SIZES, more=strategies.sampled_from([(), (1,), (3, 2)]))
def test_chunks_hold_every_entry_once_and_filling_only_at_the_very_end(steps, worlds, length, more):
    sequences = numbered(steps, worlds, *more)
    chunks = to_chunks(sequences, length)
    count = -(-steps * worlds // length)
    assert chunks.shape == (length, count, *more)
    entries = chunks.transpose(0, 1).reshape(length * count, -1)
    real, filling = entries[:steps * worlds], entries[steps * worlds:]
    assert torch.equal(real.sort(0).values, sequences.reshape(steps * worlds, -1).sort(0).values)
    assert (filling == 0).all() and len(filling) < length


@settings(max_examples=100, deadline=None, derandomize=True)
@given(**SIZES)
def test_a_chunk_is_consecutive_steps_of_a_world_and_then_of_the_next(steps, worlds, length):
    sequences = numbered(steps, worlds)
    chunks = to_chunks(sequences, length)
    for position in range(steps * worlds):
        world, step = divmod(position, steps)
        assert chunks[position % length, position // length] == sequences[step, world]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(**SIZES, more=strategies.sampled_from([(), (3, 2)]))
def test_a_chunk_begins_with_the_state_after_the_step_before_it_and_a_world_with_zero(steps, worlds, length, more):
    states = numbered(steps, worlds, *more)
    first = first_states(states, length)
    assert first.shape == (-(-steps * worlds // length), *more)
    for chunk in range(len(first)):
        world, step = divmod(chunk * length, steps)
        assert torch.equal(first[chunk], states[step - 1, world] if step else torch.zeros_like(states[0, 0]))


def test_flags_are_cut_like_numbers():
    flags = torch.tensor([[True, False], [True, True], [False, True]])
    chunks = to_chunks(flags, 4)
    assert chunks.dtype == torch.bool
    assert chunks.t().tolist() == [[True, True, False, False], [True, True, False, False]]


@pytest.mark.parametrize('length', [1, 4, 7, 100])
def test_filling_of_weight_0_changes_neither_loss_nor_gradient(length):
    generator = torch.Generator().manual_seed(1)
    values, old_values, targets = torch.randn(3, 7, 3, generator=generator, dtype=torch.float64)
    values.requires_grad_()
    weights = torch.ones(7, 3, dtype=torch.float64)

    def loss(cut):
        value_loss = losses.ValueLoss(cut(old_values), cut(targets), cut(weights), 0.2, 10.0, 0.5)
        return value_loss(cut(values)[..., None])

    (cut, cut_sums), (whole, whole_sums) = loss(lambda part: to_chunks(part, length)), loss(lambda part: part)
    torch.testing.assert_close((cut, cut_sums), (whole, whole_sums))
    torch.testing.assert_close(*(torch.autograd.grad(loss, values)[0] for loss in (cut, whole)))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(columns=strategies.integers(1, 5000), rows=strategies.integers(1, 2000))
def test_shards_cover_every_column_once_and_differ_by_one_column_at_most(columns, rows):
    bounds = shard_bounds(columns, rows)
    assert bounds[0][0] == 0 and bounds[-1][1] == columns
    assert all(end == begin for (_, end), (begin, _) in zip(bounds, bounds[1:]))
    sizes = {end - begin for begin, end in bounds}
    assert min(sizes) >= 1 and max(sizes) - min(sizes) <= 1


def test_two_cores_have_work_where_there_is_enough_of_it():
    assert len(shard_bounds(32, 3)) == 2
    assert len(shard_bounds(30, 3)) == 1
    assert len(shard_bounds(320, 3, at_least=8)) == 8


@settings(max_examples=100, deadline=None, derandomize=True)
@given(columns=strategies.integers(1, 5000), rows=strategies.integers(1, 2000))
def test_a_shard_is_neither_a_sliver_nor_larger_than_need_be(columns, rows):
    sizes = [(end - begin) * rows for begin, end in shard_bounds(columns, rows)]
    if len(sizes) > 1:
        assert min(sizes) >= 48 - rows
    assert max(sizes) <= max(500, 2 * rows)
