"""robot_bridge: lets the agent of one robot drive it: odometry to observation, action to cmd_vel, and a stop when in doubt.

    ros2 run dae_ros robot_bridge --ros-args -p robot:=0 -p task:=navigation -r robot_0/cmd_vel:=/tb3_0/cmd_vel
"""

from __future__ import annotations

import signal
import sys
import threading
from functools import partial
from typing import Callable

import rclpy
from dae_ros_msgs import msg
from dae_ros_nodes.robot_agent import RobotAgentNode
from geometry_msgs.msg import PoseArray, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from std_srvs.srv import SetBool

from dae_ros.config import AgentSettings, BodySettings, BridgeSettings, RunBinding, TaskSettings, declarations
from dae_ros.errors import Refused, SettingsError
from dae_ros.robots import standard_messages
from dae_ros.robots.motion import STOP, Command
from dae_ros.robots.pilot import LOOKS, Turn, without
from dae_ros.robots.safety import Stop
from dae_ros.robots.setup import landmarks_in, make_pilot
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.ros.node import TeamNode, run_together
from dae_ros.types import Action, Observation

DECLARED = [*declarations(AgentSettings, TaskSettings, BodySettings, BridgeSettings, RunBinding)]
LAST_WORD = Duration(seconds=0.5)  # for the last command to arrive


class RobotBridgeNode(TeamNode):
    """Wires a `Pilot` to the topics of its robot and the team's odometry."""

    def __init__(self, name: str = 'robot_bridge', agent: RobotAgentNode | None = None, clock_of: TeamNode | None = None,
                 **given: int):
        """Hears nothing before a bridge of this process `listen_for`s it. `agent`: the robot's, where it is in this process; it
        is asked directly, and the network is told what both say when all robots of the process know what to do."""
        super().__init__(name, DECLARED, clock_of, **given)
        self._agent = agent
        self._bridges: list[RobotBridgeNode] = []  # that this one listens for
        self._listener = self
        self._untold: tuple[Observation, Action | None] | None = None
        settings = self.settings
        robot, self._world_frame, self._stamped = settings['robot'], settings['world_frame'], settings['stamped']
        self._body_frame = ''
        self._sending, self._ended = threading.Lock(), False
        self._pilot = make_pilot(settings)
        self._commands = self.publisher(TwistStamped if self._stamped else Twist, names.COMMAND.format(robot), qos.NEWEST)
        self._observations = self.publisher(msg.Observation, names.OBSERVATION.format(robot), qos.LATCHED)
        if settings['landmarks']:
            self._take_landmarks(settings['landmarks'])
        if agent is None:
            self.listen(msg.Action, names.ACTION.format(robot), qos.EVENTS, lambda message: self._obey(convert.action(message)))
        self.create_service(SetBool, names.ENABLE, self._on_enable)

    def listen_for(self, bridges: list[RobotBridgeNode]) -> None:
        """Hears the clock and what the team's robots show, for the bridges of one process; this one is among them."""
        self._bridges = bridges
        for bridge in bridges:
            bridge._listener = self
        for robot in range(self.settings['num_agents']):
            self.listen(Odometry, names.ODOMETRY.format(robot), qos.NOW, partial(self._on_odometry, robot), raw=True)
        if not self.settings['landmarks']:
            self.listen(PoseArray, names.LANDMARKS, qos.LATCHED_INPUT, self._on_landmarks)
        self.as_time_goes_on(1.0 / (LOOKS * self.settings['control_rate']), self._look_around, qos.NOW)

    def now(self) -> float:
        return super().now() if self._listener is self else self._listener.now()

    def end(self) -> None:
        """Tells the robot to stand, as the last thing said; from whichever thread ends the node."""
        self._send(STOP)
        with self._sending:
            self._ended = True
        self._commands.wait_for_all_acked(LAST_WORD)

    def _on_odometry(self, robot: int, data: bytes) -> None:
        now = self.now()
        if now == 0.0:  # simulated time has not begun
            return
        pose, body_frame = standard_messages.odometry_in(data, self._world_frame)
        topic = names.ODOMETRY.format(robot)
        for bridge in self._bridges:
            with bridge.refusing(topic):
                bridge._pilot.on_odometry(robot, pose, now)
                if robot == bridge.settings['robot']:
                    bridge._body_frame = body_frame

    def _on_landmarks(self, message: PoseArray) -> None:
        landmarks = standard_messages.landmarks(message, self._world_frame)
        for bridge in self._bridges:
            with bridge.refusing(names.LANDMARKS):
                bridge._pilot.on_landmarks(landmarks)

    def _take_landmarks(self, text: str) -> None:
        try:
            self._pilot.on_landmarks(landmarks_in(text))
        except Refused as refusal:
            raise SettingsError(f'landmarks: {refusal.detail}') from refusal

    def _obey(self, action: Action) -> None:
        self._send(self._pilot.on_action(action))

    def _ask(self, agent: RobotAgentNode, observation: Observation) -> None:
        action = agent.answer(observation)
        self._untold = observation, action
        if action is not None:
            with self.refusing(names.ACTION.format(self.settings['robot'])):
                self._obey(action)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pilot.enable(request.data)
        self._look()
        self._tell()
        stop = self._pilot.stop
        response.success, response.message = True, 'driving' if stop is None else f'standing: {stop.detail}'
        return response

    def _look_around(self) -> None:
        for bridge in self._bridges:
            bridge._look()
        for bridge in self._bridges:
            bridge._tell()

    def _look(self) -> None:
        before = self._pilot.stop
        turn: Turn = self._pilot.look(self.now())
        if turn.command is not None:
            self._send(turn.command)
        if turn.observation is not None:
            if self._agent is None:
                self._observations.publish(convert.observation_message(turn.observation))
            else:
                self._ask(self._agent, turn.observation)
        stop = self._pilot.stop
        if (stop and stop.reason) != (before and before.reason):
            self.get_logger().info('driving' if stop is None else f'standing: {stop.detail}')
            self.publish_diagnostics()

    def _tell(self) -> None:
        if self._untold is not None:
            (observation, action), self._untold = self._untold, None
            self._observations.publish(convert.observation_message(observation))
            if action is not None:
                self._agent.tell(action)

    def _send(self, command: Command) -> None:
        message = convert_robots.command_message(command, self._stamped, self.now(), self._body_frame)
        with self._sending:
            if not self._ended:
                self._commands.publish(message)

    def diagnose(self):
        stop, values = self._pilot.stop, {'robot': self.settings['robot'], 'enabled': self._pilot.enabled}
        lost = self._pilot.lost(self.now())
        self.is_in_trouble = bool(lost) if stop is None else stop.reason != Stop.DISABLED
        if stop is None:
            return f'driving{without(lost)}', values
        return f'standing: {stop.detail}', {**values, 'standing for': stop.reason}

    def close(self) -> None:
        if self.context.ok():
            self.end()


def run_robots(make_nodes: Callable[[], list[TeamNode]], args: list[str] | None = None) -> int:
    """Runs bridges, and whatever shares their process. Signals end them through a thread of its own, since a context that a
    signal shut down sends nothing more."""
    nodes: list[TeamNode] = []
    endings = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, endings)

    def make() -> list[TeamNode]:
        nodes.extend(make_nodes())
        threading.Thread(target=end_on_signal, daemon=True).start()
        return nodes

    def end_on_signal() -> None:
        signal.sigwait(endings)
        for node in nodes:
            if isinstance(node, RobotBridgeNode):
                node.end()
        rclpy.try_shutdown()

    return run_together(make, args)


def make_bridge() -> list[TeamNode]:
    bridge = RobotBridgeNode()
    bridge.listen_for([bridge])
    return [bridge]


def main(args: list[str] | None = None) -> int:
    return run_robots(make_bridge, args)


if __name__ == '__main__':
    sys.exit(main())
