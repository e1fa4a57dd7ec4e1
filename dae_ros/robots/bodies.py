"""Our simulator as robots: N discs that obey velocity commands, start where a task puts them, and push each other apart."""

from __future__ import annotations

import math

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.robots.geometry import Pose, TaskFrame, wrapped
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
        self._first, self._second = np.triu_indices(self.num_robots, k=1)
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
        told = np.array([command if now - heard <= COMMAND_TIMEOUT else STOP
                         for command, heard in zip(self._commands, self._heard)])
        self.turns = told[:, 2]
        self.headings = np.array([wrapped(heading) for heading in self.headings + duration * self.turns])
        cosines, sines = np.cos(self.headings), np.sin(self.headings)
        before = self.positions
        wanted = np.stack([cosines * told[:, 0] - sines * told[:, 1], sines * told[:, 0] + cosines * told[:, 1]], axis=1)
        self.positions = self._apart(before + duration * wanted)
        self.velocities = (self.positions - before) / duration

    def pose(self, robot: int, now: float) -> Pose:
        """Where one robot is."""
        return Pose(tuple(self.positions[robot]), float(self.headings[robot]), tuple(self.velocities[robot]), now)

    def _apart(self, positions: np.ndarray) -> np.ndarray:
        """`positions` [N, 2] with discs that overlap pushed apart, each by half."""
        separation = positions[self._first] - positions[self._second]
        distance = np.maximum(np.linalg.norm(separation, axis=1), 1e-9)
        push = separation * (np.maximum(2.0 * self.radius - distance, 0.0) / (2.0 * distance))[:, None]
        positions = positions.copy()
        np.add.at(positions, self._first, push)
        np.subtract.at(positions, self._second, push)
        return positions
