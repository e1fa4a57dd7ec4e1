"""From a policy's action to a robot's motion: the particle's acceleration integrated to a velocity, within a robot's limits."""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

from dae_ros.robots.geometry import TaskFrame, turned, wrapped
from dae_ros.worlds.particle import ACTION_FORCE, DAMPING, TIME_STEP

TURNS_PER_PERIOD = 0.5  # share of what it points away that a differential robot turns in one control period


class Limits(NamedTuple):
    """What a robot can do, or may."""

    speed: float              # m/s
    acceleration: float       # m/s^2
    turn_rate: float          # rad/s
    turn_acceleration: float  # rad/s^2


class Command(NamedTuple):
    """What a robot's base is told, in its body frame."""

    forward: float = 0.0  # m/s
    left: float = 0.0     # m/s; 0 for a differential robot
    turn: float = 0.0     # rad/s


STOP = Command()


class Motion:
    """Drives one robot as the particle the policy was trained on, as far as the robot can follow.

    The velocity is integrated from what was asked for, not from what was measured, so that noise and delay do not add up.
    """

    def __init__(self, differential: bool, limits: Limits, frame: TaskFrame):
        self._differential = differential
        self._limits = limits
        self._to_metres = frame.scale / frame.slowness
        self._period = TIME_STEP * frame.slowness
        self.halt()

    def halt(self) -> Command:
        """Forgets the motion so far: the robot is told to stand."""
        self._velocity = (0.0, 0.0)  # m/s, world frame
        self._command = STOP
        return STOP

    def act(self, action: int, heading: float) -> Command:
        """The command for the next control period after `action`, for a robot that heads to `heading` [rad]."""
        force = ACTION_FORCE[:, action] * (TIME_STEP * self._to_metres)
        coasting = [(1.0 - DAMPING) * speed for speed in self._velocity]
        wanted = _shortened((coasting[0] + force[0], coasting[1] + force[1]), self._limits.speed)
        most = self._limits.acceleration * self._period
        change = _shortened((wanted[0] - self._velocity[0], wanted[1] - self._velocity[1]), most)
        self._velocity = self._velocity[0] + change[0], self._velocity[1] + change[1]
        body = turned(self._velocity, -heading)
        self._command = self._along_and_turn(body) if self._differential else Command(*body)
        return self._command

    def begin(self, told: Command, heading: float) -> None:
        """Goes on from the middle of a motion: the robot, which heads to `heading` [rad], does as it was told."""
        self._velocity = turned((told.forward, told.left), heading)
        self._command = told

    def likely_action(self, told: Command, heading: float) -> int:
        """The action whose command is nearest to what the robot was told, in shares of its limits; its motion goes on from there.
        """
        tried = [copy.copy(self) for _ in range(ACTION_FORCE.shape[1])]
        distances = [self._distance(motion.act(action, heading), told) for action, motion in enumerate(tried)]
        action = distances.index(min(distances))
        self._velocity, self._command = tried[action]._velocity, tried[action]._command
        return action

    def _distance(self, one: Command, other: Command) -> float:
        speed, turn_rate = self._limits.speed, self._limits.turn_rate
        return math.hypot((one.forward - other.forward) / speed, (one.left - other.left) / speed,
                          (one.turn - other.turn) / turn_rate)

    def _along_and_turn(self, body: tuple[float, float]) -> Command:
        """Along its axis goes what points there, forward or backward; it turns the nearer end to where it should go."""
        away = math.atan2(body[1], body[0])
        if abs(away) > 0.5 * math.pi:
            away = wrapped(away + math.pi)
        # The slower the robot, the less its direction means.
        share = min(1.0, math.hypot(*body) / (0.25 * self._limits.speed))
        turn = share * TURNS_PER_PERIOD * away / self._period
        return Command(_near(body[0], self._command.forward, self._limits.acceleration * self._period, self._limits.speed), 0.0,
                       _near(turn, self._command.turn, self._limits.turn_acceleration * self._period, self._limits.turn_rate))


def _shortened(vector: tuple[float, float], longest: float) -> tuple[float, float]:
    length = math.hypot(*vector)
    return vector if length <= longest else (vector[0] * longest / length, vector[1] * longest / length)


def _near(wanted: float, now: float, change: float, most: float) -> float:
    """`wanted` as far as it lies within `change` of `now`, and within +-`most`."""
    return max(-most, min(most, max(now - change, min(now + change, wanted))))
