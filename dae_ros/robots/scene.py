"""What there is to see of a team: where everybody is and was, who touches whom, what policies think of doing, who earns what."""

from __future__ import annotations

from collections import deque

import numpy as np

from dae_ros.rollout.lockstep import check_action
from dae_ros.types import Action
from dae_ros.worlds.particle import ACTION_FORCE

TRAIL = 100      # places of a robot that are remembered
TOUCHING = 1.02  # diameters; bodies that push each other apart come to stand at one


class Scene:
    """One team of a particle task; in m and rad, in the world frame. Trails begin anew when the landmarks lie elsewhere."""

    def __init__(self, num_robots: int, radius: float):
        self.radius = radius
        self.probabilities: dict[int, np.ndarray] = {}  # [A] of the last action heard of, by robot
        self.earned: dict[int, float] = {}              # the last difference reward heard of, by robot
        self.positions = self.targets = np.empty((0, 2))  # [N, 2]
        self.headings = np.empty(0)                       # [N]
        self.landmarks = np.empty((0, 2))                 # [L, 2]
        self.trails: list[deque[np.ndarray]] = [deque(maxlen=TRAIL) for _ in range(num_robots)]  # places [2], the oldest first
        self._first, self._second = np.triu_indices(num_robots, k=1)

    def on_action(self, action: Action) -> None:
        """Takes in what a robot does and might have done. Raises Refused."""
        check_action(action, len(self.trails), 1, ACTION_FORCE.shape[1], action.policy_version)
        self.probabilities[action.robot] = action.probabilities[0]

    def show(self, positions: np.ndarray, headings: np.ndarray, landmarks: np.ndarray, targets: np.ndarray) -> None:
        """Everybody is here now."""
        if not np.array_equal(landmarks, self.landmarks):
            for trail in self.trails:
                trail.clear()
        self.positions, self.headings, self.landmarks, self.targets = positions, headings, landmarks, targets
        for trail, position in zip(self.trails, positions):
            trail.append(position)

    @property
    def contacts(self) -> np.ndarray:
        """Where robots touch, [C, 2]."""
        first, second = self.positions[self._first], self.positions[self._second]
        touching = np.linalg.norm(first - second, axis=1) < TOUCHING * 2.0 * self.radius
        return 0.5 * (first + second)[touching]

    def thoughts(self, robot: int) -> np.ndarray:
        """The four directions a robot may accelerate in, each as long as it is probable, [4, 2]; zeros if nothing was heard."""
        probabilities = self.probabilities.get(robot, np.zeros(ACTION_FORCE.shape[1]))
        return (probabilities * np.sign(ACTION_FORCE))[:, 1:].T
