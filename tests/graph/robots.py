"""A stage for robots in the tests: real nodes drive them, the test owns the clock, their bodies and the landmarks."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Callable, Iterable

import numpy as np
from dae_ros_msgs import msg
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, Twist
from harness import REPOSITORY, TIMEOUT, Listener
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock

from dae_ros.robots import standard_messages
from dae_ros.robots.geometry import Pose
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.ros.supervisor import Supervisor

POLICY = REPOSITORY / 'config' / 'policies' / 'navigation.safetensors'
BEGINNING = 1000.0  # s
PERIOD = 0.1        # s
PATIENCE = 2.0      # s of ours
FRAME = 'map'
LANDMARKS = np.array([[0.5, 0.5], [-0.5, 0.0], [0.2, -0.6]])
PLACES = np.array([[0.0, 0.0], [0.9, -0.2], [-0.3, 0.8]])


class Processes:
    """Nodes in processes of their own, all of which end with the test."""

    def __init__(self, folder: Path):
        self._supervisor = Supervisor(folder / 'logs', lambda name, code: None)
        self._pids: dict[str, int] = {}

    def node(self, executable: str, name: str, *arguments: str, **parameters) -> None:
        """Starts a node; `parameters` by their names."""
        settings = [text for key, value in parameters.items() for text in ('-p', f'{key}:={value}')]
        self.python(name, f'dae_ros_nodes.{executable}', '--ros-args', '-r', f'__node:={name}', *settings, *arguments)

    def python(self, name: str, module: str, *arguments: str) -> None:
        environment = {**os.environ, 'PYTHONPATH': f'{REPOSITORY}:{os.environ.get("PYTHONPATH", "")}'}
        self._pids[name] = self._supervisor.start(name, [sys.executable, '-m', module, *arguments], environment)

    def end(self, name: str, number: int = signal.SIGINT) -> int:
        """Sends the signal and waits for the end; the exit code."""
        os.kill(self._pids[name], number)
        return self._supervisor.wait(name, TIMEOUT)

    def wait(self, name: str) -> int:
        return self._supervisor.wait(name, TIMEOUT)

    def log(self, name: str) -> str:
        return self._supervisor.log_file(name).read_text()

    def stop(self) -> None:
        self._supervisor.stop()


class Stage(Listener):
    """The clock, robots that stand where they are put, and everything that is said to and about them."""

    def __init__(self, command: type = Twist, places: np.ndarray = PLACES):
        super().__init__()
        self.now = BEGINNING
        self.places = places.copy()
        self.robots = range(len(places))
        self.commands: dict[int, list] = defaultdict(list)
        self.observations: dict[int, list] = defaultdict(list)
        self.actions: dict[int, list] = defaultdict(list)
        self.diagnostics: dict[str, list] = defaultdict(list)
        node = self.node
        self.clock = node.create_publisher(Clock, '/clock', 10)
        self.landmarks = node.create_publisher(PoseArray, names.LANDMARKS, qos.LATCHED)
        self.odometry = [node.create_publisher(Odometry, names.ODOMETRY.format(robot), 10) for robot in self.robots]
        for robot in self.robots:
            for kind, topic, profile, heard in ((command, names.COMMAND, 10, self.commands),
                                                (msg.Observation, names.OBSERVATION, qos.LATCHED_INPUT, self.observations),
                                                (msg.Action, names.ACTION, qos.ROLLOUT, self.actions)):
                node.create_subscription(kind, topic.format(robot), partial(self._hear, heard[robot]), profile)
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.EVENTS)

    @staticmethod
    def _hear(heard: list, message) -> None:
        heard.append(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name.strip('/')].append(status.message)

    def wait_for_bridges(self, number: int, landmarks: np.ndarray = LANDMARKS) -> None:
        """Shows the landmarks, and waits until bridges hear and are heard."""
        self.landmarks.publish(convert_robots.landmarks_message(landmarks, self.now, FRAME))
        self.spin_until(lambda: all(publisher.get_subscription_count() >= number for publisher in self.odometry))
        self.spin_until(lambda: self.clock.get_subscription_count() >= number)
        for topic in names.COMMAND, names.OBSERVATION, names.ACTION:
            self.spin_until(lambda: sum(self.node.count_publishers(topic.format(robot)) for robot in self.robots) >= number)

    def show(self, robot: int, **changes) -> None:
        """Publishes the odometry of one robot, with fields of its pose changed."""
        pose = Pose(tuple(self.places[robot]), 0.0, (0.0, 0.0), self.now)._replace(**changes)
        self.odometry[robot].publish(standard_messages.odometry_data(pose, 0.0, FRAME, f'robot_{robot}/base_link'))

    def tick(self, *robots: int, fraction: float = 1.0) -> None:
        """The clock goes on by a control period, or a fraction of one; only these robots show their odometry."""
        self.now = round(self.now + fraction * PERIOD, 6)
        for robot in robots:
            self.show(robot)
        self.clock.publish(Clock(clock=convert_robots.time_message(self.now)))

    def drive(self, robot: int, *shown: int) -> object:
        """Ticks until the robot is told something; the command."""
        count = len(self.commands[robot])
        self.tick(*shown)
        self.spin_until(lambda: len(self.commands[robot]) > count, lambda: f'no command; {self.diagnostics}')
        return self.commands[robot][-1]

    def step(self, robots: Iterable[int], *shown: int) -> None:
        """A tick in which these robots act, on observations that were heard here too. One that passes it over, since it was too
        busy, has to act in a later one."""
        counts = {robot: len(self.actions[robot]) for robot in robots}
        deadline = time.monotonic() + TIMEOUT

        def have_acted() -> bool:
            return all(len(self.actions[robot]) > count and self.has_heard_both(robot) for robot, count in counts.items())

        while not have_acted():
            assert time.monotonic() < deadline, {name: said[-1] for name, said in self.diagnostics.items()}
            self.tick(*shown)
            self._holds_within(PATIENCE, have_acted)

    def has_heard_both(self, robot: int) -> bool:
        """Whether the robot's newest action and the observation it answers are here."""
        return self.actions[robot][-1].stamp == self.observations[robot][-1].stamp

    def tick_until(self, condition: Callable[[], bool], *shown: int) -> None:
        """Lets the clock go on, ten times as fast as at most, until `condition` holds; AssertionError if it never does."""
        self.repeat_until(condition, lambda: self.tick(*shown))

    def show_until(self, condition: Callable[[], bool], robot: int, **changes) -> None:
        """Shows the same odometry, of which some may get lost, until `condition` holds; AssertionError if it never does."""
        self.repeat_until(condition, lambda: self.show(robot, **changes))

    def repeat_until(self, condition: Callable[[], bool], act: Callable[[], None]) -> None:
        """Acts, a hundred times a second at most, until `condition` holds; AssertionError if it never does."""
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, dict(self.diagnostics)
            act()
            self._holds_within(0.1 * PERIOD, condition)

    def start_driving(self, robot: int, *shown: int) -> None:
        """Ticks until the robot drives."""
        self.tick_until(lambda: bool(self.commands[robot]) and not is_standing(self.commands[robot][-1]), *shown)

    def wait_for_words(self, node: str, words: str, *shown: int) -> None:
        """Ticks until the node's diagnostics say this from now on."""
        heard = self.diagnostics[node]
        count = len(heard)
        self.tick_until(lambda: any(words in line for line in heard[count:]), *shown)

    def decoded(self, heard: list) -> list:
        return [convert.observation(message) if isinstance(message, msg.Observation) else convert.action(message)
                for message in heard]


def is_standing(message) -> bool:
    twist = getattr(message, 'twist', message)
    return (twist.linear.x, twist.linear.y, twist.angular.z) == (0.0, 0.0, 0.0)
