"""A rollout of drifting worlds, all data of it, and data like them that do not belong to it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from dae_ros import draws
from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.types import Action, JointState, Observation, RolloutRequest, SharedReward, WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds

T, W, N, A, O, S = 4, 3, 2, 3, 2, 5
SPEC = WorldSpec(N, A, O, S, state_is_observations=False)
SIZES = PolicyArchitecture(O, A, hidden_size=4, mlp_layers=1, activation='relu')
RUN, VERSION = 5, 7
REQUEST = RolloutRequest(run=RUN, rollout=3, attempt=1, policy_version=VERSION, seed=11, num_steps=T, greedy=False)


class Drifting(Worlds):
    """Worlds whose every number hangs on all earlier actions, with episodes that end and others that are cut off."""

    spec, num_worlds = SPEC, W

    def reset(self, seed, rollout):
        self._name, self._step = (seed, rollout), 0
        self._sum = draws.generator(seed, 'reset', rollout).random((W, N))
        return self._show(np.ones(W, bool))

    def step(self, actions):
        self._sum = 0.7 * self._sum + actions + 1
        reward = self._sum.sum(1).astype(np.float32)
        drawn = draws.generator(self._name[0], 'ends', self._name[1], self._step).random(W)
        terminated, truncated = drawn < 0.2, drawn > 0.7
        finals = self._state()[truncated]
        self._step += 1
        self._sum[terminated | truncated] = 0
        return Transition(reward, terminated, truncated, finals, self._show(terminated | truncated))

    def _state(self):
        return np.concatenate([self._sum, self._sum**2, np.full((W, 1), self._step)], 1).astype(np.float32)

    def _show(self, episode_start):
        observations = np.stack([self._sum, np.full((W, N), self._step)], 2).astype(np.float32)
        return JointObservation(observations, self._state(), episode_start)


def make_policy(version=VERSION):
    generator = np.random.default_rng(version)
    return Policy(SIZES, {name: generator.normal(size=shape).astype(np.float32)
                          for name, shape in SIZES.shapes().items()})


POLICY = make_policy()


def collect(request=REQUEST):
    return InProcessCollector(Drifting()).collect(request, POLICY)


def assert_same(one, other):
    """Two data, or lists of them, are the same bit for bit."""
    if isinstance(one, (list, tuple)):
        assert type(one) is type(other) and len(one) == len(other)
        for left, right in zip(one, other):
            assert_same(left, right)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.shape == other.shape
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def play(request=REQUEST, worlds=Drifting):
    """All data of a rollout in the order they come about, each agent answering what it is asked."""
    world, agents = WorldEnd(worlds()), [AgentEnd(robot) for robot in range(N)]
    for agent in agents:
        agent.on_request(request)
        agent.on_policy(RUN, VERSION, POLICY)
    said, new = [], world.on_request(request)
    while new:
        said += new
        actions = [agents[datum.robot].on_observation(datum) for datum in new if isinstance(datum, Observation)]
        said += actions
        new = [datum for action in actions for datum in world.on_action(action)]
    return said


DATA = play()
OBSERVATIONS = [[datum for datum in DATA if isinstance(datum, Observation) and datum.robot == robot]
                for robot in range(N)]
ACTIONS = [[datum for datum in DATA if isinstance(datum, Action) and datum.robot == robot] for robot in range(N)]
STATES = [datum for datum in DATA if isinstance(datum, JointState)]
REWARDS = [datum for datum in DATA if isinstance(datum, SharedReward)]


def refused(reason, take, *datum):
    with pytest.raises(Refused) as caught:
        take(*datum)
    assert caught.value.reason == reason
    assert str(caught.value).startswith(f'{reason}: ') and caught.value.detail


def stamped(datum, **changed):
    return datum._replace(stamp=datum.stamp._replace(**changed))


def with_entry(array, index, value):
    changed = array.astype(array.dtype)
    changed[index] = value
    return changed


def wider(array, axis=-1):
    return np.concatenate([array, np.take(array, [0], axis)], axis)


class Bad(NamedTuple):
    """A datum to be refused, and why."""

    reason: str
    datum: tuple


def misplaced(datum, last):
    """The datum with every stamp it must not have."""
    return [
        Bad('wrong_run', stamped(datum, run=6)), Bad('wrong_run', stamped(datum, run=0)),
        Bad('stale', stamped(datum, rollout=2)), Bad('stale', stamped(datum, rollout=4, attempt=0)),
        Bad('stale', stamped(datum, attempt=0)),
        Bad('unexpected', stamped(datum, rollout=4)), Bad('unexpected', stamped(datum, rollout=2, attempt=2)),
        Bad('out_of_range', stamped(datum, step=last + 1)), Bad('out_of_range', stamped(datum, step=2**32 - 1)),
    ]


def malformed_actions(action):
    """The action with everything wrong that its sender can get wrong."""
    p, a = action.probabilities, action.actions
    impossible = with_entry(p, 1, np.eye(A, dtype=np.float32)[(a[1] + 1) % A])
    return [
        Bad('wrong_robot', action._replace(robot=N)), Bad('wrong_robot', action._replace(robot=65535)),
        Bad('wrong_version', action._replace(policy_version=VERSION - 1)),
        Bad('wrong_version', action._replace(policy_version=VERSION + 1)),
        Bad('wrong_shape', action._replace(probabilities=wider(p))),
        Bad('wrong_shape', action._replace(probabilities=wider(p, 0))),
        Bad('wrong_shape', action._replace(probabilities=p[:, :-1])),
        Bad('wrong_shape', action._replace(probabilities=p[:0])),
        Bad('wrong_shape', action._replace(actions=wider(a))), Bad('wrong_shape', action._replace(actions=a[:-1])),
        Bad('not_finite', action._replace(probabilities=with_entry(p, (1, 2), np.nan))),
        Bad('not_finite', action._replace(probabilities=with_entry(p, (0, 0), np.inf))),
        Bad('out_of_range', action._replace(probabilities=p * np.float32(1.01))),
        Bad('out_of_range', action._replace(probabilities=p * np.float32(0.99))),
        Bad('out_of_range', action._replace(probabilities=np.zeros_like(p))),
        Bad('out_of_range', action._replace(probabilities=with_entry(p, 1, [1.5, -0.5, 0.0]))),
        Bad('out_of_range', action._replace(actions=with_entry(a, 0, A))),
        Bad('out_of_range', action._replace(actions=with_entry(a, 2, 65535))),
        Bad('out_of_range', action._replace(probabilities=impossible)),
    ]


def names_of(bad):
    return [f'{type(one.datum).__name__} {number} {one.reason}' for number, one in enumerate(bad)]


def agent_with(*steps, robot=0):
    """An agent end that knows request and policy and acted at the given steps."""
    agent = AgentEnd(robot)
    agent.on_request(REQUEST)
    agent.on_policy(RUN, VERSION, POLICY)
    for step in steps:
        assert_same(agent.on_observation(OBSERVATIONS[robot][step]), ACTIONS[robot][step])
    return agent
