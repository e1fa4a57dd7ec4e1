"""Cuts a rollout into the pieces the networks are trained on.

The worlds' sequences are laid end to end and cut every `chunk_length` steps; a chunk may run over the end of an episode
into the next one, where the recurrent state is zeroed anyway. Chunks are grouped into shards of a size that depends on
the data alone: gradients are summed shard by shard in a fixed order, whichever thread computes them, so the weights do
not depend on the machine's number of cores.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from dae_ros.types import Trajectory

MOST_ROWS = 496   # of a recurrent step in a shard: memory grows with them
FEWEST_ROWS = 48  # in a shard: starting one costs as much as ten rows


class PolicyChunks(NamedTuple):
    """What the actor learns from: C chunks of L steps."""

    observations: Tensor       # [L, C, N, O]
    episode_start: Tensor      # [L, C] bool
    actions: Tensor            # [L, C, N] int64
    log_probabilities: Tensor  # [L, C, N] of the actions taken, under the acting policy
    advantages: Tensor         # [L, C, N] normalised
    weights: Tensor            # [L, C, N] 1, and 0 for agents that have left, and for filling
    available: Tensor | None   # [L, C, N, A] bool actions that may be chosen; None: all


class ValueChunks(NamedTuple):
    """What the critic learns from."""

    states: Tensor         # [L, C, V, S / V], of all agents together (V = 1) or of each (V = N)
    episode_start: Tensor  # [L, C] bool
    values: Tensor         # [L, C, V] normalised, before the update
    targets: Tensor        # [L, C, V] normalised
    weights: Tensor        # [L, C, V]


class ActionChunks(NamedTuple):
    """What a network learns from that has a number for every action of an agent: a reward or an action value."""

    inputs: Tensor         # [L, C, 1, I]
    episode_start: Tensor  # [L, C] bool
    actions: Tensor        # [L, C, N] int64
    targets: Tensor        # [L, C] what it should have said of the actions taken
    weights: Tensor        # [L, C, N]


Chunks = TypeVar('Chunks', PolicyChunks, ValueChunks, ActionChunks)


def chosen_chunks(chunks: Chunks, chosen: Tensor | slice) -> Chunks:
    """Some of the chunks."""
    return chunks._make(None if part is None else part[:, chosen] for part in chunks)


def to_chunks(sequences: Tensor, length: int) -> Tensor:
    """[T, W, ...] -> [L, C, ...] with C = ceil(T W / L); what is missing at the end is filled with zeros."""
    steps, worlds = sequences.shape[:2]
    flat = sequences.transpose(0, 1).reshape(steps * worlds, *sequences.shape[2:])
    missing = -len(flat) % length
    if missing:
        flat = torch.cat([flat, flat.new_zeros(missing, *flat.shape[1:])])
    return flat.view(-1, length, *flat.shape[1:]).transpose(0, 1)


def agent_weights(data: Trajectory) -> Tensor:
    """[T, W, N] what each agent's steps count in the losses: 1, and 0 once it has left."""
    present = torch.ones_like(data.actions) if data.present is None else data.present
    return present.to(data.rewards.dtype)


def first_states(states: Tensor, length: int) -> Tensor:
    """Recurrent state before the first step of every chunk.

    states: [T, W, ...], the state after each step. Returns [C, ...]; before the first step of a world it is zero.
    """
    before = torch.cat([torch.zeros_like(states[:1]), states[:-1]])
    return to_chunks(before, length)[0]


def shard_bounds(columns: int, rows_per_column: int, at_least: int = 2) -> list[tuple[int, int]]:
    """Splits `columns` chunks or worlds of `rows_per_column` rows each into near-equal runs.

    They are `at_least` so many, so that as many cores have work, unless they had fewer than FEWEST_ROWS rows then; none has
    more than MOST_ROWS rows but a run of a single column that is longer.
    """
    wanted = min(at_least, max(1, columns * rows_per_column // FEWEST_ROWS))
    shards = max(wanted, -(-columns // max(1, MOST_ROWS // rows_per_column)))
    shards = min(shards, max(1, columns))
    edges = [round(index * columns / shards) for index in range(shards + 1)]
    return list(zip(edges, edges[1:]))
