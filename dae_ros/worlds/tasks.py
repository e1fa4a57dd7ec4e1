"""The particle tasks: cooperative navigation, formation control and line control.

Navigation is from Lowe et al. (NeurIPS 2017), formation and line from Agarwal et al. (2019); sizes, placing and rewards
are those the paper's experiments use.
"""

from __future__ import annotations

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.worlds.matching import match
from dae_ros.worlds.particle import ParticleWorlds, squared_length

LONGEST_PENALTY = 2.0  # distance beyond which a robot of a formation or line costs no more


class Navigation(ParticleWorlds):
    """N robots cover N landmarks without touching. Observation 6N numbers, the last 2(N - 1) unused (zeros)."""

    radius = 0.15

    def __init__(self, task: TaskSettings):
        num_agents = task.num_agents
        super().__init__(task, num_agents, observe_others=True, own_features=2 * (num_agents - 1))
        self.num_landmark_draws = 2 * num_agents

    def _place_landmarks(self, uniform: np.ndarray) -> None:
        self._landmarks[...] = 0.8 * (2.0 * uniform.reshape(-1, 2, self.num_worlds).transpose(1, 0, 2) - 1.0)

    def _targets(self) -> np.ndarray:
        return self._landmarks

    def reward(self) -> np.ndarray:
        """-N * sum over landmarks of the nearest robot's distance - N - 2 * pairs closer than two radii."""
        num_agents = self.spec.num_agents
        nearest = np.sqrt(squared_length(self._to_landmarks).min(axis=0))
        touching = (np.sqrt(self._pairs()[1]) < 2.0 * self.radius).sum(axis=0)
        return -num_agents * in_order_sum(nearest) - num_agents - 2.0 * touching


class MatchingTask(ParticleWorlds):
    """A task whose reward is -mean(min(d, 2)) over the distances d of the best matching of robots and targets."""

    def reward(self) -> np.ndarray:
        distance = np.sqrt(squared_length(self._targets()[:, None] - self._position[:, :, None]))
        robots, worlds = np.arange(self.spec.num_agents)[:, None], np.arange(self.num_worlds)
        matched = distance[robots, match(distance), worlds]
        return -in_order_sum(np.minimum(matched, LONGEST_PENALTY)) / self.spec.num_agents


class Formation(MatchingTask):
    """N robots spread evenly on a circle of radius 0.5 around a landmark. Observation 6 numbers, with others 2N + 4."""

    radius = 0.05
    circle_radius = 0.5
    num_landmark_draws = 2

    def __init__(self, task: TaskSettings):
        super().__init__(task, num_landmarks=1, observe_others=task.observe_others)
        angles = 2.0 * np.pi * np.arange(task.num_agents) / task.num_agents
        self._cosines, self._sines = np.cos(angles)[:, None], np.sin(angles)[:, None]

    def _place_landmarks(self, uniform: np.ndarray) -> None:
        self._landmarks[:, 0] = uniform - 0.5

    def _targets(self) -> np.ndarray:
        """The circle's places, the first in the direction of the robot with the smallest angle in [0, 2 pi)."""
        x, y = -self._to_landmarks[:, :, 0]
        x += (x == 0.0) & (y == 0.0)  # a robot in the very centre counts as at angle 0
        span = np.abs(x) + np.abs(y)
        x, y = x / span, y / span
        # 1 - x from 0 to 2 above the landmark, 3 + x from 2 to 4 below it, grow with the angle without trigonometry.
        first, worlds = np.argmin(np.where(y < 0.0, 3.0 + x, 1.0 - x), axis=0), np.arange(self.num_worlds)
        x, y = x[first, worlds], y[first, worlds]
        scale = self.circle_radius / np.sqrt(x * x + y * y)
        x, y = x * scale, y * scale
        return self._landmarks + np.stack([x * self._cosines - y * self._sines, x * self._sines + y * self._cosines])


class Line(MatchingTask):
    """N robots spread evenly between two landmarks, both ends included. Observation 8 numbers, with others 2N + 6."""

    radius = 0.03
    length = 1.25
    num_landmark_draws = 3

    def __init__(self, task: TaskSettings):
        super().__init__(task, num_landmarks=2, observe_others=task.observe_others)
        num_agents = task.num_agents
        self._shares = (np.arange(num_agents) / max(num_agents - 1, 1))[None, :, None]

    def _place_landmarks(self, uniform: np.ndarray) -> None:
        start = 0.5 * uniform[:2] - 0.25
        angle = 2.0 * np.pi * uniform[2]
        end = start + self.length * np.stack([np.cos(angle), np.sin(angle)])
        while (outside := np.flatnonzero((np.abs(end) >= 1.0).any(axis=0))).size:
            angle[outside] += np.radians(5.0)
            turned = angle[outside]
            end[:, outside] = start[:, outside] + self.length * np.stack([np.cos(turned), np.sin(turned)])
        self._landmarks[:, 0], self._landmarks[:, 1] = start, end

    def _targets(self) -> np.ndarray:
        start, end = self._landmarks[:, :1], self._landmarks[:, 1:]
        return start + self._shares * (end - start)


def in_order_sum(rows: np.ndarray) -> np.ndarray:
    """Sum [W] of rows [N, W], always in the order of the rows: NumPy's own sum takes another when W is 1."""
    total = rows[0].copy()
    for row in rows[1:]:
        total += row
    return total
