"""A task of one's own for robots in the plane: robot 0 has to get to the landmark, and the others have to keep around it.

    bringup -p task:=particle:examples.escort -p num_agents:=4
"""

from __future__ import annotations

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.worlds.particle import ParticleWorlds, squared_length
from dae_ros.worlds.tasks import in_order_sum


class Escort(ParticleWorlds):
    """Arrays are [2, ..., W], x before y, the worlds last, so that all of them are computed at once.

    An observation is what all particle tasks show (velocity, position, landmark - position, others - position) and two numbers
    more: robot 0 - position, which are zeros for robot 0 itself and so tell it what it is.
    """

    radius = 0.1             # of a robot, in task units
    circle = 0.4             # radius of the guards' circle
    num_landmark_draws = 2   # uniform numbers that `_place_landmarks` needs

    def __init__(self, task: TaskSettings):
        if task.num_agents < 2:
            raise SettingsError('an escort needs a guard: set num_agents to 2 or more')
        super().__init__(task, num_landmarks=1, observe_others=True, own_features=2)
        self._num_guards = task.num_agents - 1
        angles = 2.0 * np.pi * np.arange(self._num_guards) / self._num_guards
        self._places = self.circle * np.stack([np.cos(angles), np.sin(angles)])[:, :, None]  # [2, guards, 1]

    def _place_landmarks(self, uniform: np.ndarray) -> None:
        """Where the landmark of an episode lies; `uniform` [2, W] in [0, 1). Robots begin anywhere in -1 .. 1."""
        self._landmarks[:, 0] = 1.6 * uniform - 0.8

    def _look(self) -> None:
        """What the robots observe, whenever something has moved."""
        super()._look()
        self._own_features[...] = (self._position[:, :1] - self._position).transpose(1, 0, 2)

    def _targets(self) -> np.ndarray:
        """Where the robots should be [2, N, W]; for pictures, markers and the greedy team that a trained one is held against."""
        return np.concatenate([self._landmarks, self._position[:, :1] + self._places], axis=1)

    def reward(self) -> np.ndarray:
        """What the team earns in a step [W]: minus robot 0's way to go, minus the mean distance from a place around it to the
        nearest guard."""
        to_go = np.sqrt(squared_length(self._to_landmarks[:, 0, 0]))
        places, guards = self._position[:, :1] + self._places, self._position[:, 1:]
        distances = squared_length(places[:, :, None] - guards[:, None])  # [places, guards, W]
        return -to_go - in_order_sum(np.sqrt(distances.min(axis=1))) / self._num_guards
