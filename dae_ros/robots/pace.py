"""When a simulated clock goes on: at the rate it should, but not ahead of the robots that are being driven."""

from __future__ import annotations

from dae_ros.robots.bodies import Bodies
from dae_ros.robots.pilot import stamp_at

PATIENCE = 0.1  # s of ours that the clock waits for robots that are late


class Pace:
    """At the end of a control period the clock waits for who is driven and was not told anything in it.

    So a machine that cannot play the team as fast as it should plays it slower, and not worse.
    """

    def __init__(self, bodies: Bodies, tick: float, control_period: float):
        """`tick`: s between two moments of the clock."""
        self._bodies, self._tick, self._period = bodies, tick, control_period
        self._waiting_since: float | None = None

    def must_wait(self, now: float, real_now: float) -> bool:
        """Whether the clock must not go on yet from `now`; `real_now` is what a steady clock of ours says. Both in s."""
        step, after = (stamp_at(time, self._period, 1, 0).rollout for time in (now, now + self._tick))
        if after == step or not self._bodies.untold(step * self._period):
            self._waiting_since = None
            return False
        if self._waiting_since is None:
            self._waiting_since = real_now
        return real_now - self._waiting_since < PATIENCE
