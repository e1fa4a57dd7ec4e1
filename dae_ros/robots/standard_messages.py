"""The standard messages that robots speak as what the library works with, whether ROS or a bag's reader made the objects."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np

from dae_ros.errors import Refused
from dae_ros.robots.geometry import Pose, heading_of, quaternion_of, turned
from dae_ros.robots.motion import Command

NANOSECONDS = 1_000_000_000

_LITTLE_ENDIAN, _ENCAPSULATION = b'\x00\x01', 4  # how serialised messages begin; alignment does not count these bytes
_TIME, _LENGTH = struct.Struct('<iI'), struct.Struct('<I')
_NUMBERS = struct.Struct('<7d288x2d320x')  # pose, its covariance, the twist's x and y, the rest of it and its covariance
_WRITTEN = struct.Struct('<7d288x2d24xd288x')  # the same with the twist's turn about z


def seconds(time: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return time.sec + time.nanosec / NANOSECONDS


def second_and_nanosecond(time: float) -> tuple[int, int]:
    """A time [s] as a builtin_interfaces/Time has it."""
    return divmod(round(time * NANOSECONDS), NANOSECONDS)


def odometry(message: Any, world_frame: str) -> Pose:
    """Pose in the world frame, which the nav_msgs/Odometry must be in. Its twist is in `child_frame_id`, the robot's body as a
    rule. Raises Refused."""
    place, turn, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    return _pose(message.header.frame_id, message.child_frame_id, (place.x, place.y), (turn.x, turn.y, turn.z, turn.w),
                 (speed.x, speed.y), seconds(message.header.stamp), world_frame)


def odometry_in(data: bytes, world_frame: str) -> tuple[Pose, str]:
    """The same of a serialised nav_msgs/Odometry, and the frame of its twist. Raises Refused.

    To have the message made, with its 72 covariances of which nothing is needed, takes fifteen times as long.
    """
    if data[:2] != _LITTLE_ENDIAN:
        raise Refused(Refused.CORRUPT, 'odometry that is not serialised as little-endian CDR')
    try:
        second, nanosecond = _TIME.unpack_from(data, _ENCAPSULATION)
        frame, end = _text(data, _ENCAPSULATION + _TIME.size)
        child_frame, end = _text(data, end + (_ENCAPSULATION - end) % _LENGTH.size)
        numbers = _NUMBERS.unpack_from(data, end + (_ENCAPSULATION - end) % 8)
    except (struct.error, UnicodeDecodeError) as error:
        raise Refused(Refused.CORRUPT, f'{len(data)} bytes that are no odometry') from error
    pose = _pose(frame, child_frame, numbers[0:2], numbers[3:7], numbers[7:9], second + nanosecond / NANOSECONDS, world_frame)
    return pose, child_frame


def odometry_data(pose: Pose, turn: float, world_frame: str, body_frame: str) -> bytes:
    """A serialised nav_msgs/Odometry, with its twist in the body's frame and covariances of 0; `turn` in rad/s."""
    data = bytearray(_LITTLE_ENDIAN + b'\x00\x00' + _TIME.pack(*second_and_nanosecond(pose.time)))
    for text, alignment in ((world_frame, _LENGTH.size), (body_frame, 8)):
        characters = text.encode() + b'\x00'
        data += _LENGTH.pack(len(characters)) + characters
        data += bytes((_ENCAPSULATION - len(data)) % alignment)
    velocity = turned(pose.velocity, -pose.heading)
    return bytes(data + _WRITTEN.pack(*pose.position, 0.0, *quaternion_of(pose.heading), *velocity, turn))


def _text(data: bytes, begin: int) -> tuple[str, int]:
    """The text that lies there, and where it ends."""
    (length,) = _LENGTH.unpack_from(data, begin)
    begin += _LENGTH.size
    return bytes(data[begin:begin + length - 1]).decode(), begin + length


def _pose(frame: str, child_frame: str, place: tuple[float, float], turn: tuple[float, float, float, float],
          velocity: tuple[float, float], time: float, world_frame: str) -> Pose:
    _check_frame(frame, world_frame)
    heading = heading_of(*turn)
    return Pose(place, heading, velocity if child_frame == world_frame else turned(velocity, heading), time)


def landmarks(message: Any, world_frame: str) -> np.ndarray:
    """Positions [L, 2] in m, in the world frame, which the geometry_msgs/PoseArray must be in. Raises Refused."""
    _check_frame(message.header.frame_id, world_frame)
    return np.array([(pose.position.x, pose.position.y) for pose in message.poses], np.float64).reshape(-1, 2)


def command(message: Any) -> Command:
    """What a geometry_msgs/Twist or TwistStamped tells a robot. Raises Refused where it is not finite."""
    twist = getattr(message, 'twist', message)
    found = Command(twist.linear.x, twist.linear.y, twist.angular.z)
    if not all(map(math.isfinite, found)):
        raise Refused(Refused.NOT_FINITE, 'a velocity is not finite')
    return found


def _check_frame(frame: str, expected: str) -> None:
    if frame != expected:
        raise Refused(Refused.WRONG_FRAME, f'frame_id {frame!r}, expected {expected!r}')
