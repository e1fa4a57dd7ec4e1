"""Quality of service of every topic, by name.

Reliable alone does not protect data: a keep-last queue overwrites silently when it is flooded. Lockstep bounds what is
under way to one rollout, and `ROLLOUT` is deeper than the longest one.
"""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _reliable(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE,
                      durability=durability)


LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For publishers whose last value is what counts, also for who comes late: requests, policies, status, observations."""

LATCHED_INPUT = _reliable(32, DurabilityPolicy.TRANSIENT_LOCAL)
"""For those who listen to such a topic: deep enough that a stranger's message does not push out a genuine one."""

ROLLOUT = _reliable(1024, DurabilityPolicy.VOLATILE)
"""Every datum of a rollout counts: joint states, rewards, actions."""

EVENTS = _reliable(10, DurabilityPolicy.VOLATILE)
"""A few messages now and then: diagnostics."""

SENSOR = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=5, reliability=ReliabilityPolicy.BEST_EFFORT,
                    durability=DurabilityPolicy.VOLATILE)
"""Odometry: only the newest counts, and whoever publishes it may be reliable or not."""

NOW = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT,
                 durability=DurabilityPolicy.VOLATILE)
"""Odometry and simulated time, for who acts: of what came while it was busy only the newest counts."""

WATCHED = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=200, reliability=ReliabilityPolicy.BEST_EFFORT,
                     durability=DurabilityPolicy.VOLATILE)
"""Simulated time and odometry, for who watches: each moment counts, also those it was too busy for."""

NEWEST = _reliable(1, DurabilityPolicy.VOLATILE)
"""For publishers of what soon has a successor, such as velocity commands: others may listen reliably or not."""

RECORDED = _reliable(8192, DurabilityPolicy.VOLATILE)
"""For the recorder, whom nobody waits for: data queue up while the disk is slow."""

RECORDED_LATCHED = _reliable(8192, DurabilityPolicy.TRANSIENT_LOCAL)
"""The same for what is latched: every value, and the last one before it came."""

def _lossless(durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


REPLAYED = _lossless(DurabilityPolicy.VOLATILE)
"""For who must lose nothing of a replay that is as fast as it is taken: what a full queue has no room for is sent again."""

REPLAYED_LATCHED = _lossless(DurabilityPolicy.TRANSIENT_LOCAL)
"""The same for what is latched."""
