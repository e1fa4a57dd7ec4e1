"""Runs networks over rollouts in shards: forward passes, and trainings that take gradient steps side by side.

A shard's size depends on the data alone and results are added up in the shards' order, so nothing depends on the number of
threads. A `distributed.Team` shares the shards of every gradient step among its processes.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Callable, Iterable, Iterator, Tuple

import torch
from torch import Tensor

from dae_ros import draws
from dae_ros.learning.chunks import Chunks, chosen_chunks, shard_bounds
from dae_ros.learning.networks import Network, Table
from dae_ros.learning.optimizer import FlatAdam
from dae_ros.learning.parallel import Training, Workers

Batch = Tuple[Chunks, Tensor]  # chunks, and the recurrent states [C, ...] before their first steps
Gradient = Callable[..., Tuple[Tensor, Tensor]]  # of a batch, and a table if shared: the flat gradient, and sums of the loss


class Passes:
    """The threads, the device and the team that this process's networks run on."""

    def __init__(self, threads: int, seed: int, device: torch.device, team=None):
        """`threads`: 0 takes all cores. `team`: the `distributed.Team` this process learns with, None to learn alone."""
        self.device = device
        self._seed = seed
        self._team = team
        self._workers = Workers(threads)

    def forward(self, network: Network, rows: int, inputs: Tensor, episode_start: Tensor,
                actions: Tensor | None = None) -> tuple[Tensor, ...]:
        """The network's outputs and recurrent states over a rollout [T, W, ...], `rows` of these in each world."""
        @torch.no_grad()
        def of_worlds(first: int, last: int) -> tuple[Tensor, Tensor]:
            initial = inputs.new_zeros(last - first, rows, network.hidden_size)
            own = None if actions is None else actions[:, first:last]
            return network(inputs[:, first:last], initial, episode_start[:, first:last], own)

        parts = self._workers.map(partial(of_worlds, *bounds) for bounds in self._bounds(inputs.shape[1], rows, 2))
        return tuple(torch.cat(part, 1) for part in zip(*parts))

    def epochs(self, name: str, chunks: Chunks, initial: Tensor, epochs: int, mini_batches: int, rollout: int) -> Iterator[Batch]:
        """The chunks of every gradient step of passes over one rollout; `name` keys how they are mixed."""
        whole = chunks, initial
        for epoch in range(epochs):
            if mini_batches == 1:
                yield whole
                continue
            order = draws.generator(self._seed, f'mini_batches {name}', rollout, epoch).permutation(len(initial))
            for chosen in torch.from_numpy(order).to(self.device).chunk(mini_batches):
                yield chosen_chunks(chunks, chosen), initial[chosen]

    def train(self, name: str, adam: FlatAdam, gradient: Gradient, batches: Iterable[Batch], rows_per_chunk: int,
              metric_names: tuple[str, ...], shared: Callable[[Chunks], Table | None] = lambda chunks: None) -> Training:
        """Gradient steps of one network, for `run`; returns its metrics, averaged over the steps.

        Yields the shards of a gradient step as tasks, `rows_per_chunk` rows in each chunk, and is sent their results.
        `shared` makes the table that the shards of a step share, if there is one.
        """
        totals, norms, steps, cut, shards = torch.zeros(len(metric_names), device=self.device), 0.0, 0, None, []
        for batch in batches:
            if batch is not cut:
                cut, shards = batch, self._shards(*batch, rows_per_chunk)
            table = shared(batch[0])
            task = gradient if table is None else partial(gradient, shared=table)
            answers = yield [partial(task, *shard) for shard in shards]
            flat = reduce(Tensor.add_, (flat for flat, _ in answers))  # in place: with a table it is megabytes
            norms += adam.step(flat if table is None else table.to_parameters(flat))
            totals += sum(terms for _, terms in answers)
            steps += 1
        return dict(zip(metric_names, (totals / steps).tolist())) | {f'{name}/gradient_norm': norms / steps}

    def run(self, trainings: Iterable[Training]) -> dict[str, float]:
        """Drives the trainings to their ends; the metrics of all."""
        if self._team is None:
            results = self._workers.run(trainings)
        else:
            results = self._workers.run_together(trainings, team=self._team)
        return {name: value for metrics in results for name, value in metrics.items()}

    def close(self) -> None:
        """Ends the threads."""
        self._workers.close()

    def _shards(self, chunks: Chunks, initial: Tensor, rows_per_chunk: int) -> list[Batch]:
        """The chunks of one gradient step in shards; their weights add up to one over the step."""
        chunks = chunks._replace(weights=chunks.weights / chunks.weights.sum())
        processes = 1 if self._team is None else self._team.size
        bounds = self._bounds(len(initial), rows_per_chunk, 2 * processes)
        bounds += [(0, 0)] * (processes - len(bounds))  # for every process something, if only an empty shard
        return [(chosen_chunks(chunks, slice(a, b)), initial[a:b]) for a, b in bounds]

    def _bounds(self, columns: int, rows_per_column: int, at_least: int) -> list[tuple[int, int]]:
        """Shards for the threads; a GPU, which is parallel itself, gets the whole."""
        if self.device.type == 'cuda':
            return [(0, columns)]
        return shard_bounds(columns, rows_per_column, at_least)

