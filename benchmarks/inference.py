"""python -m benchmarks.inference: microseconds a robot needs from its observation to its action, greedy, one world."""

from __future__ import annotations

import time

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes
import numpy as np

from dae_ros import config
from dae_ros.learning.learner import Learner
from dae_ros.learning.policy import choose
from dae_ros.types import WorldSpec

CALLS = 2000


def measure(calls: int = CALLS) -> dict[str, float]:
    """Median and 99th percentile of one answer, in microseconds; navigation with three robots, default settings."""
    settings = config.from_flat({'beta': 0.0})
    learner = Learner(WorldSpec(3, 5, 18, 54, True), settings.learner, settings.reward_network, 1)
    policy, state = learner.policy, learner.policy.initial_state(1)
    learner.close()
    observations = np.random.default_rng(0).standard_normal((calls, 1, 18), np.float32)
    going_on = np.zeros(1, bool)
    taken = np.empty(calls)
    for index, values in enumerate(observations):
        began = time.perf_counter()
        probabilities, state = policy.act(values, state, going_on)
        choose(probabilities, True, 1, 0, index, 0)
        taken[index] = time.perf_counter() - began
    return {'median': 1e6 * float(np.median(taken)), 'percentile_99': 1e6 * float(np.percentile(taken, 99))}


def main() -> None:
    for name, microseconds in measure().items():
        print(f'{name:15}{microseconds:8.1f} us')


if __name__ == '__main__':
    main()
