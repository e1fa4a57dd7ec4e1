"""A run whose messages are played again: its rollouts, whole, in their order, and held against what its training asks for."""

from __future__ import annotations

from collections import Counter

from dae_ros.errors import SettingsError, StalledError
from dae_ros.replay.joiner import Joiner, Rollout
from dae_ros.replay.mcap import Message
from dae_ros.rollout.groups import join
from dae_ros.types import RolloutRequest, Trajectory, WorldSpec

MOST_OPEN = 8192  # rollouts being joined: one topic's messages may overtake another's by all that the queues between hold
MOST_EARLY = 8    # later rollouts that may be whole before the one that is next, of which something must have been lost
OTHER_RUN, OTHER_SIZES, EARLIER = 'other_run', 'other_sizes', 'earlier'
ASKED = ('policy_version', 'seed', 'num_steps', 'greedy')  # what request and replay must agree on, beside the rollout


class ReplayedRun:
    """The first run that is heard of. `skipped` counts what is not used, by reason."""

    def __init__(self, spec: WorldSpec, worlds_per_group: int, world_groups: int):
        self.skipped: Counter[str] = Counter()
        self._sizes = spec[:4], worlds_per_group
        self._world_groups = world_groups
        self._joiner = Joiner(self.skipped, MOST_OPEN)
        self._run: int | None = None
        self._next = 0
        self._parts: dict[int, dict[int, Rollout]] = {}  # from the next rollout on, by rollout and group

    def take(self, message: Message) -> None:
        """Takes in a message, of whatever rollout."""
        for spec, rollout in self._joiner.take(message):
            request = rollout.request
            self._run = request.run if self._run is None else self._run
            if request.run != self._run:
                self.skipped[OTHER_RUN] += 1
            elif (spec[:4], rollout.trajectory.rewards.shape[1]) != self._sizes or rollout.group >= self._world_groups:
                self.skipped[OTHER_SIZES] += 1
            elif request.rollout < self._next:
                self.skipped[EARLIER] += 1
            else:
                self._parts.setdefault(request.rollout, {})[rollout.group] = rollout

    def answer(self, wanted: RolloutRequest) -> Trajectory | None:
        """The rollout that answers a request of the same training; None while it is not whole.

        SettingsError if it was played with other settings, StalledError if it is missing from the replay.
        """
        self._next = wanted.rollout
        parts = self._parts.get(wanted.rollout, {})
        if len(parts) < self._world_groups:
            if sum(len(later) == self._world_groups for later in self._parts.values()) > MOST_EARLY:
                raise StalledError(f'rollout {wanted.rollout} is missing from the replay, where later ones are whole')
            return None
        for name in ASKED:
            played, asked = getattr(parts[0].request, name), getattr(wanted, name)
            if played != asked:
                raise SettingsError(f'rollout {wanted.rollout} was recorded with {name} {played}, and {asked} is asked for; give '
                                    'the training the settings of the run that is replayed')
        del self._parts[wanted.rollout]
        return join([parts[group].trajectory for group in range(self._world_groups)])
