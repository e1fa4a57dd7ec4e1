"""Our simulator as robots: N discs that obey velocity commands, start where a task puts them, and push each other apart."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.robots.geometry import Pose, TaskFrame, turned, wrapped
from dae_ros.robots.motion import STOP, Command, Limits
from dae_ros.robots.task_monitor import one_team

COMMAND_TIMEOUT = 0.5  # s without a command after which a robot stands


class Bodies:
    """The robots of one team of a particle task; in m, s and rad. Time comes from outside."""

    def __init__(self, task: TaskSettings, frame: TaskFrame, limits: Limits, differential: bool, seed: int):
        """Raises SettingsError where the task is not one of robots in the plane."""
        self._worlds = worlds = one_team(task)
        self._frame, self._limits, self._differential, self._seed = frame, limits, differential, seed
        self.num_robots = task.num_agents
        self.episode_steps = worlds.episode_steps
        self.radius = worlds.radius * frame.scale
        self._heard = [-math.inf] * self.num_robots
        self.place(0)

    def place(self, episode: int) -> None:
        """Puts robots and landmarks where the task's episode of this number begins; everybody stands and heads to x."""
        self._worlds.reset(self._seed, episode)
        self.positions = self._frame.metres(self._worlds.positions[0])  # [N, 2]
        self.landmarks = self._frame.metres(self._worlds.landmarks[0])  # [L, 2]
        self.headings = np.zeros(self.num_robots)
        self.velocities = np.zeros((self.num_robots, 2))  # world frame
        self.turns = np.zeros(self.num_robots)            # rad/s
        self._commands = [STOP] * self.num_robots

    @property
    def targets(self) -> np.ndarray:
        """The N places the team should cover, [N, 2]."""
        self._worlds.set_state(self._frame.positions(self.positions), 0.0, self._frame.positions(self.landmarks))
        return self._frame.metres(self._worlds.targets[0])

    def obey(self, robot: int, command: Command, now: float) -> None:
        """Takes in what one robot is told at `now`."""
        left = 0.0 if self._differential else command.left
        limits = self._limits
        speed = math.hypot(command.forward, left)
        share = min(1.0, limits.speed / speed) if speed else 1.0
        turn = max(-limits.turn_rate, min(limits.turn_rate, command.turn))
        self._commands[robot], self._heard[robot] = Command(share * command.forward, share * left, turn), now

    def untold(self, since: float) -> bool:
        """Whether a robot that is being driven has been told nothing since then."""
        return any(since - COMMAND_TIMEOUT <= heard < since - 1e-6 for heard in self._heard)

    def move(self, now: float, duration: float) -> None:
        """Moves everybody for `duration` as told; whoever was told nothing for long stands."""
        told = [command if now - heard <= COMMAND_TIMEOUT else STOP for command, heard in zip(self._commands, self._heard)]
        headings = [wrapped(heading + duration * command.turn) for heading, command in zip(self.headings.tolist(), told)]
        wanted = [turned((command.forward, command.left), heading) for command, heading in zip(told, headings)]
        before = self.positions
        self.headings, self.turns = np.array(headings), np.array([command.turn for command in told])
        self.positions = self._apart(before + duration * np.array(wanted))
        self.velocities = (self.positions - before) / duration

    def pose(self, robot: int, now: float) -> Pose:
        """Where one robot is."""
        return Pose(tuple(self.positions[robot]), float(self.headings[robot]), tuple(self.velocities[robot]), now)

    def _apart(self, positions: np.ndarray) -> np.ndarray:
        """`positions` [N, 2] with discs that overlap pushed apart, each by half."""
        apart = positions.copy()
        for (first, one), (second, other) in combinations(enumerate(positions.tolist()), 2):
            separation = one[0] - other[0], one[1] - other[1]
            distance = max(math.hypot(*separation), 1e-9)
            if distance < 2.0 * self.radius:
                push = (self.radius / distance - 0.5) * np.array(separation)
                apart[first] += push
                apart[second] -= push
        return apart
