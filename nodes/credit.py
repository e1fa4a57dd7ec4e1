"""credit: tells each robot's difference reward step by step, by reward networks from a file; no trainer is needed.

    ros2 run dae_ros credit --ros-args -p reward_network_file:=runs/reward_network.safetensors
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any, Callable

import torch
from dae_ros_msgs import msg
from geometry_msgs.msg import Vector3Stamped

from dae_ros.config import CreditSettings, declarations
from dae_ros.errors import SettingsError
from dae_ros.learning.credit import Credit, CreditMeter
from dae_ros.learning.reward_files import load
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.ros.node import TeamNode, run


class CreditNode(TeamNode):
    """Wires a `CreditMeter` to what a team says: its world or task monitor, and its agents."""

    def __init__(self):
        super().__init__('credit', declarations(CreditSettings))
        if not self.settings['reward_network_file']:
            raise SettingsError('set reward_network_file to a file of train_reward')
        networks = load(Path(self.settings['reward_network_file']))
        self._meter = meter = CreditMeter(networks, self.settings['world'])
        robots = range(networks.spec.num_agents)
        self._credit = [self.publisher(Vector3Stamped, names.CREDIT.format(robot), qos.ROLLOUT) for robot in robots]
        self._join(msg.JointState, names.JOINT_STATE, convert.joint_state, meter.on_joint_state)
        self._join(msg.SharedReward, names.SHARED_REWARD, convert.shared_reward, meter.on_reward)
        for robot in robots:
            self._join(msg.Action, names.ACTION.format(robot), convert.action, meter.on_action)

    def _join(self, kind: type, topic: str, read: Callable[[Any], Any], take: Callable[[Any], Credit | None]) -> None:
        self.listen(kind, topic, qos.ROLLOUT, partial(self._tell, read, take))

    def _tell(self, read: Callable[[Any], Any], take: Callable[[Any], Credit | None], message: Any) -> None:
        credit = take(read(message))
        if credit is None:
            return
        for robot, publisher in enumerate(self._credit):
            for told in convert_robots.credit_messages(credit, robot, self.now(), 0.0):
                publisher.publish(told)

    def diagnose(self):
        meter = self._meter
        sentence = 'telling' if meter.steps else f'waiting for {self.silent_topics() or "a whole step"}'
        return sentence, {'steps': meter.steps, 'steps after a hole': meter.holes}


def main(args: list[str] | None = None) -> int:
    torch.set_num_threads(1)
    return run(CreditNode, args)


if __name__ == '__main__':
    sys.exit(main())
