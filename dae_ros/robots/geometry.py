"""Poses in the plane: quaternions to headings, vectors between a robot's body and the world, metres to task units.

Frames are right-handed, x forward and y to the left in a body; angles in rad, counter-clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Sequence

import numpy as np

from dae_ros.errors import Refused

UNIT_TOLERANCE = 0.01  # a quaternion off by more is not one that was merely rounded


class Pose(NamedTuple):
    """Where a robot is and how it moves, in the world frame; SI units."""

    position: tuple[float, float]  # m
    heading: float                 # rad, in -pi .. pi
    velocity: tuple[float, float]  # m/s
    time: float                    # s, of the measurement


def check_finite(pose: Pose) -> None:
    """Refuses a pose with a value that is not a finite number."""
    if not all(map(math.isfinite, (*pose.position, pose.heading, *pose.velocity))):
        raise Refused(Refused.NOT_FINITE, 'odometry is not finite')


def heading_of(x: float, y: float, z: float, w: float) -> float:
    """The heading (yaw) [rad] of a unit quaternion. Raises Refused if it is none, as one that nobody filled in."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) <= UNIT_TOLERANCE:
        raise Refused(Refused.OUT_OF_RANGE, f'a quaternion of length {norm:.3g}, not 1')
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def quaternion_of(heading: float) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) of a heading [rad]."""
    return 0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading)


def turned(vector: tuple[float, float], angle: float) -> tuple[float, float]:
    """`vector` turned by `angle` [rad]: from body to world by the heading, and back by its negative."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]


def wrapped(angle: float) -> float:
    """The same angle in -pi .. pi."""
    return math.remainder(angle, 2.0 * math.pi)


class TaskFrame(NamedTuple):
    """How the task's plane lies in the robots' world: where its origin is, how long its unit and its second are."""

    scale: float = 1.0                        # m per task unit
    origin: tuple[float, float] = (0.0, 0.0)  # m
    slowness: float = 1.0                     # s per second of the task

    def positions(self, metres: np.ndarray) -> np.ndarray:
        """Positions [..., 2] in task units."""
        return (np.asarray(metres, np.float64) - self.origin) / self.scale

    def metres(self, positions: np.ndarray) -> np.ndarray:
        """Positions [..., 2] in the robots' world, in m, of those in task units."""
        return np.asarray(positions, np.float64) * self.scale + self.origin

    def placed(self, poses: Sequence[Pose], landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [N, 2] and velocities [N, 2] of robots with these poses, and landmarks [L, 2] given in m, in task units."""
        return (self.positions([pose.position for pose in poses]), self.velocities([pose.velocity for pose in poses]),
                self.positions(landmarks))

    def velocities(self, metres_per_second: np.ndarray) -> np.ndarray:
        """Velocities [..., 2] in task units per second of the task."""
        return np.asarray(metres_per_second, np.float64) * (self.slowness / self.scale)
