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


def team_topics(num_agents: int, world_groups: int, everything: bool) -> list[RecordedTopic]:
    """What rollouts are made of, or all that the team says."""
    def step(topic: str, kind: type) -> list[RecordedTopic]:
        return [RecordedTopic(names.in_group(topic, group, world_groups), kind, qos.RECORDED, qos.ROLLOUT, True)
                for group in range(world_groups)]

    def latched(topic: str, kind: type) -> RecordedTopic:
        return RecordedTopic(topic, kind, qos.RECORDED_LATCHED, qos.LATCHED, False)

    robots = range(num_agents)
    topics = [latched(names.ROLLOUT_REQUEST, msg.RolloutRequest), latched(names.TRAINING_STATUS, msg.TrainingStatus),
              *step(names.JOINT_STATE, msg.JointState), *step(names.SHARED_REWARD, msg.SharedReward),
              *(topic for robot in robots for topic in step(names.ACTION.format(robot), msg.Action))]
    if everything:
        observations = (step(names.OBSERVATION.format(robot), msg.Observation) for robot in robots)
        topics += [topic._replace(profile=qos.RECORDED_LATCHED, offered=qos.LATCHED) for found in observations for topic in found]
        topics += [latched(names.POLICY, msg.PolicyWeights)]
    return topics


def as_written(topic: RecordedTopic, full_name: str) -> Topic:
    """The topic for the bag."""
    kind = f'{_package(topic.kind)}/msg/{topic.kind.__name__}'
    definition = definition_of(topic.kind)
    return Topic(full_name, kind, definition, rihs01(kind, 'ros2msg', definition), _qos(topic.offered))


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
