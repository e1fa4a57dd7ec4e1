"""Batched physics of the particle tasks: W teams of N discs that accelerate, coast and push each other in the plane.

The dynamics are those of the multi-agent particle environments (Lowe et al., NeurIPS 2017), semi-implicit: velocity
first, then the position with the new velocity. PettingZoo's `mpe2` moves the position with the old velocity; apart
from that, both agree to rounding. Arrays keep the worlds last, so that every operation runs along W, and sums are taken
in a fixed order, so that a world's numbers depend neither on W nor on its neighbours.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from functools import cached_property

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.types import WorldSpec
from dae_ros.worlds.synchronous import SynchronousWorlds

TIME_STEP = 0.1  # s
DAMPING = 0.25   # share of the velocity lost per step
EPISODE_STEPS = 25
ACTION_FORCE = 5.0 * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]], dtype=np.float64)  # [2, A]: none, +x, -x, +y, -y
CONTACT_FORCE = 100.0
CONTACT_MARGIN = 1e-3
# Beyond this many margins a contact pushes with less than 1e-18 of force, below the rounding of the action's 5.
CONTACT_REACH = 40.0
WORLDS_AT_ONCE = 256  # in a transposition


class ParticleWorlds(SynchronousWorlds):
    """W worlds of N discs and L landmarks; a task adds where they start and what is rewarded.

    An observation is (velocity, position, landmarks - position, others - position, own features), each part x before y. Own
    features are zeros unless the task overrides `_look`. The state is the N observations one after another.
    """

    radius: float            # of a disc
    num_landmark_draws: int  # uniform numbers that `_place_landmarks` needs per world

    def __init__(self, task: TaskSettings, num_landmarks: int, observe_others: bool, own_features: int = 0):
        """`own_features`: how many numbers the task adds to an observation, a multiple of 2."""
        num_agents, num_worlds = task.num_agents, task.num_worlds
        num_others = num_agents - 1 if observe_others else 0
        size = 4 + 2 * num_landmarks + 2 * num_others + own_features
        spec = WorldSpec(num_agents, ACTION_FORCE.shape[1], size, num_agents * size, state_is_observations=True)
        super().__init__(spec, task, task.episode_steps or EPISODE_STEPS)
        self._task = task

        # The observations, worlds last, are also where the state lives: the arrays below are views into them.
        self._features = np.zeros((num_agents, size, num_worlds))
        vectors = self._features.reshape(num_agents, -1, 2, num_worlds).transpose(2, 0, 1, 3)
        self._velocity = vectors[:, :, 0]                            # [2, N, W]
        self._position = vectors[:, :, 1]                            # [2, N, W]
        self._to_landmarks = vectors[:, :, 2:2 + num_landmarks]      # [2, N, L, W]
        self._to_others = vectors[:, :, 2 + num_landmarks:2 + num_landmarks + num_others]  # [2, N, N-1, W]
        self._own_features = self._features[:, size - own_features:]  # [N, own_features, W]
        self._landmarks = np.zeros((2, num_landmarks, num_worlds))
        self._first, self._second = np.triu_indices(num_agents, k=1)
        agents = np.arange(num_agents)
        self._others = np.array([agents[agents != agent] for agent in agents])[:, :num_others]

    @property
    def positions(self) -> np.ndarray:
        """Where the robots are, [W, N, 2], float64; a view that changes with the next step."""
        return self._position.transpose(2, 1, 0)

    @property
    def velocities(self) -> np.ndarray:
        """How fast the robots move, [W, N, 2] per s, float64; a view that changes with the next step."""
        return self._velocity.transpose(2, 1, 0)

    @property
    def landmarks(self) -> np.ndarray:
        """Where the landmarks are, [W, L, 2], float64; a view that changes with the next episode."""
        return self._landmarks.transpose(2, 1, 0)

    @property
    def targets(self) -> np.ndarray:
        """The N places the team should cover, [W, N, 2], float64."""
        return self._targets().transpose(2, 1, 0)

    @property
    def exact_observations(self) -> np.ndarray:
        """The observations before they are rounded to float32, [W, N, O]; a view that changes with the next step."""
        return self._features.transpose(2, 0, 1)

    def set_state(self, positions: np.ndarray, velocities: np.ndarray, landmarks: np.ndarray) -> None:
        """Put robots ([W, N, 2], [W, N, 2] per s) and landmarks ([W, L, 2]) somewhere, in the middle of an episode."""
        self.positions[...] = positions
        self.velocities[...] = velocities
        self.landmarks[...] = landmarks
        self._look()

    def begin(self, draw: np.random.Generator) -> None:
        num_agents = self.spec.num_agents
        uniform = draw.random((self.num_worlds, 2 * num_agents + self.num_landmark_draws)).T
        self._position[...] = 2.0 * uniform[:2 * num_agents].reshape(num_agents, 2, -1).transpose(1, 0, 2) - 1.0
        self._velocity[...] = 0.0
        self._place_landmarks(uniform[2 * num_agents:])
        self._look()

    def advance(self, actions: np.ndarray) -> None:
        force = np.take(ACTION_FORCE, actions.T, axis=1)
        self._add_contact_forces(force)
        force *= TIME_STEP
        self._velocity *= 1.0 - DAMPING
        self._velocity += force
        self._position += TIME_STEP * self._velocity
        self._look()

    def alternatives(self, actions: np.ndarray) -> np.ndarray:
        num_agents, num_actions = self.spec.num_agents, self.spec.num_actions
        copies, all_actions = self._copies, np.repeat(np.arange(num_actions), self.num_worlds)
        state = [np.tile(array, (num_actions, 1, 1)) for array in (self.positions, self.velocities, self.landmarks)]
        rewards = np.empty((num_agents, num_actions, self.num_worlds))
        # One agent after the other, so that the copies stay in the cache.
        for agent in range(num_agents):
            joint = np.tile(actions, (num_actions, 1))
            joint[:, agent] = all_actions
            copies.set_state(*state)
            copies.advance(joint)
            rewards[agent] = copies.reward().reshape(num_actions, self.num_worlds)
        return rewards

    @cached_property
    def _copies(self) -> ParticleWorlds:
        """Room for A copies of these worlds, to try actions in."""
        num_copies = self.spec.num_actions * self.num_worlds
        return type(self)(dataclasses.replace(self._task, num_worlds=num_copies, world_groups=1))

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        features = self._features.reshape(self.spec.state_size, self.num_worlds)
        state = np.empty((self.num_worlds, self.spec.state_size), dtype=np.float32)
        # In blocks, because a transposition that leaves the cache takes three times as long.
        for begin in range(0, self.num_worlds, WORLDS_AT_ONCE):
            block = slice(begin, begin + WORLDS_AT_ONCE)
            state[block] = features[:, block].astype(np.float32).T
        return state.reshape(self.num_worlds, self.spec.num_agents, self.spec.observation_size), state

    def _look(self) -> None:
        """Bring the observations up to date with `_position` and `_landmarks`."""
        own = self._position[:, :, None]
        np.subtract(self._landmarks[:, None], own, out=self._to_landmarks)
        if self._others.size:
            np.subtract(self._position[:, self._others], own, out=self._to_others)

    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """What separates the P pairs of robots: first - second [2, P, W] and its squared length [P, W]."""
        separation = self._position[:, self._first] - self._position[:, self._second]
        return separation, squared_length(separation)

    def _add_contact_forces(self, force: np.ndarray) -> None:
        """Add to `force` [2, N, W] what overlapping robots push each other with, a softened spring."""
        separation, squared = self._pairs()
        diameter = 2.0 * self.radius
        pair, world = np.nonzero(squared < (diameter + CONTACT_REACH * CONTACT_MARGIN) ** 2)
        if not pair.size:
            return
        distance = np.sqrt(squared[pair, world])
        overlap = CONTACT_MARGIN * np.logaddexp(0.0, (diameter - distance) / CONTACT_MARGIN)
        # Robots in the very same place have no direction to be pushed in, and stay.
        push = separation[:, pair, world] / np.maximum(distance, 1e-100) * (CONTACT_FORCE * overlap)
        for axis in range(2):
            np.add.at(force[axis], (self._first[pair], world), push[axis])
            np.subtract.at(force[axis], (self._second[pair], world), push[axis])

    @abstractmethod
    def _place_landmarks(self, uniform: np.ndarray) -> None:
        """Set `_landmarks` [2, L, W] from numbers in [0, 1), `num_landmark_draws` x W."""

    @abstractmethod
    def _targets(self) -> np.ndarray:
        """The places to cover, [2, N, W]."""


def squared_length(vectors: np.ndarray) -> np.ndarray:
    """Squared length, [...], of plane vectors [2, ...]."""
    return vectors[0] * vectors[0] + vectors[1] * vectors[1]
