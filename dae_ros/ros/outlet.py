"""Publishers for what a bag holds: the types and the quality of service it was recorded with, messages as bytes."""

from __future__ import annotations

from importlib import import_module
from typing import Callable

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from dae_ros.errors import BagError
from dae_ros.replay.bag import rihs01
from dae_ros.ros.recorded import definition_of

DEPTH = 10     # where the bag does not tell: discovery does not know the depth that a stranger publishes with
DEEPEST = 512  # messages of a topic that may be under way
PATIENCE = Duration(seconds=0.1)  # between two looks whether to go on


def message_class(name: str) -> type | None:
    """The class of a message type, as in `std_msgs/msg/String`; None where it is not installed."""
    package, _, kind = name.split('/') if name.count('/') == 2 else ('', '', '')
    try:
        return getattr(import_module(f'{package}.msg'), kind)
    except (ImportError, AttributeError, ValueError):
        return None


def playable(name: str, encoding: str, definition: str) -> bool:
    """An `Accept`: types that are installed here. Raises BagError if the bag's definition is another one."""
    kind = message_class(name)
    if kind is None:
        return False
    if definition and rihs01(name, encoding, definition) != rihs01(name, 'ros2msg', definition_of(kind)):
        raise BagError(f'it was recorded with another version of {name} than is installed here')
    return True


def recorded_profile(text: str) -> QoSProfile:
    """The quality of service a topic was offered with, which is the first where there were several publishers."""
    try:
        found = parse_qos(text)
    except (ReaderError, KeyError, TypeError) as error:
        raise BagError(f'the quality of service in the bag cannot be understood: {text[:200]!r}') from error
    qos = found[0] if found else None
    return QoSProfile(
        history=_policy(HistoryPolicy, qos, 'history', HistoryPolicy.KEEP_LAST), depth=qos.depth if qos and qos.depth else DEPTH,
        reliability=_policy(ReliabilityPolicy, qos, 'reliability', ReliabilityPolicy.RELIABLE),
        durability=_policy(DurabilityPolicy, qos, 'durability', DurabilityPolicy.VOLATILE))


def _policy(kind, qos: Qos | None, name: str, default):
    """One of the policies; the default where the bag says nothing that can be offered."""
    policy = kind.__members__.get(getattr(qos, name).name) if qos else None
    return default if policy in (None, kind.SYSTEM_DEFAULT, kind.UNKNOWN) else policy


class Outlet:
    """One topic. With `going_on`, no more is under way than the queue holds: what follows waits for its acknowledgement."""

    def __init__(self, publisher: Publisher, profile: QoSProfile, going_on: Callable[[], bool] | None):
        self.publisher = publisher
        self._going_on = going_on
        self._limit = DEEPEST if profile.history == HistoryPolicy.KEEP_ALL else max(1, min(profile.depth // 2, DEEPEST))
        self._under_way = 0

    def publish(self, data: bytes) -> None:
        """Sends a serialized message."""
        if self._going_on is not None and self._under_way >= self._limit:
            self.wait_until_acknowledged(self._going_on)
        self.publisher.publish(data)
        self._under_way += 1

    def wait_until_acknowledged(self, going_on: Callable[[], bool]) -> None:
        """Returns when every subscriber has taken in what was sent, or `going_on` no longer holds."""
        while going_on() and not self.publisher.wait_for_all_acked(PATIENCE):
            pass
        self._under_way = 0
