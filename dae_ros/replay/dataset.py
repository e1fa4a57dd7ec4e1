"""Bags as data: the rollouts in them, joined on the stamps as a trainer joins them live, one after the other.

    for trajectory in Dataset('bags/*'):
        print(trajectory.rewards.mean())
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Iterator

from dae_ros.errors import BagError
from dae_ros.replay.bag import Bag, find_bags
from dae_ros.replay.joiner import Joiner, Rollout
from dae_ros.types import Trajectory, WorldSpec

OTHER_SIZES = 'other_sizes'


class Dataset:
    """The rollouts in bags, streamed anew from disk by each iteration, always in the same order.

    Afterwards `rollouts`, `environment_steps` and `skipped` say what the last iteration used and what it did not: messages
    by the reason they were refused for, rollouts that are `incomplete` or of `other_sizes` than the first, damage to files,
    and, with the reason in words, whole bags.
    """

    def __init__(self, *paths: str | Path):
        """`paths`: bags (folders or files) and glob patterns. BagError if one of them names nothing."""
        self._bags = find_bags(*paths)
        self.spec: WorldSpec | None = None  # sizes and number of worlds of one group, known with the first rollout
        self.num_worlds = 0
        self._forget()

    def _forget(self) -> None:
        self.rollouts = self.environment_steps = 0
        self.skipped: Counter[str] = Counter()

    def __iter__(self) -> Iterator[Trajectory]:
        """The trajectories alone."""
        return (rollout.trajectory for rollout in self.read())

    def read(self) -> Iterator[Rollout]:
        """The rollouts. BagError, saying why, if there is not one in all the bags."""
        self._forget()
        joiner = Joiner(self.skipped)
        for path in self._bags:
            try:
                for message in Bag(path, self.skipped).messages():
                    for spec, rollout in joiner.take(message):
                        if self._fits(spec, rollout):
                            yield rollout
            except BagError as error:
                self.skipped[str(error)] += 1
        joiner.end()
        if not self.rollouts:
            bags = f'{len(self._bags)} bag{"s" * (len(self._bags) != 1)}'
            raise BagError('no rollout can be read: ' + (
                self.describe_skipped() or f'no messages of ours in {bags}; those of robots need their task file, with --robots'))

    def describe_skipped(self) -> str:
        """What was skipped and why, for people."""
        return describe(self.skipped)

    def _fits(self, spec: WorldSpec, rollout: Rollout) -> bool:
        """Counts a rollout as used if its sizes are those of the first."""
        steps, num_worlds = rollout.trajectory.rewards.shape
        if self.spec is None:
            self.spec, self.num_worlds = spec, num_worlds
        if (spec, num_worlds) != (self.spec, self.num_worlds):
            self.skipped[OTHER_SIZES] += 1
            return False
        self.rollouts += 1
        self.environment_steps += steps * num_worlds
        return True


def describe(skipped: Counter[str]) -> str:
    """What was skipped and why, for people."""
    return ', '.join(f'{reason} ({count})' if count > 1 else reason for reason, count in sorted(skipped.items()))
