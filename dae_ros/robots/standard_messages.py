"""The standard messages that robots speak as what the library works with, whether ROS or a bag's reader made the objects."""

from __future__ import annotations

from typing import Any

import numpy as np

from dae_ros.errors import Refused
from dae_ros.robots.geometry import Pose, heading_of, turned
from dae_ros.robots.motion import Command

NANOSECONDS = 1_000_000_000


def seconds(time: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return time.sec + time.nanosec / NANOSECONDS


def odometry(message: Any, world_frame: str) -> Pose:
    """Pose in the world frame, which the nav_msgs/Odometry must be in. Its twist is in `child_frame_id`, the robot's body as a
    rule. Raises Refused."""
    _check_frame(message.header.frame_id, world_frame)
    place, orientation, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    heading = heading_of(orientation.x, orientation.y, orientation.z, orientation.w)
    velocity = speed.x, speed.y
    if message.child_frame_id != world_frame:
        velocity = turned(velocity, heading)
    return Pose((place.x, place.y), heading, velocity, seconds(message.header.stamp))


def landmarks(message: Any, world_frame: str) -> np.ndarray:
    """Positions [L, 2] in m, in the world frame, which the geometry_msgs/PoseArray must be in. Raises Refused."""
    _check_frame(message.header.frame_id, world_frame)
    return np.array([(pose.position.x, pose.position.y) for pose in message.poses], np.float64).reshape(-1, 2)


def command(message: Any) -> Command:
    """What a geometry_msgs/Twist or TwistStamped tells a robot. Raises Refused where it is not finite."""
    twist = getattr(message, 'twist', message)
    found = Command(twist.linear.x, twist.linear.y, twist.angular.z)
    if not np.isfinite(found).all():
        raise Refused(Refused.NOT_FINITE, 'a velocity is not finite')
    return found


def _check_frame(frame: str, expected: str) -> None:
    if frame != expected:
        raise Refused(Refused.WRONG_FRAME, f'frame_id {frame!r}, expected {expected!r}')
