"""A PettingZoo environment whose agents fall one by one: who attacks while tired falls, and nobody can rest twice in a row."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

WAIT, REST, ATTACK = range(3)
LENGTH = 6  # steps after which an episode is cut off


class Skirmish(ParallelEnv):
    """Each attack costs the enemy a point, of which it has half as many again as there are agents."""

    metadata = {'name': 'skirmish'}

    def __init__(self, N: int = 3):
        self.possible_agents = [f'fighter_{number}' for number in range(N)]

    def observation_space(self, agent):
        return spaces.Dict({'observation': spaces.Box(-1.0, 2.0, (3,), np.float32), 'action_mask': spaces.MultiBinary(3)})

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        if seed is not None:
            self._draw = np.random.default_rng(seed)
        self.agents = self.possible_agents[:]
        self._enemy, self._steps = 1.5 * len(self.agents), 0
        self._tired = dict.fromkeys(self.agents, 0.0)
        self._rested = dict.fromkeys(self.agents, False)
        return self._observe(), self._states()

    def _observe(self):
        return {agent: {'observation': np.array([self._tired[agent], self._enemy / 5, self._steps / LENGTH], np.float32),
                        'action_mask': np.array([1, not self._rested[agent], 1], np.int8)} for agent in self.agents}

    def _states(self):
        """Each agent's own view of the whole: itself, the enemy, and how many are left."""
        return {agent: {'state': np.array([self._tired[agent], self._enemy, len(self.agents)])} for agent in self.agents}

    def step(self, actions):
        self._steps += 1
        attackers = [agent for agent in self.agents if actions[agent] == ATTACK]
        fallen = {agent for agent in attackers if self._tired[agent] > 0.5}
        self._enemy -= len(attackers)
        for agent in self.agents:
            self._rested[agent] = actions[agent] == REST
            self._tired[agent] = 0.0 if self._rested[agent] else float(self._draw.random())
        over, late = self._enemy <= 0, self._steps == LENGTH
        ended = {agent: over or agent in fallen for agent in self.agents}
        cut_off = dict.fromkeys(self.agents, late and not over)
        told = self._observe(), dict.fromkeys(self.agents, float(len(attackers))), ended, cut_off, self._states()
        self.agents = [agent for agent in self.agents if not ended[agent] and not cut_off[agent]]
        return told


parallel_env = Skirmish
