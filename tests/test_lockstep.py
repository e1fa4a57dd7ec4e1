"""Lockstep: rollouts hold what was sent at its place, the same bits again, also over a network that reorders and repeats."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies

from dae_ros.errors import Refused
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.types import Action, JointState, Observation, SharedReward
from tests.played import (
    ACTIONS,
    OBSERVATIONS,
    POLICY,
    REQUEST,
    REWARDS,
    RUN,
    SPEC,
    STATES,
    VERSION,
    Drifting,
    N,
    T,
    W,
    assert_same,
    collect,
    make_policy,
)


def test_the_rollout_these_tests_play_has_ends_of_all_kinds_in_its_middle():
    ended = np.stack([reward.terminated for reward in REWARDS]), np.stack([reward.truncated for reward in REWARDS])
    for kind in ended:
        assert kind[:-1].any() and not kind.all()
    assert len(STATES) == T + 1
    assert [len(data) for data in (REWARDS, *OBSERVATIONS, *ACTIONS)] == [T] * (1 + 2 * N)


def test_a_trajectory_holds_what_was_sent_at_its_place():
    trajectory = collect()
    assert [len(part) for part in trajectory[:9]] == [T, T + 1, T + 1, T, T, T, T, T, int(trajectory.truncated.sum())]
    assert trajectory[9:] == (None, None, None)
    for step, joint in enumerate(STATES):
        np.testing.assert_array_equal(trajectory.states[step], joint.state)
        np.testing.assert_array_equal(trajectory.episode_start[step], joint.episode_start)
        if step < T:
            np.testing.assert_array_equal(trajectory.observations[step], joint.observations)
    for robot in range(N):
        for step, (observation, action) in enumerate(zip(OBSERVATIONS[robot], ACTIONS[robot])):
            np.testing.assert_array_equal(observation.values, trajectory.observations[step, :, robot])
            np.testing.assert_array_equal(action.actions, trajectory.actions[step, :, robot])
            np.testing.assert_array_equal(action.probabilities, trajectory.probabilities[step, :, robot])
    for step, shared in enumerate(REWARDS):
        np.testing.assert_array_equal(shared.reward, trajectory.rewards[step])
    np.testing.assert_array_equal(np.concatenate([shared.final_states for shared in REWARDS]), trajectory.final_states)


def test_the_types_of_a_trajectory_are_those_the_learner_takes():
    kinds = [np.float32, np.float32, bool, np.int64, np.float32, np.float32, bool, bool, np.float32]
    assert [part.dtype for part in collect()[:9]] == kinds


def test_a_robot_s_actions_are_those_of_its_policy_with_its_memory_of_the_episode():
    trajectory = collect()
    for robot in range(N):
        state = POLICY.initial_state(W)
        for step in range(T):
            observed, start = trajectory.observations[step, :, robot], trajectory.episode_start[step]
            probabilities, state = POLICY.act(observed, state, start)
            np.testing.assert_array_equal(trajectory.probabilities[step, :, robot], probabilities)


def test_a_greedy_rollout_has_each_robot_s_most_probable_actions():
    trajectory = collect(REQUEST._replace(greedy=True))
    np.testing.assert_array_equal(trajectory.actions, trajectory.probabilities.argmax(-1))
    assert (collect().actions != collect().probabilities.argmax(-1)).any()


@pytest.mark.parametrize('attempt', [0, 2, 1000])
def test_another_attempt_gives_the_same_data(attempt):
    assert_same(collect(REQUEST._replace(attempt=attempt)), collect())


@pytest.mark.parametrize('change', [{'seed': 12}, {'rollout': 4}], ids=str)
def test_another_seed_or_rollout_gives_other_data(change):
    other = collect(REQUEST._replace(**change))
    assert not np.array_equal(other.rewards, collect().rewards)


def test_a_collector_gives_the_same_rollout_again_after_others():
    collector = InProcessCollector(Drifting())
    first = collector.collect(REQUEST, POLICY)
    kept = first.map(np.copy)
    collector.collect(REQUEST._replace(rollout=4, policy_version=8), make_policy(8))
    again = collector.collect(REQUEST._replace(rollout=5, seed=11), POLICY)
    assert_same(first, kept)  # the next rollouts did not touch it
    assert not np.array_equal(again.rewards, first.rewards)
    assert_same(InProcessCollector(Drifting()).collect(REQUEST, POLICY), first)


class Network:
    """A team and its trainer; what they send each other arrives in an order of its own, and some of it twice."""

    def __init__(self, seed, repeats):
        self._random, self._repeats = random.Random(seed), repeats
        self.world, self.assembler = WorldEnd(Drifting()), Assembler(SPEC, W)
        self.agents = [AgentEnd(robot) for robot in range(N)]
        self._under_way = [(agent.on_policy, (RUN, VERSION, POLICY)) for agent in self.agents]

    def ask(self, request):
        self.assembler.begin(request)
        self._under_way += [(party.on_request, (request,)) for party in (self.world, *self.agents)]

    def deliver(self, count=10**9):
        """Up to so many deliveries, or all."""
        while count and self._under_way:
            count -= 1
            place = self._random.randrange(len(self._under_way))
            take, arguments = self._under_way[place]
            if self._random.random() >= self._repeats:
                del self._under_way[place]
            try:
                answer = take(*arguments)
            except Refused:
                continue
            for datum in answer if isinstance(answer, list) else [answer]:
                self._send(datum)

    def _send(self, datum):
        takers = {Observation: lambda: [self.agents[datum.robot].on_observation],
                  Action: lambda: [self.world.on_action, self.assembler.on_action],
                  JointState: lambda: [self.assembler.on_joint_state], SharedReward: lambda: [self.assembler.on_reward],
                  type(None): lambda: []}[type(datum)]()
        self._under_way += [(take, (datum,)) for take in takers]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32), repeats=strategies.floats(0, 0.4))
def test_on_a_network_that_reorders_and_repeats_the_team_collects_the_same_rollout(seed, repeats):
    network = Network(seed, repeats)
    network.ask(REQUEST)
    network.deliver()
    assert network.assembler.complete
    assert_same(network.assembler.trajectory(), collect())


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32), repeats=strategies.floats(0, 0.4),
       patience=strategies.lists(strategies.integers(0, 40), min_size=1, max_size=2))
@example(seed=1, repeats=0.0, patience=[0])
def test_a_rollout_given_up_in_its_middle_is_the_same_when_it_is_begun_anew(seed, repeats, patience):
    network = Network(seed, repeats)
    network.ask(REQUEST)
    for attempt, deliveries in enumerate(patience, start=2):
        network.deliver(deliveries)
        network.ask(REQUEST._replace(attempt=attempt))
    network.deliver()
    assert network.assembler.complete
    assert_same(network.assembler.trajectory(), collect())
