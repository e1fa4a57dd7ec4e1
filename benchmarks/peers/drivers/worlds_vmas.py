"""VMAS's simple_spread with random actions; arguments: worlds, robots, steps of an episode. A unit is one episode.

Few worlds are faster with one thread than with torch's default, many are not: VMAS gets what suits it.
"""

from __future__ import annotations

import sys
import time

import torch
import vmas
from clock import Clock

TRIES = 4  # the first warms up

num_worlds, num_agents, num_steps = map(int, sys.argv[1:])
clock = Clock(num_worlds * num_steps, 'vmas', 'torch')
environment = vmas.make_env('simple_spread', num_worlds, device='cpu', continuous_actions=False, seed=0, n_agents=num_agents)
actions = [[torch.randint(space.n, (num_worlds, 1)) for space in environment.action_space] for _ in range(num_steps)]


def episode() -> None:
    environment.reset()
    for joint_action in actions:
        environment.step(joint_action)


def seconds(threads: int) -> float:
    torch.set_num_threads(threads)
    begin = time.perf_counter()
    episode()
    return time.perf_counter() - begin


choices = torch.get_num_threads(), 1
tries = [[seconds(threads) for threads in choices] for _ in range(TRIES)]
torch.set_num_threads(min(zip(map(min, zip(*tries[1:])), choices))[1])
while True:
    episode()
    clock.tick()
