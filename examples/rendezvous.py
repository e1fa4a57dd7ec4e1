"""A task of one's own: robots on a line must meet. A PettingZoo parallel environment, all that `dae_ros` needs of it.

    bringup -p task:=pettingzoo:examples.rendezvous -p num_agents:=3
"""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

MOVES = (-0.1, 0.0, 0.1)  # m per step


class Rendezvous(ParallelEnv):
    """Each robot sees where it is and the mean of the others; the team loses the spread of its positions, each step."""

    metadata = {'name': 'rendezvous'}

    def __init__(self, N: int = 3, max_cycles: int = 20):
        self.possible_agents = [f'robot_{i}' for i in range(N)]
        self._max_cycles = max_cycles

    def observation_space(self, agent: str) -> Box:
        return Box(-np.inf, np.inf, (2,), np.float32)

    def action_space(self, agent: str) -> Discrete:
        return Discrete(len(MOVES))

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        self._positions = np.random.default_rng(seed).uniform(-1, 1, len(self.agents))
        self._cycles = 0
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self._positions += [MOVES[actions[agent]] for agent in self.agents]
        self._cycles += 1
        reward = -float(np.ptp(self._positions))
        over = self._cycles == self._max_cycles
        results = (self._observations(), {agent: reward for agent in self.agents}, {agent: False for agent in self.agents},
                   {agent: over for agent in self.agents}, {agent: {} for agent in self.agents})
        if over:
            self.agents = []
        return results

    def _observations(self):
        total, others = self._positions.sum(), max(1, len(self._positions) - 1)
        return {agent: np.array([position, (total - position) / others - position], np.float32)
                for agent, position in zip(self.possible_agents, self._positions)}


def parallel_env(**arguments) -> Rendezvous:
    """What PettingZoo's users expect a module to offer."""
    return Rendezvous(**arguments)
