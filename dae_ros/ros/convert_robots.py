"""Makes the standard messages that robots speak; `dae_ros.robots.standard_messages` reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Iterator

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseArray, Quaternion, TransformStamped, Twist, TwistStamped, Vector3, Vector3Stamped
from geometry_msgs.msg import Pose as PoseMessage

from dae_ros.robots.geometry import Pose, quaternion_of
from dae_ros.robots.motion import Command
from dae_ros.robots.standard_messages import second_and_nanosecond

if TYPE_CHECKING:
    from dae_ros.learning.credit import Credit


def time_message(time: float) -> Time:
    second, nanosecond = second_and_nanosecond(time)
    return Time(sec=second, nanosec=nanosecond)


def transform_message(pose: Pose, world_frame: str, body_frame: str) -> TransformStamped:
    message = TransformStamped(child_frame_id=body_frame)
    message.header.frame_id, message.header.stamp = world_frame, time_message(pose.time)
    message.transform.translation = Vector3(x=pose.position[0], y=pose.position[1])
    message.transform.rotation = pose_message(pose.position, pose.heading).orientation
    return message


def pose_message(position: Any, heading: float = 0.0) -> PoseMessage:
    x, y, z, w = quaternion_of(heading)
    return PoseMessage(position=Point(x=float(position[0]), y=float(position[1])), orientation=Quaternion(x=x, y=y, z=z, w=w))


def landmarks_message(positions: np.ndarray, time: float, world_frame: str) -> PoseArray:
    """`positions`: [L, 2] in m."""
    message = PoseArray(poses=[pose_message(position) for position in positions])
    message.header.frame_id, message.header.stamp = world_frame, time_message(time)
    return message


def command_message(command: Command, stamped: bool, time: float, body_frame: str) -> Twist | TwistStamped:
    twist = Twist(linear=Vector3(x=command.forward, y=command.left), angular=Vector3(z=command.turn))
    if not stamped:
        return twist
    message = TwistStamped(twist=twist)
    message.header.frame_id, message.header.stamp = body_frame, time_message(time)
    return message


def credit_messages(credit: Credit, robot: int, begin: float, period: float) -> Iterator[Vector3Stamped]:
    """A robot's credit of each step: x the team's reward, y the robot's difference reward, z its advantage; nan where not known.

    The steps are `period` [s] apart, from `begin` [s] on.
    """
    unknown = np.full(len(credit.rewards), np.nan)
    ys, zs = (unknown if part is None else part[:, robot] for part in (credit.differences, credit.advantages))
    for step, (x, y, z) in enumerate(zip(credit.rewards, ys, zs)):
        message = Vector3Stamped(vector=Vector3(x=float(x), y=float(y), z=float(z)))
        message.header.stamp = time_message(begin + step * period)
        yield message
