"""When everything is known of a team of robots: stretches of time without a pause, a jump or landmarks that move."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from dae_ros.errors import Refused
from dae_ros.replay.robot_log import RobotLog, Told, Track
from dae_ros.robots.bodies import COMMAND_TIMEOUT

READ_AT = 0.7     # of a control period: ours act early in it, and others' commands ramp to its end
TOLERANCE = 1e-3  # of a control period
GAP, COMMAND_GAP, LANDMARKS = 'gap', 'command_gap', 'landmarks'  # why a stretch was cut, beside a jump


class Limits(NamedTuple):
    """What cuts a stretch."""

    period: float            # s of a step
    odometry_timeout: float  # s between measurements
    jump_distance: float     # m; a position may be off by so much
    jump_speed: float        # m/s; a faster change of the position is no motion

    @property
    def told_for(self) -> float:
        """How long a command lasts [s]."""
        return max(COMMAND_TIMEOUT, 2.0 * self.period)


class Span(NamedTuple):
    """Some time on the robots' clock, both ends included, in s."""

    begin: float
    end: float


class Stretch(NamedTuple):
    """A span, and where the landmarks are in it, [L, 2] in m."""

    span: Span
    landmarks: np.ndarray

    def steps(self, period: float) -> tuple[int, int]:
        """The first and the last of the multiples of the control period [s] within it."""
        return (int(np.ceil(self.span.begin / period - TOLERANCE)), int(np.floor(self.span.end / period + TOLERANCE)))


def stretches(log: RobotLog, places: list[tuple[float, np.ndarray]], limits: Limits, cuts: Counter[str]) -> list[Stretch]:
    """The stretches in a bag, with landmarks that move to `places` [L, 2] in m at those times [s]. Counts the cuts by reason."""
    common = [Span(-np.inf, np.inf)]
    for track in log.tracks:
        common = _both(common, _unbroken(track, limits, cuts))
    for told in log.told:
        common = _both(common, _commanded(told, limits, cuts))
    found = []
    for (begin, landmarks), (end, _) in zip(places, [*places[1:], (np.inf, None)]):
        # A hair before they move, so that no sample lies in two stretches.
        found += [Stretch(span, landmarks) for span in _both(common, [Span(begin, end - 2.0 * TOLERANCE * limits.period)])]
    if len(places) > 1:
        cuts[LANDMARKS] += len(places) - 1
    return found


def _unbroken(track: Track, limits: Limits, cuts: Counter[str]) -> list[Span]:
    """When a robot's odometry comes without a pause or a jump."""
    elapsed, moved = np.diff(track.times), np.linalg.norm(np.diff(track.moved[:, :2], axis=0), axis=1)
    jumped = moved > limits.jump_distance + limits.jump_speed * elapsed
    paused = ~jumped & (elapsed > limits.odometry_timeout + TOLERANCE * limits.period)
    _count(cuts, {Refused.JUMP: jumped, GAP: paused})
    return _spans(track.times, jumped | paused)


def _commanded(told: Told, limits: Limits, cuts: Counter[str]) -> list[Span]:
    """When a robot is told what to do without a pause; from a little before, for a step begins before it is commanded."""
    paused = np.diff(told.times) > limits.told_for
    _count(cuts, {COMMAND_GAP: paused})
    return [Span(begin - READ_AT * limits.period, end + limits.period) for begin, end in _spans(told.times, paused)]


def _count(cuts: Counter[str], found: dict[str, np.ndarray]) -> None:
    for reason, where in found.items():
        if where.any():
            cuts[reason] += int(where.sum())


def _spans(times: np.ndarray, cut: np.ndarray) -> list[Span]:
    """From the first of `times` [K] to the last, but for what lies between two where `cut` [K - 1] says so."""
    after = np.flatnonzero(cut) + 1
    return [Span(float(times[begin]), float(times[end - 1])) for begin, end in zip([0, *after], [*after, len(times)])]


def _both(ones: list[Span], others: list[Span]) -> list[Span]:
    """The times that lie in a span of each list; those of a list follow each other."""
    found, i, j = [], 0, 0
    while i < len(ones) and j < len(others):
        both = Span(max(ones[i].begin, others[j].begin), min(ones[i].end, others[j].end))
        if both.begin <= both.end:
            found.append(both)
        if ones[i].end < others[j].end:
            i += 1
        else:
            j += 1
    return found
