"""Random draws keyed by what they are for, so that a run's data do not depend on who draws first or how often.

A draw is named by the run's seed, a purpose ('reset', 'action', ...) and the indices it belongs to (rollout, step,
robot). The name is hashed to the key of a counter-based generator (Philox 4x64; Salmon et al., SC 2011): the same
name gives the same numbers in any process, in any order, on any attempt. Several groups of worlds draw under seeds of
their own, which follow from the run's.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.random.bit_generator import ISeedSequence


class _Key(ISeedSequence):
    """A generator's key as what numpy seeds it from: given the key itself, numpy asks the system for a seed nobody uses."""

    def __init__(self, digest: bytes):
        self._words = np.frombuffer(digest, '<u8')

    def generate_state(self, n_words, dtype=np.uint32):
        return self._words


def _digest(seed: int, purpose: str, indices: tuple[int, ...]) -> bytes:
    name = f'{seed}/{purpose}/' + '/'.join(str(int(index)) for index in indices)
    return hashlib.blake2b(name.encode(), digest_size=16).digest()


def key(seed: int, purpose: str, *indices: int) -> int:
    """128-bit key of the draw named by `seed`, `purpose` and `indices`."""
    return int.from_bytes(_digest(seed, purpose, indices), 'little')


def generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """A generator of its own for the draw named by `seed`, `purpose` and `indices`."""
    return np.random.Generator(np.random.Philox(_Key(_digest(seed, purpose, indices))))


def group_seed(seed: int, group: int) -> int:
    """The seed a group of worlds draws under: the run's for group 0, 128 bits of its own for any other."""
    return key(seed, 'group', group) if group else seed
