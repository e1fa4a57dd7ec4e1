"""The rhythm of worlds whose episodes all last equally long: they begin together and end together."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds, check_actions


class SynchronousWorlds(Worlds):
    """W worlds that end their episode, as terminated, after every `episode_steps` steps.

    An episode is drawn from (seed, 'reset', rollout, steps taken in the rollout), whatever was simulated before.
    A reward is paid `reward_delay` steps after the action that earned it, and at the latest with the episode's last step.
    """

    def __init__(self, spec: WorldSpec, task: TaskSettings, episode_steps: int):
        self.spec = spec
        self.num_worlds = task.num_worlds
        self.episode_steps = episode_steps
        self._reward_delay = task.reward_delay
        self._owed: deque[np.ndarray] = deque()  # rewards earned and not yet paid, the oldest first
        self._rollout_key: tuple[int, int] | None = None
        self._steps = 0

    def reset(self, seed: int, rollout: int) -> JointObservation:
        self._rollout_key = (seed, rollout)
        self._steps = 0
        self._owed.clear()
        return self._begin_episodes()

    def step(self, actions: np.ndarray) -> Transition:
        """As `Worlds.step`. Raises ValueError on actions of another shape, type or range, WorldError before `reset`."""
        self.advance(self._check(actions))
        reward = self._pay(self._owed, self.reward())
        ended = self._at_last_step
        self._steps += 1
        return Transition(
            reward=reward.astype(np.float32),
            terminated=np.full(self.num_worlds, ended),
            truncated=np.zeros(self.num_worlds, dtype=bool),
            final_states=np.empty((0, self.spec.state_size), dtype=np.float32),
            next=self._begin_episodes() if ended else self._joint_observation(episode_start=False),
        )

    def alternative_rewards(self, actions: np.ndarray) -> np.ndarray:
        """The reward this step would pay if agent i took action a and the others theirs of `actions` [W, N]: [W, N, A] float64.

        The entries of the actions taken are what `step` then pays, before it rounds to float32. With a `reward_delay`, it
        makes a difference what an agent does only at an episode's last step: any other pays what was earned earlier.
        Changes nothing. Raises as `step`.
        """
        earned = self.alternatives(self._check(actions))
        paid = self._pay(self._owed.copy(), earned)
        return np.broadcast_to(paid, earned.shape).transpose(2, 0, 1).copy()

    def _check(self, actions: np.ndarray) -> np.ndarray:
        if self._rollout_key is None:
            raise WorldError('the worlds must be reset before their first step')
        return check_actions(actions, self.num_worlds, self.spec)

    @property
    def _at_last_step(self) -> bool:
        """Whether the step under way ends the episode."""
        return (self._steps + 1) % self.episode_steps == 0

    def _pay(self, owed: deque[np.ndarray], earned: np.ndarray) -> np.ndarray:
        """What this step pays if it earns `earned`; the rest stays in `owed`."""
        owed.append(earned)
        if len(owed) <= self._reward_delay and not self._at_last_step:
            return np.zeros_like(earned)
        paid = owed.popleft()
        while owed and self._at_last_step:
            paid = paid + owed.popleft()
        return paid

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
        """The reward [W], float64, that the team earned by what `advance` did; in memory that no later step touches."""

    @abstractmethod
    def alternatives(self, actions: np.ndarray) -> np.ndarray:
        """The `reward` that `advance` would lead to if agent i took action a and all others theirs of the checked joint
        actions [W, N]: [N, A, W] float64. Changes nothing."""

    @abstractmethod
    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations [W, N, O] and state [W, S], float32, in memory that no later step touches."""
