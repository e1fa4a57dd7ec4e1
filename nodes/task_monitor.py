"""task_monitor: tells state and reward of a team of robots, from their odometry, and shows it; training needs no simulator.

    ros2 run dae_ros task_monitor --ros-args -p task:=navigation -p num_agents:=3 -p run:=<the trainer's>
"""

from __future__ import annotations

import sys
from functools import partial

from dae_ros_msgs import msg
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Odometry

from dae_ros.config import BodySettings, BridgeSettings, RunBinding, TaskSettings, declarations
from dae_ros.robots import standard_messages
from dae_ros.robots.pilot import LOOKS, without
from dae_ros.robots.scene import Scene
from dae_ros.robots.setup import make_watch
from dae_ros.ros import convert, names, qos
from dae_ros.ros.markers import Display
from dae_ros.ros.node import TeamNode, run
from dae_ros.types import JointState


class TaskMonitorNode(TeamNode):
    """Wires a `Watch` to the team's odometry and the trainer."""

    def __init__(self):
        super().__init__('task_monitor', declarations(TaskSettings, BodySettings, BridgeSettings, RunBinding))
        settings = self.settings
        self._watch, self._world_frame = make_watch(settings), settings['world_frame']
        self._joint_state = self.publisher(msg.JointState, names.JOINT_STATE, qos.ROLLOUT)
        self._shared_reward = self.publisher(msg.SharedReward, names.SHARED_REWARD, qos.ROLLOUT)
        for robot in range(settings['num_agents']):
            self.listen(Odometry, names.ODOMETRY.format(robot), qos.WATCHED, partial(self._on_odometry, robot), raw=True)
        self.listen(PoseArray, names.LANDMARKS, qos.LATCHED_INPUT, self._on_landmarks)
        self.as_time_goes_on(1.0 / (LOOKS * settings['control_rate']), self._look, qos.WATCHED)
        self._scene = Scene(settings['num_agents'], self._watch.radius)
        self._display = Display(self, self._scene, self._world_frame, self._show)

    def _on_odometry(self, robot: int, data: bytes) -> None:
        now = self.now()
        if now:
            self._watch.tracks[robot].take(standard_messages.odometry_in(data, self._world_frame)[0], now)

    def _on_landmarks(self, message: PoseArray) -> None:
        self._watch.on_landmarks(standard_messages.landmarks(message, self._world_frame))

    def _look(self) -> None:
        for seen in self._watch.look(self.now()):
            if isinstance(seen, JointState):
                self._joint_state.publish(convert.joint_state_message(seen, state_is_observations=True))
            else:
                self._shared_reward.publish(convert.shared_reward_message(seen))

    def _show(self, now: float) -> bool:
        """Shows the team, unless our simulator plays it and does so itself."""
        if self._watch.blind_for(now) or self.count_publishers(names.MARKERS) != 1:
            return False
        self._watch.show(self._scene, now)
        return True

    def diagnose(self):
        now = self.now()
        blind, lost = self._watch.blind_for(now), self._watch.lost(now)
        self.is_in_trouble = bool(blind or lost)
        return f'waiting for {blind}' if blind else f'watching{without(lost)}', {}


def main(args: list[str] | None = None) -> int:
    return run(TaskMonitorNode, args)


if __name__ == '__main__':
    sys.exit(main())
