"""When a robot must stand, and why: a small state machine whose time comes from outside.

It knows the last good odometry of every robot of the team, and what is missing for the next step. Every rule ends by
itself when its cause does; only `enabled` is somebody's decision.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from dae_ros.errors import Refused
from dae_ros.robots.geometry import Pose, check_finite


class Bounds(NamedTuple):
    """What a robot tolerates."""

    odometry_timeout: float  # s; its own odometry may be so old
    teammate_hold: float     # s; a team mate's last position is taken for so long
    action_timeout: float    # s; the agent may take so long
    jump_distance: float     # m; a position may be off by so much
    jump_speed: float        # m/s; a faster change of the position is no motion


class Stop(NamedTuple):
    """Why a robot stands."""

    reason: str  # one short, stable word
    detail: str  # one sentence for people

    DISABLED = 'disabled'
    OWN_ODOMETRY = 'own_odometry'
    TEAMMATE = 'teammate'
    LANDMARKS = 'landmarks'
    AGENT = 'agent'


class Track:
    """The last good odometry of one robot."""

    def __init__(self, bounds: Bounds):
        self._bounds = bounds
        self.pose: Pose | None = None

    def take(self, pose: Pose, now: float) -> None:
        """Takes in a measurement; both times in s of one clock. One that cannot be right raises Refused and changes nothing."""
        check_finite(pose)
        if pose.time > now + self._bounds.odometry_timeout:
            raise Refused(Refused.OUT_OF_RANGE, f'odometry from {pose.time - now:.2f} s in the future')
        last = self.pose
        if last is not None and last.time <= now + self._bounds.odometry_timeout:  # else the clock was set back
            elapsed = pose.time - last.time
            if elapsed <= 0.0:
                raise Refused(Refused.DUPLICATE if elapsed == 0.0 else Refused.STALE,
                              f'odometry from {-elapsed:.3f} s before what is known')
            distance = math.dist(pose.position, last.position)
            if distance > self._bounds.jump_distance + self._bounds.jump_speed * elapsed:
                raise Refused(Refused.JUMP, f'{distance:.2f} m in {elapsed:.3f} s')
        self.pose = pose

    def held(self, now: float) -> Pose:
        """The last good odometry; a robot that is not heard of any more counts as standing where it was."""
        return self.pose if self.age(now) <= self._bounds.odometry_timeout else self.pose._replace(velocity=(0.0, 0.0))

    def age(self, now: float) -> float:
        """How old the last good odometry is [s]; infinite before the first."""
        return math.inf if self.pose is None else now - self.pose.time


class Safety:
    """What lets one robot of a team move."""

    def __init__(self, robot: int, num_agents: int, bounds: Bounds, enabled: bool = False, go_on: bool = False):
        """`go_on`: without team mates that were there once and are heard of no more."""
        self.enabled = enabled
        self.has_landmarks = False
        self.tracks = [Track(bounds) for _ in range(num_agents)]
        self._robot = robot
        self._bounds = bounds
        self._go_on = go_on
        self._unanswered_since: float | None = None

    def asked(self, now: float) -> None:
        """The agent was shown an observation."""
        if self._unanswered_since is None:
            self._unanswered_since = now

    def answered(self, since: float | None) -> None:
        """The agent acted; the first observation that it has not acted on yet is of `since` [s], None if there is none."""
        self._unanswered_since = since

    def waits(self, asked: float, now: float) -> bool:
        """Whether the agent may still answer at `now` what it was asked then."""
        return 0.0 <= now - asked <= self._bounds.action_timeout

    def stop(self, now: float) -> Stop | None:
        """Why the robot must stand now; None if it may move. Whoever stands for another reason owes no answer."""
        stop = self._blind(now)
        if stop is not None:
            self._unanswered_since = None
            return stop
        if self._unanswered_since is not None and now - self._unanswered_since > self._bounds.action_timeout:
            return Stop(Stop.AGENT, f'the agent has not answered for {now - self._unanswered_since:.2f} s')
        return None

    def _blind(self, now: float) -> Stop | None:
        if not self.enabled:
            return Stop(Stop.DISABLED, 'not enabled')
        age = self.tracks[self._robot].age(now)
        if age > self._bounds.odometry_timeout:
            return Stop(Stop.OWN_ODOMETRY, f'its own odometry {_old(age, self._bounds.odometry_timeout)}')
        if not self.has_landmarks:
            return Stop(Stop.LANDMARKS, 'where the landmarks are is not known yet')
        for robot in self.lost(now):
            if not self._go_on or self.tracks[robot].pose is None:
                age = self.tracks[robot].age(now)
                return Stop(Stop.TEAMMATE, f'the odometry of robot {robot} {_old(age, self._bounds.teammate_hold)}')
        return None

    def lost(self, now: float) -> list[int]:
        """Team mates that have not been heard of for longer than they are held."""
        return [robot for robot, track in enumerate(self.tracks)
                if robot != self._robot and track.age(now) > self._bounds.teammate_hold]


def _old(age: float, bound: float) -> str:
    return 'has not come yet' if math.isinf(age) else f'is {age:.2f} s old, at most {bound:g} s are allowed'
