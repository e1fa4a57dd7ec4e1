"""python -m benchmarks.worlds: environment steps per second of our simulators, random actions, one process.

The median of the repeats is the figure; their spread tells whether the machine was quiet.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.worlds import BUILT_IN, make_worlds

STEPS = 50  # two episodes of the particle tasks, their new beginnings included


def steps_per_second(task: TaskSettings, repeats: int) -> np.ndarray:
    """Environment steps per second, all worlds together, of each repeat [repeats]."""
    worlds = make_worlds(task)
    shape = (STEPS, task.num_worlds, task.num_agents)
    actions = np.random.default_rng(0).integers(worlds.spec.num_actions, size=shape)
    speeds = []
    for repeat in range(repeats + 1):
        worlds.reset(seed=0, rollout=repeat)
        begin = time.perf_counter()
        for joint_action in actions:
            worlds.step(joint_action)
        speeds.append(STEPS * task.num_worlds / (time.perf_counter() - begin))
    return np.array(speeds[1:])  # the first only warms up


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--robots', type=int, nargs='+', default=[3], help='team sizes')
    parser.add_argument('--worlds', type=int, nargs='+', default=[128, 4096], help='worlds side by side')
    parser.add_argument('--repeats', type=int, default=9)
    options = parser.parse_args()
    print(f'{"task":12} {"robots":>6} {"worlds":>6} {"steps/s":>12} {"slowest":>12} {"fastest":>12}')
    for name in BUILT_IN:
        for num_agents in options.robots:
            for num_worlds in options.worlds:
                task = TaskSettings(task=name, num_agents=num_agents, num_worlds=num_worlds)
                speeds = steps_per_second(task, options.repeats)
                print(f'{name:12} {num_agents:6} {num_worlds:6} {np.median(speeds):12,.0f} {speeds.min():12,.0f} '
                      f'{speeds.max():12,.0f}')


if __name__ == '__main__':
    main()
