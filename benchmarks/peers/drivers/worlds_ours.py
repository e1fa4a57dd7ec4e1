"""Our navigation with random actions; arguments: worlds, robots, steps of an episode. A unit is one episode."""

from __future__ import annotations

import sys

import numpy as np
from clock import Clock

from dae_ros.config import TaskSettings
from dae_ros.worlds import make_worlds

num_worlds, num_agents, num_steps = map(int, sys.argv[1:])
clock = Clock(num_worlds * num_steps, 'numpy')
worlds = make_worlds(TaskSettings(num_agents=num_agents, num_worlds=num_worlds, episode_steps=num_steps))
actions = np.random.default_rng(0).integers(worlds.spec.num_actions, size=(num_steps, num_worlds, num_agents))
worlds.reset(seed=0, rollout=0)
while True:
    for joint_action in actions:
        worlds.step(joint_action)  # the last one begins the next episode
    clock.tick()
