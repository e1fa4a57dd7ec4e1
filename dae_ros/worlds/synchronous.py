"""The rhythm of worlds whose episodes all last equally long: they begin together and end together."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from dae_ros import draws
from dae_ros.errors import WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds, check_actions


class SynchronousWorlds(Worlds):
    """W worlds that end their episode, as terminated, after every `episode_steps` steps.

    An episode is drawn from (seed, 'reset', rollout, steps taken in the rollout), whatever was simulated before.
    """

    def __init__(self, spec: WorldSpec, num_worlds: int, episode_steps: int):
        self.spec = spec
        self.num_worlds = num_worlds
        self.episode_steps = episode_steps
        self._rollout_key: tuple[int, int] | None = None
        self._steps = 0

    def reset(self, seed: int, rollout: int) -> JointObservation:
        self._rollout_key = (seed, rollout)
        self._steps = 0
        return self._begin_episodes()

    def step(self, actions: np.ndarray) -> Transition:
        """As `Worlds.step`. Raises ValueError on actions of another shape, type or range, WorldError before `reset`."""
        if self._rollout_key is None:
            raise WorldError('the worlds must be reset before their first step')
        self.advance(check_actions(actions, self.num_worlds, self.spec))
        reward = self.reward().astype(np.float32)
        self._steps += 1
        ended = self._steps % self.episode_steps == 0
        return Transition(
            reward=reward,
            terminated=np.full(self.num_worlds, ended),
            truncated=np.zeros(self.num_worlds, dtype=bool),
            final_states=np.empty((0, self.spec.state_size), dtype=np.float32),
            next=self._begin_episodes() if ended else self._joint_observation(episode_start=False),
        )

    def _begin_episodes(self) -> JointObservation:
        seed, rollout = self._rollout_key
        self.begin(draws.generator(seed, 'reset', rollout, self._steps))
        return self._joint_observation(episode_start=True)

    def _joint_observation(self, episode_start: bool) -> JointObservation:
        observations, state = self.observe()
        return JointObservation(observations, state, np.full(self.num_worlds, episode_start))

    @abstractmethod
    def begin(self, draw: np.random.Generator) -> None:
        """Begin a new episode in every world. Numbers are drawn as [W, k], so that a world's do not depend on W."""

    @abstractmethod
    def advance(self, actions: np.ndarray) -> None:
        """Apply the checked joint actions [W, N]."""

    @abstractmethod
    def reward(self) -> np.ndarray:
        """The team's reward [W], float64, for the state that `advance` led to."""

    @abstractmethod
    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations [W, N, O] and state [W, S], float32, in memory that no later step touches."""
