"""Differential robots that know nothing of dae_ros: odometry out, cmd_vel in, with noise, delay, and a clock of their own.

    PYTHONPATH=.:$PYTHONPATH python -m examples.foreign_robots --ros-args -p layout:=3 -p speedup:=1.0

Each robot has two wheels whose speeds follow the command with a lag, up to what its motors can do, and lets them stand when
no command comes for half a second. Its odometry is late and not exact. The service `next_layout` puts robots and landmarks
elsewhere; `ground_truth` says where the robots really are, for whoever judges them.
"""

from __future__ import annotations

import math
from collections import deque
from functools import partial

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, Twist
from nav_msgs.msg import Odometry
from rclpy.clock import Clock as SystemClock
from rclpy.clock import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

STEP = 0.01           # s of physics
TICK = 0.05           # s between two odometries
LAG = 0.06            # s, time constant of the motors
TRACK = 0.16          # m between the wheels
WHEEL_SPEED = 0.9     # m/s that a wheel can do
COMMAND_TIMEOUT = 0.5  # s
BODY = 0.2            # m, of which noise is a share


class ForeignRobots(Node):
    """Some robots in a room, and the messages they speak."""

    def __init__(self):
        super().__init__('foreign_robots')
        get = lambda name, default: self.declare_parameter(name, default).value  # noqa: E731
        self._robots, self._layout = get('robots', 3), get('layout', 0)
        self._noise, delay, speedup = get('noise', 0.05), get('delay', 0.05), get('speedup', 1.0)
        self._frame = get('frame', 'map')
        self._late = round(delay / TICK)  # ticks
        self._now = 1000.0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        names = [f'robot_{index}' for index in range(self._robots)]
        self._clock = self.create_publisher(Clock, '/clock', 10)
        self._landmarks = self.create_publisher(PoseArray, 'landmarks', latched)
        self._truth = self.create_publisher(PoseArray, 'ground_truth', 10)
        self._odometry = [self.create_publisher(Odometry, f'{name}/odom', qos_profile_sensor_data) for name in names]
        for index, name in enumerate(names):
            self.create_subscription(Twist, f'{name}/cmd_vel', partial(self._on_command, index), qos_profile_sensor_data)
        self.create_service(Trigger, 'next_layout', self._on_next_layout)
        self._place()
        self.create_timer(TICK / speedup, self._tick, clock=SystemClock(clock_type=ClockType.STEADY_TIME))

    def _place(self) -> None:
        """Robots and landmarks somewhere, as the layout's number says; everybody stands."""
        self._draw = np.random.default_rng(self._layout)
        self._position = self._draw.uniform(-1.0, 1.0, (self._robots, 2))
        self._heading = self._draw.uniform(-math.pi, math.pi, self._robots)
        self._wheels = np.zeros((self._robots, 2))   # m/s, left and right
        self._wanted = np.zeros((self._robots, 2))
        self._heard = np.full(self._robots, -math.inf)
        self._measured: deque = deque(maxlen=self._late + 1)
        message = PoseArray()
        message.header.frame_id = self._frame
        for x, y in self._draw.uniform(-0.8, 0.8, (self._robots, 2)):
            pose = Pose()
            pose.position.x, pose.position.y = x, y
            message.poses.append(pose)
        self._landmarks.publish(message)

    def _on_next_layout(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._layout += 1
        self._place()
        response.success, response.message = True, f'layout {self._layout}'
        return response

    def _on_command(self, robot: int, twist: Twist) -> None:
        turn = 0.5 * TRACK * twist.angular.z
        self._wanted[robot] = np.clip([twist.linear.x - turn, twist.linear.x + turn], -WHEEL_SPEED, WHEEL_SPEED)
        self._heard[robot] = self._now

    def _tick(self) -> None:
        for _ in range(round(TICK / STEP)):
            self._move()
        self._now += TICK
        self._clock.publish(Clock(clock=self._stamp(self._now)))
        self._publish_truth()
        self._measured.append(self._measure())
        if len(self._measured) > self._late:
            for robot, publisher in enumerate(self._odometry):
                publisher.publish(self._as_odometry(robot, self._now - TICK * self._late, *self._measured[0]))

    def _move(self) -> None:
        self._wanted[self._now - self._heard > COMMAND_TIMEOUT] = 0.0
        self._wheels += (self._wanted - self._wheels) * (STEP / LAG)
        wheels = self._wheels * (1.0 + self._noise * self._draw.standard_normal(self._wheels.shape))
        self._speed, self._turn = wheels.mean(axis=1), (wheels[:, 1] - wheels[:, 0]) / TRACK
        self._heading += STEP * self._turn
        self._position += STEP * self._speed[:, None] * np.stack([np.cos(self._heading), np.sin(self._heading)], axis=1)

    def _measure(self) -> tuple[np.ndarray, ...]:
        """Positions, headings, speeds and turn rates, each a little wrong."""
        wrong = self._noise * self._draw.standard_normal((5, self._robots))
        return (self._position + BODY * wrong[:2].T, self._heading + wrong[2], self._speed * (1.0 + wrong[3]),
                self._turn * (1.0 + wrong[4]))

    def _as_odometry(self, robot: int, time: float, position, heading, speed, turn) -> Odometry:
        message = Odometry(child_frame_id=f'robot_{robot}/base_link')
        message.header.frame_id, message.header.stamp = self._frame, self._stamp(time)
        message.pose.pose = self._pose(position[robot], heading[robot])
        message.twist.twist.linear.x, message.twist.twist.angular.z = float(speed[robot]), float(turn[robot])
        return message

    def _publish_truth(self) -> None:
        message = PoseArray(poses=[self._pose(*place) for place in zip(self._position, self._heading)])
        message.header.frame_id, message.header.stamp = self._frame, self._stamp(self._now)
        self._truth.publish(message)

    @staticmethod
    def _pose(position, heading: float) -> Pose:
        pose = Pose()
        pose.position.x, pose.position.y = map(float, position)
        pose.orientation.z, pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
        return pose

    @staticmethod
    def _stamp(time: float) -> Time:
        whole, part = divmod(round(time * 1e9), 10**9)
        return Time(sec=whole, nanosec=part)


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(ForeignRobots())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:  # a message was under way when a signal ended the context
        if rclpy.ok():
            raise


if __name__ == '__main__':
    main()
