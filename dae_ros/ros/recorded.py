"""The team's topics as a bag records them: names, types with their definitions, and quality of service."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from ament_index_python.packages import get_package_share_directory
from dae_ros_msgs import msg
from rclpy.qos import QoSProfile
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from dae_ros.replay.bag import rihs01
from dae_ros.replay.recording import Topic
from dae_ros.ros import names, qos

_FOREVER = QosTime(9223372036, 854775807)  # as rosbag2 writes a duration without limit


class RecordedTopic(NamedTuple):
    """A topic of the team and how to listen to it."""

    name: str  # relative
    kind: type
    profile: QoSProfile  # to listen with
    offered: QoSProfile  # by those who publish it
    stamped: bool        # whether it is a datum of a step


def rollout_topics(num_agents: int, world_groups: int) -> list[RecordedTopic]:
    """What rollouts are made of."""
    steps = [(names.JOINT_STATE, msg.JointState), (names.SHARED_REWARD, msg.SharedReward),
             *((names.ACTION.format(robot), msg.Action) for robot in range(num_agents))]
    return [_latched(names.ROLLOUT_REQUEST, msg.RolloutRequest),
            *(_step(topic, kind, group, world_groups) for topic, kind in steps for group in range(world_groups))]


def team_topics(num_agents: int, world_groups: int, everything: bool) -> list[RecordedTopic]:
    """What rollouts are made of, and how the training gets on; or all that the team says."""
    topics = [*rollout_topics(num_agents, world_groups), _latched(names.TRAINING_STATUS, msg.TrainingStatus)]
    if everything:
        observations = [_step(names.OBSERVATION.format(robot), msg.Observation, group, world_groups)
                        for robot in range(num_agents) for group in range(world_groups)]
        topics += [topic._replace(profile=qos.RECORDED_LATCHED, offered=qos.LATCHED) for topic in observations]
        topics += [_latched(names.POLICY, msg.PolicyWeights)]
    return topics


def _step(topic: str, kind: type, group: int, world_groups: int) -> RecordedTopic:
    return RecordedTopic(names.in_group(topic, group, world_groups), kind, qos.RECORDED, qos.ROLLOUT, True)


def _latched(topic: str, kind: type) -> RecordedTopic:
    return RecordedTopic(topic, kind, qos.RECORDED_LATCHED, qos.LATCHED, False)


def as_written(topic: RecordedTopic, full_name: str) -> Topic:
    """The topic for the bag."""
    kind = type_name(topic.kind)
    definition = definition_of(topic.kind)
    return Topic(full_name, kind, definition, rihs01(kind, 'ros2msg', definition), _qos(topic.offered))


def type_name(kind: type) -> str:
    """As in `std_msgs/msg/String`."""
    return f'{_package(kind)}/msg/{kind.__name__}'


def _package(kind: type) -> str:
    return kind.__module__.split('.')[0]


def definition_of(kind: type) -> str:
    """The message's file, comments and all, and those of the messages within it, as rosbag2 puts them together."""
    parts, wanted = [], [f'{_package(kind)}/{kind.__name__}']
    for name in wanted:
        package, message = name.split('/')
        text = (Path(get_package_share_directory(package)) / 'msg' / f'{message}.msg').read_text(encoding='utf-8')
        parts.append(text if not parts else f'{"=" * 80}\nMSG: {name}\n{text}')
        fields = re.findall(r'^\s*(?:(\w+)/)?([A-Z]\w*)(?:\[.*?\])?\s+\w+', text, re.MULTILINE)
        wanted += [inner for inner in (f'{other or package}/{field}' for other, field in fields) if inner not in wanted]
    return ''.join(parts)


def _qos(profile: QoSProfile) -> Qos:
    return Qos(QosHistory[profile.history.name], profile.depth, QosReliability[profile.reliability.name],
               QosDurability[profile.durability.name], _FOREVER, _FOREVER, QosLiveliness.SYSTEM_DEFAULT, _FOREVER, False)
