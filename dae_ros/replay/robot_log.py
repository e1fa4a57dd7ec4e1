"""What a bag tells of a team of robots, without any message of ours: odometry, velocity commands and landmarks over time."""

from __future__ import annotations

import functools
from collections import Counter
from pathlib import Path
from typing import Any, Mapping, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from dae_ros.errors import BagError, Refused, SettingsError
from dae_ros.replay.bag import Bag
from dae_ros.replay.mcap import Message
from dae_ros.robots import standard_messages
from dae_ros.robots.geometry import Pose, check_finite
from dae_ros.robots.motion import Command

ODOMETRY, POSES = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseArray'
COMMANDS = 'geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped'
AVERAGED = 25  # messages
FAR = 1e6      # s beyond the odometry


class Topics(NamedTuple):
    """Where a bag has what, by robot."""

    odometry: list[str]
    commands: list[str]
    landmarks: str


def topics(settings: Mapping[str, Any]) -> Topics:
    """The topics that settings name. Raises SettingsError where there is not one for each robot."""
    return Topics(_of_robots('odometry_topic', settings), _of_robots('command_topic', settings),
                  settings['landmarks_topic'].strip('/'))


def _of_robots(name: str, settings: Mapping[str, Any]) -> list[str]:
    text, num_agents = settings[name], settings['num_agents']
    found = [text.replace('{}', str(robot)) for robot in range(num_agents)] if '{}' in text else text.split()
    if len(found) != num_agents or len(set(found)) != num_agents:
        raise SettingsError(f'{name} must name a topic for each of {num_agents} robots, or have {{}} for the index, not {text!r}')
    return [topic.strip('/') for topic in found]


class Track(NamedTuple):
    """One robot's odometry: K measurements, one after the other."""

    times: np.ndarray     # [K] s
    moved: np.ndarray     # [K, 4] position in m and velocity in m/s, in the world frame
    headings: np.ndarray  # [K] rad, without jumps of 2 pi


class Told(NamedTuple):
    """What one robot was told: K commands, one after the other."""

    times: np.ndarray     # [K] s
    commands: list[Command]


class RobotLog:
    """One bag. Odometry goes by its own stamps; all else by when it was recorded, on the clock of those stamps.

    Messages that are damaged, not finite, in another frame or not later than the one before are counted in `skipped` by reason.
    """

    def __init__(self, path: Path, wanted: Topics, world_frame: str, skipped: Counter[str]):
        """Reads all of the bag. BagError if it is not one, or where it tells nothing of a robot."""
        self.landmarks: list[tuple[float, np.ndarray]] = []  # from when on, and where [L, 2] in m
        self.refusal = ''  # the first one in words
        self._world_frame = world_frame
        self._poses: list[list[Pose]] = [[] for _ in wanted.odometry]
        self._commands: list[list[tuple[float, Command]]] = [[] for _ in wanted.commands]
        self._clock: list[tuple[float, float]] = []  # when the first robot's odometry was recorded, and its stamps
        self._robots = {topic: robot for robot, topic in enumerate(wanted.odometry)}
        self._commanded = {topic: robot for robot, topic in enumerate(wanted.commands)}
        self._landmarks = wanted.landmarks
        there: dict[str, set[str]] = {}
        for message in Bag(path, skipped, lambda name, *_: name in (ODOMETRY, POSES, *COMMANDS)).messages():
            there.setdefault(message.type, set()).add(message.topic)
            try:
                self._take(message)
            except Refused as refusal:
                self.refusal = self.refusal or refusal.detail
                skipped[refusal.reason] += 1
        self._check(there)
        self.tracks = [_track(poses) for poses in self._poses]
        self.told, self.landmarks = self._on_the_stamps_clock()

    def _take(self, message: Message) -> None:
        topic, time = message.topic.strip('/'), message.time / standard_messages.NANOSECONDS
        if message.type == ODOMETRY and topic in self._robots:
            robot = self._robots[topic]
            self._take_pose(robot, standard_messages.odometry(_decoded(message), self._world_frame))
            if robot == 0:
                self._clock.append((time, self._poses[0][-1].time))
        elif message.type in COMMANDS and topic in self._commanded:
            self._commands[self._commanded[topic]].append((time, standard_messages.command(_decoded(message))))
        elif message.type == POSES and topic == self._landmarks:
            landmarks = standard_messages.landmarks(_decoded(message), self._world_frame)
            if not np.isfinite(landmarks).all():
                raise Refused(Refused.NOT_FINITE, 'a landmark is not finite')
            self.landmarks.append((time, landmarks))

    def _take_pose(self, robot: int, pose: Pose) -> None:
        check_finite(pose)
        if self._poses[robot] and pose.time <= self._poses[robot][-1].time:
            raise Refused(Refused.STALE, 'odometry that is not later than the one before')
        self._poses[robot].append(pose)

    def _check(self, there: dict[str, set[str]]) -> None:
        """BagError, saying what there is instead, where a robot's odometry or commands are missing."""
        for what, wanted, found, kinds in (('odometry', self._robots, self._poses, {ODOMETRY}),
                                           ('velocity commands', self._commanded, self._commands, set(COMMANDS))):
            others = sorted(topic for kind in kinds for topic in there.get(kind, ()))
            for topic, robot in wanted.items():
                if found[robot]:
                    continue
                if topic in (other.strip('/') for other in others):
                    raise BagError(f'no {what} on {topic} can be used: {self.refusal}')
                raise BagError(f'there is no message with {what} on {topic}, only on {", ".join(others)}' if others else
                               f'there is no message of {" or ".join(sorted(kinds))}')

    def _on_the_stamps_clock(self) -> tuple[list[Told], list[tuple[float, np.ndarray]]]:
        """Commands and landmarks, by when they were recorded on the clock of the odometry's stamps."""
        known = np.array(sorted(self._clock))
        elapsed = known[-1] - known[0]
        beyond = FAR * np.array([1.0, elapsed[1] / elapsed[0] if elapsed[0] else 1.0])
        # Messages are not all under way for equally long.
        medians = [np.median(known[begin:begin + AVERAGED], axis=0) for begin in range(0, len(known), AVERAGED)]
        clock = np.array([medians[0] - beyond, *medians, medians[-1] + beyond])

        def on_clock(entries: list[tuple[float, Any]]) -> list[tuple[float, Any]]:
            times = np.interp([time for time, _ in entries], *clock.T).tolist()
            return sorted(zip(times, (value for _, value in entries)), key=lambda entry: entry[0])

        told = [on_clock(entries) for entries in self._commands]
        return ([Told(np.array([time for time, _ in entries]), [command for _, command in entries]) for entries in told],
                on_clock(self.landmarks))


def _track(poses: list[Pose]) -> Track:
    return Track(np.array([pose.time for pose in poses]), np.array([(*pose.position, *pose.velocity) for pose in poses]),
                 np.unwrap([pose.heading for pose in poses]))


@functools.lru_cache
def _typestore():
    return get_typestore(Stores.ROS2_JAZZY)


def _decoded(message: Message) -> Any:
    try:
        return _typestore().deserialize_cdr(message.data, message.type)
    except SerdeError as error:
        raise Refused(Refused.CORRUPT, f'{len(message.data)} bytes that are no {message.type}') from error
