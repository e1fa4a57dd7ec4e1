"""VMAS's simple_spread with random actions; arguments: worlds, robots, steps of an episode. A unit is one episode."""

from __future__ import annotations

import sys

import torch
import vmas
from clock import Clock

num_worlds, num_agents, num_steps = map(int, sys.argv[1:])
clock = Clock(num_worlds * num_steps, 'vmas', 'torch')
environment = vmas.make_env('simple_spread', num_worlds, device='cpu', continuous_actions=False, seed=0, n_agents=num_agents)
actions = [[torch.randint(space.n, (num_worlds, 1)) for space in environment.action_space] for _ in range(num_steps)]
while True:
    environment.reset()
    for joint_action in actions:
        environment.step(joint_action)
    clock.tick()
