"""Times the learner: each network's epoch and the whole update, native and in torch, beside the machine's matrix peak.

    python -m benchmarks.learner [--worlds 128] [--robots 3] [--repeats 5]

Navigation's sizes, 25 steps, default settings, random data. Native and torch take turns, so that both meet the same
disturbances; the fastest turn counts. The peak is what torch's own product of two 512 x 512 matrices reaches on one
core in the same minutes; the arithmetic counted is that of the matrix products a network needs and no other.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, Callable, NamedTuple

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes
import torch

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.learning import joint_reward, kernels, losses, networks
from dae_ros.learning.chunks import shard_bounds
from dae_ros.learning.device import random_trajectory
from dae_ros.learning.learner import Learner
from dae_ros.types import WorldSpec

STEPS = 25
ARCHITECTURES = ('per_agent', 'shared_trunk')


class Row(NamedTuple):
    """One line of the table."""

    name: str
    flops: float
    cores: int
    work: Callable[[], object]


# Operations of the products, forward and backward, for one step of one world; nobody needs the gradient of the input.

def recurrent_flops(hidden: int, inputs: int, outputs: int, layers: int) -> float:
    first = 2 * inputs * hidden
    return 2 * (first + 3 * ((layers - 1) * hidden**2 + 6 * hidden**2 + hidden * outputs))


def reward_flops(architecture: str, spec: WorldSpec, hidden: int, trunk: int) -> float:
    N, A = spec.num_agents, spec.num_actions
    square, head = hidden**2, hidden * A
    if architecture == 'per_agent':
        return 2 * (2 * spec.state_size * hidden + 3 * square + 3 * N * (6 * square + head))
    return 2 * (2 * (spec.state_size + N * A) * trunk + 3 * (6 * trunk**2 + trunk * hidden + hidden * joint_reward.size(N, A)))


def epoch(network: networks.Network, rows: int, inputs: int, spec: WorldSpec, chunks: int, length: int) -> Callable[[], None]:
    """Gradients of all shards of one pass over the batch."""
    def shard(C: int) -> tuple:
        L, N = length, spec.num_agents
        actions, weights = torch.randint(spec.num_actions, (L, C, N)), torch.full((L, C, N), 1 / (L * C * N))
        per_agent, per_world = torch.randn(2, L, C, N), torch.randn(2, L, C, 1)
        if isinstance(network, networks.RewardNetwork):
            network.take_scale(per_world[0])
            loss = network.loss(actions, per_world[0, ..., 0], weights)
        elif rows == 1:
            loss = losses.ValueLoss(*per_world, N * weights[..., :1], 0.2, 10.0, 1.0)
        else:
            loss = losses.PolicyLoss(actions, *per_agent, weights, 0.2, 0.01)
        states = network.states_per_world() if isinstance(network, networks.RewardNetwork) else rows
        return (loss, torch.randn(L, C, rows, inputs), torch.zeros(C, states, network.hidden_size), torch.rand(L, C) < 1 / STEPS,
                actions if isinstance(network, networks.RewardNetwork) else None)

    shards = [shard(last - first) for first, last in shard_bounds(chunks, rows)]

    def work() -> None:
        for arguments in shards:
            network.gradient(*arguments)

    return work


def rows(spec: WorldSpec, settings: Settings, worlds: int) -> list[Row]:
    learner, N = settings.learner, spec.num_agents
    H, reward = learner.hidden_size, settings.reward_network
    steps, chunks = worlds * STEPS, -(-worlds * STEPS // learner.chunk_length)
    flops = {'actor': N * recurrent_flops(H, spec.observation_size, spec.num_actions, learner.mlp_layers),
             'critic': recurrent_flops(H, spec.state_size, 1, learner.mlp_layers)}
    flops |= {name: reward_flops(name, spec, reward.hidden_size, reward.trunk_size) for name in ARCHITECTURES}
    made = {'actor': (networks.make_actor(spec, learner, 1), N, spec.observation_size),
            'critic': (networks.make_critic(spec, learner, 1), 1, spec.state_size)}
    for name in ARCHITECTURES:
        reward_settings = config.from_flat({'reward_network.architecture': name}, settings).reward_network
        width = spec.state_size + (N * spec.num_actions if name == 'shared_trunk' else 0)
        made[name] = networks.make_reward_network(spec, reward_settings, 1, 0), 1, width
    table = [Row(f'{name}, one epoch', steps * flops[name], 1,
                 epoch(network, count, width, spec, chunks, learner.chunk_length))
             for name, (network, count, width) in made.items()]
    trajectory = random_trajectory(spec, worlds, STEPS)
    updates = {'beta 0': {'beta': 0.0}} | {f'beta 0.95, {a}': {'reward_network.architecture': a} for a in ARCHITECTURES}
    for name, changes in updates.items():
        # An epoch is one forward and two backward products; values, states and predictions take one forward pass more.
        needed = ['actor', 'critic', *(a for a in ARCHITECTURES if a in name)]
        total = (learner.epochs + 1 / 3) * steps * sum(flops[network] for network in needed)
        for threads in (1, 2):
            changed = config.from_flat(changes | {'learner_threads': threads}, settings)
            one = Learner(spec, changed.learner, changed.reward_network, 1)
            table.append(Row(f'update, {name}, {threads} thread{"s" * (threads > 1)}', total, threads,
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


def measure(worlds: int = 128, robots: int = 3, repeats: int = 5) -> list[dict[str, Any]]:
    """For each row: its name, GFLOP, milliseconds in torch and native, and the share of the peak the native one reaches."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    spec = WorldSpec(robots, 5, 6 * robots, 6 * robots * robots, True)
    native = kernels.library
    results = []
    try:
        for row in rows(spec, config.Settings(), worlds):
            best = {'torch': float('inf'), 'native': float('inf')}
            peak = 0.0
            for turn in range(repeats + 1):
                for name in best:
                    kernels.library = native if name == 'native' else None
                    taken = seconds(row.work)
                    if turn:  # the first turn warms up
                        best[name] = min(best[name], taken)
                peak = max(peak, matrix_peak())
            results.append({'name': row.name, 'gflop': row.flops / 1e9, 'peak_gflops_per_core': peak / 1e9,
                            **{f'{name}_ms': 1e3 * taken for name, taken in best.items()},
                            'of_peak': row.flops / peak / row.cores / best['native']})
            print(as_text(results[-1]), flush=True)
    finally:
        kernels.library = native
    return results


def as_text(row: dict[str, Any]) -> str:
    return (f'{row["name"]:42}{row["gflop"]:8.2f} GFLOP{row["torch_ms"]:10.1f} ms{row["native_ms"]:10.1f} ms'
            f'{row["torch_ms"] / row["native_ms"]:8.2f}{row["of_peak"]:8.0%}'
            f'   ({row["peak_gflops_per_core"]:.0f} GFLOP/s a core)')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--worlds', type=int, default=128)
    parser.add_argument('--robots', type=int, default=3)
    parser.add_argument('--repeats', type=int, default=5)
    arguments = parser.parse_args()
    if not kernels.available():
        print('The native kernels are not available here; both columns show torch.')
    print(f'{"":42}{"":14}{"torch":>13}{"native":>13}{"ratio":>8}{"of peak":>8}')
    measure(arguments.worlds, arguments.robots, arguments.repeats)


if __name__ == '__main__':
    main()
