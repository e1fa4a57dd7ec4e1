"""What a batch of simulated worlds must do, and nothing about how.

A `Worlds` object steps W independent worlds at once. It holds no random state: every draw is keyed by the run's seed,
the rollout and the step (`dae_ros.draws`), so that a rollout can be begun again from its request alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from dae_ros.types import WorldSpec


class JointObservation(NamedTuple):
    """What W worlds show before a joint action."""

    observations: np.ndarray   # [W, N, O] float32
    state: np.ndarray          # [W, S] float32
    episode_start: np.ndarray  # [W] bool
    available: np.ndarray | None = None  # [W, N, A] bool: actions each robot may choose, one at least; None: all
    present: np.ndarray | None = None    # [W, N] bool: who has not left the team; one who has may only choose action 0


class Transition(NamedTuple):
    """What a joint action did. Worlds whose episode ended have begun the next one: `next` is its first step."""

    reward: np.ndarray         # [W] float32, shared by the team
    terminated: np.ndarray     # [W] bool
    truncated: np.ndarray      # [W] bool, never both
    final_states: np.ndarray   # [K, S] float32, last states of the K truncated episodes, in the order of the worlds
    next: JointObservation
    won: np.ndarray | None = None  # [W] bool: episodes that ended with a victory; None: none


class Worlds(ABC):
    """W worlds of one task."""

    spec: WorldSpec
    num_worlds: int

    @abstractmethod
    def reset(self, seed: int, rollout: int) -> JointObservation:
        """Begin a new episode in every world, keyed by the run's seed and the rollout."""

    @abstractmethod
    def step(self, actions: np.ndarray) -> Transition:
        """Apply the joint actions, integers [W, N] in 0 .. A-1, of what is available; worlds whose episode ends begin the
        next one. Those who have left the team do nothing, action 0, until their world's episode ends."""

    def close(self) -> None:
        """Release what the worlds hold outside Python's memory."""


def check_actions(actions: np.ndarray, num_worlds: int, spec: WorldSpec) -> np.ndarray:
    """`actions` as an array, if they are integers [W, N] in 0 .. A-1. Raises ValueError naming what is wrong."""
    actions = np.asarray(actions)
    if actions.shape != (num_worlds, spec.num_agents):
        raise ValueError(f'actions must have the shape (worlds, robots) = {(num_worlds, spec.num_agents)}, '
                         f'not {actions.shape}')
    if not np.issubdtype(actions.dtype, np.integer):
        raise ValueError(f'actions must be integers, not {actions.dtype}')
    if actions.min() < 0 or actions.max() >= spec.num_actions:
        wrong = actions[(actions < 0) | (actions >= spec.num_actions)][0]
        raise ValueError(f'actions must lie in 0 .. {spec.num_actions - 1}, not {wrong}')
    return actions
