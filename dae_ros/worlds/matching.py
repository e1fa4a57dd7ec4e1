"""Exact minimum-cost matching of N robots and N targets, in W worlds at once."""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations

import numpy as np

LARGEST_ENUMERATION = 5  # robots; beyond, one world after the other with SciPy is faster than N! matchings
WORLDS_AT_ONCE = 256     # so that the sums of 120 matchings stay in the cache


def match(cost: np.ndarray) -> np.ndarray:
    """The target each robot takes so that the sum of the costs is least, [N, W] int, for costs [robot, target, W].

    Small teams: every matching is summed, all worlds together. Larger ones: SciPy's variant of the Hungarian method
    (Crouse, 2016), world by world.
    """
    if len(cost) > LARGEST_ENUMERATION:
        return _match_one_by_one(cost)
    targets = np.empty(cost.shape[1:], dtype=np.intp)
    for begin in range(0, targets.shape[1], WORLDS_AT_ONCE):
        part = slice(begin, begin + WORLDS_AT_ONCE)
        targets[:, part] = _match_by_enumeration(cost[:, :, part])
    return targets


def _match_by_enumeration(cost: np.ndarray) -> np.ndarray:
    matchings = _matchings(len(cost))
    total = cost[0][matchings[0]]
    for robot in range(1, len(cost)):
        total += cost[robot][matchings[robot]]
    return matchings[:, np.argmin(total, axis=0)]


def _match_one_by_one(cost: np.ndarray) -> np.ndarray:
    from scipy.optimize import linear_sum_assignment  # here: small teams need not wait for its import

    worlds_first = np.ascontiguousarray(cost.transpose(2, 0, 1))
    return np.array([linear_sum_assignment(world)[1] for world in worlds_first]).T


@lru_cache(maxsize=None)
def _matchings(size: int) -> np.ndarray:
    """All matchings, [size, size!]: row i holds the target of robot i."""
    return np.array(list(permutations(range(size)))).T.copy()
