"""When a simulated clock goes on: at the rate it should, but not ahead of the robots that are being driven."""

from __future__ import annotations

import math

from dae_ros.robots.bodies import Bodies
from dae_ros.robots.pilot import stamp_at

PATIENCE = 0.1  # s of ours that the clock waits for robots that are late
CATCH_UP = 1.0  # s of ours that it may be late itself and make up for


class Pace:
    """At the end of a control period the clock waits for who is driven and was not told anything in it.

    So a machine that cannot play the team as fast as it should plays it slower, and not worse. What it loses at one moment it
    makes up for at the next ones.
    """

    def __init__(self, bodies: Bodies, tick: float, control_period: float, factor: float):
        """`tick`: s between two moments of the clock, which goes `factor` times as fast as ours."""
        self._bodies, self._tick, self._period, self._real_tick = bodies, tick, control_period, tick / factor
        self._due = -math.inf  # when the clock should go on; s of ours
        self._waiting_since: float | None = None

    def goes_on(self, now: float, real_now: float) -> bool:
        """Whether the clock may go on from `now`, and if so it does; `real_now` is what a steady clock of ours says. In s."""
        if real_now < self._due - 0.5 * self._real_tick or self._must_wait(now, real_now):
            return False
        is_first = math.isinf(self._due)
        self._due = self._real_tick + (real_now if is_first else max(self._due, real_now - CATCH_UP))
        return True

    def _must_wait(self, now: float, real_now: float) -> bool:
        step, after = (stamp_at(time, self._period, 1, 0).rollout for time in (now, now + self._tick))
        if after == step or not self._bodies.untold(step * self._period):
            self._waiting_since = None
            return False
        if self._waiting_since is None:
            self._waiting_since = real_now
        return real_now - self._waiting_since < PATIENCE
