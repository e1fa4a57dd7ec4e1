"""Joins recorded messages of any number of teams and runs into rollouts, in whatever order they were recorded."""

from __future__ import annotations

import re
from collections import Counter
from typing import Iterator, NamedTuple

import numpy as np

from dae_ros.errors import Refused
from dae_ros.replay.cdr import MESSAGE_TYPES, Datum
from dae_ros.replay.mcap import Message
from dae_ros.rollout.assembler import Assembler
from dae_ros.types import Action, JointState, RolloutRequest, Trajectory, WorldSpec

MOST_OPEN = 4         # rollouts of one group being joined at once: the one under way, its neighbours, other attempts
MOST_REQUESTS = 8192  # remembered for data that come later
INCOMPLETE = 'incomplete'

_GROUP = re.compile(r'(.*?)/?group_(\d+)')


class Rollout(NamedTuple):
    """One group's part of a rollout; a team that is not split is one group."""

    team: str                # namespace of the team, as in the topics
    group: int
    request: RolloutRequest  # which run and rollout it is, and how it was played
    trajectory: Trajectory


class _Part:
    """What is known of one group's part of one attempt at a rollout."""

    def __init__(self):
        self.early: list[Datum] = []  # came before the sizes were known
        self.spec: WorldSpec | None = None
        self.assembler: Assembler | None = None

    def begin(self, request: RolloutRequest) -> bool:
        """Begins to join once a joint state and an action tell the sizes; whether it did. Raises Refused."""
        joint = next((datum for datum in self.early if isinstance(datum, JointState)), None)
        action = next((datum for datum in self.early if isinstance(datum, Action)), None)
        if joint is None or action is None:
            return False
        num_worlds, num_agents, observation_size = joint.observations.shape
        self.spec = WorldSpec(num_agents, action.probabilities.shape[1], observation_size, joint.state.shape[1],
                              np.may_share_memory(joint.state, joint.observations))
        assembler = Assembler(self.spec, num_worlds)
        try:
            assembler.begin(request)
        except MemoryError as error:
            raise Refused(Refused.OVERSIZED, f'a rollout of {request.num_steps} steps of {num_worlds} worlds') from error
        self.assembler = assembler
        return True


class Joiner:
    """Takes in messages one by one. Those refused are counted in `skipped` by reason, and rollouts that stay `incomplete`."""

    def __init__(self, skipped: Counter[str], most_open: int = MOST_OPEN):
        self._skipped = skipped
        self._most_open = most_open
        self._open: dict[tuple[str, int], dict[tuple[int, int, int], _Part]] = {}
        self._requests: dict[tuple[str, int, int, int], RolloutRequest] = {}
        self._done: set[tuple[str, int, int, int]] = set()

    def take(self, message: Message) -> Iterator[tuple[WorldSpec, Rollout]]:
        """Takes in one message; the rollouts that it completes, with the sizes of their worlds."""
        try:
            datum = MESSAGE_TYPES[message.type].decode(message.data)
            if isinstance(datum, RolloutRequest):
                yield from self._on_request(_team(message.topic, 1)[0], datum)
            else:
                yield from self._on_datum(*_team(message.topic, 2 if isinstance(datum, Action) else 1), datum)
        except Refused as refusal:
            self._skipped[refusal.reason] += 1

    def end(self) -> None:
        """Gives up the rollouts that are still incomplete."""
        self._skipped.update(INCOMPLETE for parts in self._open.values() for _ in parts)
        self._open.clear()

    def _on_request(self, team: str, request: RolloutRequest) -> Iterator[tuple[WorldSpec, Rollout]]:
        key = request.run, request.rollout, request.attempt
        self._requests[(team, *key)] = request
        if len(self._requests) > MOST_REQUESTS:
            del self._requests[next(iter(self._requests))]
        for owner, group in [owner for owner, parts in self._open.items() if owner[0] == team and key in parts]:
            yield from self._advance(owner, group, key)

    def _on_datum(self, team: str, group: int, datum: Datum) -> Iterator[tuple[WorldSpec, Rollout]]:
        run, rollout, attempt, _ = datum.stamp
        if (team, group, run, rollout) in self._done:
            raise Refused(Refused.DUPLICATE, f'rollout {rollout} is complete')
        parts = self._open.setdefault((team, group), {})
        key = run, rollout, attempt
        if key not in parts:
            if len(parts) == self._most_open:
                del parts[next(iter(parts))]
                self._skipped[INCOMPLETE] += 1
            parts[key] = _Part()
        part = parts[key]
        if part.assembler is None:
            part.early.append(datum)
        else:
            _feed(part.assembler, datum)
        yield from self._advance(team, group, key)

    def _advance(self, team: str, group: int, key: tuple[int, int, int]) -> Iterator[tuple[WorldSpec, Rollout]]:
        """Joins what is there of a rollout; gives it if that is all of it."""
        parts = self._open[team, group]
        part, request = parts[key], self._requests.get((team, *key))
        if part.assembler is None and request is not None and part.begin(request):
            for datum in part.early:
                try:
                    _feed(part.assembler, datum)
                except Refused as refusal:
                    self._skipped[refusal.reason] += 1
            part.early.clear()
        if part.assembler is None or not part.assembler.complete:
            return
        others = [other for other in parts if other[:2] == key[:2] and other != key]
        self._skipped.update(INCOMPLETE for _ in others)
        for other in (key, *others):
            del parts[other]
        self._done.add((team, group, *key[:2]))
        yield part.spec, Rollout(team, group, part.assembler.request, part.assembler.trajectory())


def _feed(assembler: Assembler, datum: Datum) -> None:
    if isinstance(datum, JointState):
        assembler.on_joint_state(datum)
    elif isinstance(datum, Action):
        assembler.on_action(datum)
    else:
        assembler.on_reward(datum)


def _team(topic: str, levels: int) -> tuple[str, int]:
    """Namespace and group of the team that a topic, whose own name has so many levels, belongs to."""
    space = topic.strip('/').rsplit('/', levels)
    namespace = space[0] if len(space) > levels else ''
    group = _GROUP.fullmatch(namespace)
    return (group[1], int(group[2])) if group else (namespace, 0)
