"""One world of mpe2's simple_spread with random actions; arguments: robots, steps of an episode. A unit is one episode."""

from __future__ import annotations

import sys

from clock import Clock
from mpe2 import simple_spread_v3

num_agents, num_steps = map(int, sys.argv[1:])
clock = Clock(num_steps, 'mpe2', 'pettingzoo', 'numpy')
environment = simple_spread_v3.parallel_env(N=num_agents, max_cycles=num_steps)
environment.reset(seed=0)
for name in environment.agents:
    environment.action_space(name).seed(0)
actions = [{name: environment.action_space(name).sample() for name in environment.agents} for _ in range(num_steps)]
while True:
    environment.reset()
    for joint_action in actions:
        environment.step(joint_action)
    clock.tick()
