"""The N-step matrix game of the DAE paper: N agents, N actions, and at step t only agent t's action counts."""

from __future__ import annotations

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.types import WorldSpec
from dae_ros.worlds.synchronous import SynchronousWorlds


class MatrixGame(SynchronousWorlds):
    """Reward u - (N + 1) / 2 for the action u in 1 .. N of agent t at step t; the best return is N (N - 1) / 2.

    Every agent observes the step, one-hot. The state is that one vector too, as N copies of it hold nothing more.
    """

    def __init__(self, task: TaskSettings):
        num_agents = task.num_agents
        if task.episode_steps > num_agents:
            raise SettingsError(f'episode_steps must be at most num_agents = {num_agents} in the matrix game, '
                                f'not {task.episode_steps}')
        if task.observe_others:
            raise SettingsError('observe_others belongs to formation and line; set it to false for the matrix game')
        spec = WorldSpec(num_agents, num_agents, num_agents, num_agents, state_is_observations=False)
        super().__init__(spec, task, task.episode_steps or num_agents)
        self._turn = 0  # step of the episode, and the agent whose action counts there
        self._reward = np.zeros(task.num_worlds)

    def begin(self, draw: np.random.Generator) -> None:
        self._turn = 0

    def advance(self, actions: np.ndarray) -> None:
        self._reward = self._reward_of(actions[:, self._turn])
        self._turn += 1

    def reward(self) -> np.ndarray:
        return self._reward

    def alternatives(self, actions: np.ndarray) -> np.ndarray:
        num_agents, num_actions = self.spec.num_agents, self.spec.num_actions
        rewards = np.tile(self._reward_of(actions[:, self._turn]), (num_agents, num_actions, 1))
        rewards[self._turn] = self._reward_of(np.arange(num_actions))[:, None]
        return rewards

    def _reward_of(self, action: np.ndarray) -> np.ndarray:
        return action + 1 - (self.spec.num_agents + 1) / 2

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        observations = np.zeros((self.num_worlds, self.spec.num_agents, self.spec.observation_size), dtype=np.float32)
        observations[:, :, self._turn] = 1.0
        return observations, observations[:, 0].copy()
