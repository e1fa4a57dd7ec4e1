"""Times the learner: each network's epoch and the whole update, native and in torch, beside the machine's matrix peak.

    python -m benchmarks.learner [--worlds 128] [--robots 3] [--repeats 5]

Navigation's sizes, 25 steps, default settings, random data. Native and torch take turns, so that both meet the same
disturbances; the fastest turn counts. The peak is what torch's own product of two 512 x 512 matrices reaches on one
core in the same minutes; `ideal` is the arithmetic of the products at that peak, on all the cores in use.
"""

from __future__ import annotations

import argparse
import time
from typing import Callable, NamedTuple

import numpy as np
import torch

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.learning import kernels, networks
from dae_ros.learning.chunks import shard_bounds
from dae_ros.learning.learner import Learner
from dae_ros.types import Trajectory, WorldSpec

STEPS = 25


class Row(NamedTuple):
    """One line of the table."""

    name: str
    flops: float                 # of the products, row by row; looking up shared rows saves some of them
    cores: int
    work: Callable[[], object]


def recurrent_flops(hidden: int, inputs: int, outputs: int, layers: int) -> float:
    """Products of one row's forward and backward pass; nobody needs the gradient of the input."""
    products = inputs * hidden + (layers - 1) * hidden**2 + 6 * hidden**2 + hidden * outputs
    return 6 * products


def reward_flops(spec: WorldSpec, hidden: int) -> float:
    """The same for one agent's row of the reward network; the state's layers count once per world."""
    world = 3 * hidden**2 + 2 * spec.state_size * hidden
    own = 3 * (hidden**2 + 6 * hidden**2 + hidden * spec.num_actions)
    return 2 * (world / spec.num_agents + own)


def random_trajectory(spec: WorldSpec, worlds: int) -> Trajectory:
    random = np.random.default_rng(0)
    T, W, N, A = STEPS, worlds, spec.num_agents, spec.num_actions
    episode_start, terminated = np.zeros((T + 1, W), bool), np.zeros((T, W), bool)
    episode_start[0] = episode_start[-1] = terminated[-1] = True
    return Trajectory(random.standard_normal((T, W, N, spec.observation_size), np.float32),
                      random.standard_normal((T + 1, W, spec.state_size), np.float32), episode_start,
                      random.integers(A, size=(T, W, N)), random.dirichlet(np.ones(A), (T, W, N)).astype(np.float32),
                      random.standard_normal((T, W), np.float32), terminated, np.zeros((T, W), bool),
                      np.zeros((0, spec.state_size), np.float32))


def epoch(network: torch.nn.Module, inputs: Callable[[int], tuple], chunks: int,
          rows_per_chunk: int) -> Callable[[], None]:
    """Forward and backward pass of `network` over all shards, with the sum of its outputs as the loss."""
    parameters = tuple(network.parameters())
    shards = [inputs(last - first) for first, last in shard_bounds(chunks, rows_per_chunk)]

    def work() -> None:
        for shard in shards:
            torch.autograd.grad(network(*shard)[0].sum(), parameters)

    return work


def rows(spec: WorldSpec, settings: Settings, worlds: int) -> list[Row]:
    learner, L, N = settings.learner, settings.learner.chunk_length, spec.num_agents
    H, R = learner.hidden_size, settings.reward_network.hidden_size
    steps, chunks = worlds * STEPS, -(-worlds * STEPS // L)

    def recurrent(width: int, per_chunk: int) -> Callable[[int], tuple]:
        return lambda count: (torch.randn(L, count * per_chunk, width), torch.zeros(count * per_chunk, H),
                              torch.rand(L, count * per_chunk) < 1 / STEPS)

    def reward(count: int) -> tuple:
        return (torch.randn(L, count, spec.state_size), torch.randint(spec.num_actions, (L, count, N)),
                torch.zeros(count * N, R), torch.rand(L, count) < 1 / STEPS)

    flops = {'actor': steps * N * recurrent_flops(H, spec.observation_size, spec.num_actions, learner.mlp_layers),
             'critic': steps * recurrent_flops(H, spec.state_size, 1, learner.mlp_layers),
             'reward network': steps * N * reward_flops(spec, R)}
    actor, critic = networks.make_actor(spec, learner, 1), networks.make_critic(spec, learner, 1)
    reward_network = networks.make_reward_network(spec, settings.reward_network, 1, 0)
    works = {'actor': epoch(actor, recurrent(spec.observation_size, N), chunks, N),
             'critic': epoch(critic, recurrent(spec.state_size, 1), chunks, 1),
             'reward network': epoch(reward_network, reward, chunks, N)}
    table = [Row(f'{name}, one epoch', flops[name], 1, work) for name, work in works.items()]
    trajectory = random_trajectory(spec, worlds)
    for beta in (0.0, 0.95):
        # An epoch is one forward and two backward products; values, states and predictions take one forward pass more.
        passes = learner.epochs + 1 / 3
        total = passes * (flops['actor'] + flops['critic'] + (flops['reward network'] if beta else 0))
        for threads in (1, 2):
            changed = config.from_flat({'beta': beta, 'learner_threads': threads}, settings)
            one = Learner(spec, changed.learner, changed.reward_network, 1)
            table.append(Row(f'update, beta {beta:g}, {threads} thread{"s" * (threads > 1)}', total, threads,
                             lambda one=one: one.update(trajectory, 0)))
    return table


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def matrix_peak() -> float:
    """Operations per second of a large single-precision product on one core."""
    matrix = torch.randn(512, 512)
    return 2 * 512**3 / min(seconds(lambda: matrix @ matrix) for _ in range(20))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--worlds', type=int, default=128)
    parser.add_argument('--robots', type=int, default=3)
    parser.add_argument('--repeats', type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    N = arguments.robots
    spec = WorldSpec(N, 5, 6 * N, 6 * N * N, True)
    native = kernels.library
    if native is None:
        print('The native kernels are not available here; both columns show torch.')
    print(f'{"":28}{"GFLOP":>8}{"torch":>10}{"native":>10}{"ideal":>10}{"speed-up":>10}{"of peak":>10}')
    for row in rows(spec, config.Settings(), arguments.worlds):
        best = {'torch': float('inf'), 'native': float('inf')}
        peak = 0.0
        for turn in range(arguments.repeats + 1):
            for name in best:
                kernels.library = native if name == 'native' else None
                taken = seconds(row.work)
                if turn:  # the first turn warms up
                    best[name] = min(best[name], taken)
            peak = max(peak, matrix_peak())
        ideal = row.flops / peak / row.cores
        print(f'{row.name:28}{row.flops / 1e9:8.2f}{best["torch"] * 1e3:8.1f}ms{best["native"] * 1e3:8.1f}ms'
              f'{ideal * 1e3:8.1f}ms{best["torch"] / best["native"]:10.2f}{ideal / best["native"]:10.0%}'
              f'   ({peak / 1e9:.0f} GFLOP/s a core)', flush=True)
    kernels.library = native


if __name__ == '__main__':
    main()
