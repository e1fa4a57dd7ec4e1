"""Our simulator as the robots of one team: odometry, tf, landmarks and markers out, cmd_vel in.

    ros2 run dae_ros world --ros-args -p task:=navigation -p num_agents:=3 -p real_time_factor:=1.0
"""

from __future__ import annotations

import time
from functools import partial

from geometry_msgs.msg import PoseArray, TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from dae_ros.config import SETTINGS, BodySettings, RobotWorldSettings, TaskSettings, declarations
from dae_ros.robots import standard_messages
from dae_ros.robots.bodies import Bodies
from dae_ros.robots.pace import Pace
from dae_ros.robots.pilot import stamp_at
from dae_ros.robots.scene import Scene
from dae_ros.robots.setup import limits_in, task_frame, task_settings
from dae_ros.ros import convert_robots, names, qos
from dae_ros.ros.markers import Display
from dae_ros.ros.node import TeamNode

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels lack it
    TFMessage = None

BEGINNING = 1.0  # s, where a clock of our own begins


class RobotWorldNode(TeamNode):
    """Wires `Bodies` to the topics of robots. At real time it goes by the system's clock, else it is the clock, at its `Pace`."""

    def __init__(self):
        super().__init__('world', [*declarations(TaskSettings, BodySettings, RobotWorldSettings), SETTINGS['seed']])
        settings, task = self.settings, task_settings(self.settings)
        self._frame, self._world_frame, robots = task_frame(settings), settings['world_frame'], range(task.num_agents)
        self._bodies = Bodies(task, self._frame, limits_in(settings), settings['drive'] == 'differential', settings['seed'])
        self._episode, self._period = 0, 1.0 / settings['odometry_rate']
        self._is_clock = settings['real_time_factor'] != 1.0
        self._time = BEGINNING
        self._pace = Pace(self._bodies, self._period, 1.0 / settings['control_rate'], settings['real_time_factor'])
        command = TwistStamped if settings['stamped'] else Twist
        self._odometry = [self.publisher(Odometry, names.ODOMETRY.format(i), qos.NEWEST) for i in robots]
        self._landmarks = self.publisher(PoseArray, names.LANDMARKS, qos.LATCHED)
        self._scene = Scene(task.num_agents, self._bodies.radius)
        self._display = Display(self, self._scene, self._world_frame, self._show)
        self._clock_out = self.publisher(Clock, names.CLOCK, qos.NEWEST) if self._is_clock else None
        self._transforms = TFMessage and self.publisher(TFMessage, names.TRANSFORMS, qos.EVENTS)
        for i in robots:
            self.listen(command, names.COMMAND.format(i), qos.SENSOR, partial(self._on_command, i))
        self.create_service(Trigger, names.NEXT_EPISODE, self._on_next_episode)
        self._show_landmarks()
        self.every(self._period / settings['real_time_factor'], self._tick)

    def now(self) -> float:
        return self._time if self._is_clock else super().now()

    def _on_command(self, robot: int, message: Twist | TwistStamped) -> None:
        self._bodies.obey(robot, standard_messages.command(message), self.now())
        if self._is_clock:  # which may have waited for this robot
            self._tick()

    def _on_next_episode(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begin(self._episode + 1)
        response.success, response.message = True, f'episode {self._episode}'
        return response

    def _begin(self, episode: int) -> None:
        self._episode = episode
        self._bodies.place(episode)
        self._show_landmarks()

    def _show_landmarks(self) -> None:
        self._landmarks.publish(convert_robots.landmarks_message(self._bodies.landmarks, self.now(), self._world_frame))

    def _tick(self) -> None:
        if self._is_clock and not self._pace.goes_on(self._time, time.monotonic()):
            return
        self._time = round(self._time + self._period, 6)
        now = self.now()
        if self.settings['reset_episodes']:
            episode = stamp_at(now, 1.0 / self.settings['control_rate'], self._bodies.episode_steps, 0).rollout
            if episode != self._episode:
                self._begin(episode)
        self._bodies.move(now, self._period)
        for robot, publisher in enumerate(self._odometry):
            publisher.publish(standard_messages.odometry_data(self._bodies.pose(robot, now), float(self._bodies.turns[robot]),
                                                              self._world_frame, self._body_frame(robot)))
        if self._transforms:
            self._transforms.publish(TFMessage(transforms=[self._transform(robot, now) for robot in range(len(self._odometry))]))
        if self._is_clock:  # last, so that with each moment all is known of it
            self._clock_out.publish(Clock(clock=convert_robots.time_message(now)))

    def _show(self, now: float) -> bool:
        bodies = self._bodies
        self._scene.show(bodies.positions, bodies.headings, bodies.landmarks, bodies.targets)
        return True

    def _body_frame(self, robot: int) -> str:
        """Two teams have frames of their own, as they have topics of their own."""
        return f'{self.get_namespace()}/robot_{robot}/base_link'.lstrip('/')

    def _transform(self, robot: int, now: float) -> TransformStamped:
        pose = self._bodies.pose(robot, now)
        return convert_robots.transform_message(pose, self._world_frame, self._body_frame(robot))

    def diagnose(self):
        return 'simulating', {'episode': self._episode, 'tf': 'published' if self._transforms else 'not published: no tf2_msgs'}
