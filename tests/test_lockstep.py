"""Lockstep: data are joined on their stamps in whatever order they come, and what does not belong changes nothing."""

import random
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies

from dae_ros import draws
from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.rollout.assembler import Assembler
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


def test_the_rollout_these_tests_play_has_ends_of_all_kinds_in_its_middle():
    ended = np.stack([reward.terminated for reward in REWARDS]), np.stack([reward.truncated for reward in REWARDS])
    for kind in ended:
        assert kind[:-1].any() and not kind.all()
    assert len(STATES) == T + 1
    assert [len(data) for data in (REWARDS, *OBSERVATIONS, *ACTIONS)] == [T] * (1 + 2 * N)


# A trajectory.


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


# The assembler.


def assembler_of(request=REQUEST):
    assembler = Assembler(SPEC, W)
    assembler.begin(request)
    return assembler


def hand_over(assembler, datum):
    if isinstance(datum, JointState):
        assembler.on_joint_state(datum)
    elif isinstance(datum, Action):
        assembler.on_action(datum)
    elif isinstance(datum, SharedReward):
        assembler.on_reward(datum)


FOR_TRAINER = [datum for datum in DATA if not isinstance(datum, Observation)]


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


def bad_for_the_trainer():
    joint, action, shared = STATES[1], ACTIONS[1][1], next(one for one in REWARDS if one.truncated.any())
    ended = with_entry(shared.terminated, np.flatnonzero(shared.truncated)[0], True)
    bad = misplaced(joint, T) + misplaced(action, T - 1) + misplaced(shared, T - 1) + malformed_actions(action)
    bad += [Bad('wrong_shape', joint._replace(**{name: part})) for name in ('observations', 'state', 'episode_start')
            for part in (wider(getattr(joint, name)), wider(getattr(joint, name), 0), getattr(joint, name)[:-1])]
    bad += [Bad('not_finite', joint._replace(observations=with_entry(joint.observations, (0, 1, 0), np.nan))),
            Bad('not_finite', joint._replace(state=with_entry(joint.state, (2, 4), -np.inf)))]
    bad += [Bad('wrong_shape', shared._replace(**{name: wider(getattr(shared, name))}))
            for name in ('reward', 'terminated', 'truncated')]
    bad += [Bad('wrong_shape', shared._replace(final_states=finals)) for finals in (
                shared.final_states[:-1], wider(shared.final_states, 0), wider(shared.final_states))]
    bad += [Bad('not_finite', shared._replace(reward=with_entry(shared.reward, 0, np.nan))),
            Bad('not_finite', shared._replace(final_states=shared.final_states + np.float32(np.inf))),
            Bad('out_of_range', shared._replace(terminated=ended))]
    return bad


def names_of(bad):
    return [f'{type(one.datum).__name__} {number} {one.reason}' for number, one in enumerate(bad)]


BAD_FOR_TRAINER = bad_for_the_trainer()


@pytest.mark.parametrize('bad', BAD_FOR_TRAINER, ids=names_of(BAD_FOR_TRAINER))
def test_the_assembler_refuses_what_does_not_belong_and_nothing_changes(bad):
    assembler = assembler_of()
    refused(bad.reason, hand_over, assembler, bad.datum)
    for datum in FOR_TRAINER:
        assert not assembler.complete
        missing = assembler.missing()
        refused(bad.reason, hand_over, assembler, bad.datum)
        assert assembler.missing() == missing
        hand_over(assembler, datum)
    assert_same(assembler.trajectory(), collect())


def test_the_assembler_takes_the_first_of_two_data_of_a_step_and_refuses_the_second_whatever_it_holds():
    assembler = assembler_of()
    for datum in FOR_TRAINER:
        hand_over(assembler, datum)
        name = {JointState: 'state', SharedReward: 'reward', Action: 'probabilities'}[type(datum)]
        for again in (datum, datum._replace(**{name: np.roll(getattr(datum, name), 1, axis=-1)})):
            refused('duplicate', hand_over, assembler, again)
    assert_same(assembler.trajectory(), collect())


def test_the_assembler_refuses_everything_before_a_rollout_is_asked_for():
    assembler = Assembler(SPEC, W)
    for datum in FOR_TRAINER:
        refused('unexpected', hand_over, assembler, datum)
        refused('wrong_run', hand_over, assembler, stamped(datum, run=0))
    assert not assembler.complete and assembler.missing()
    assembler.begin(REQUEST)
    for datum in FOR_TRAINER:
        hand_over(assembler, datum)
    assert_same(assembler.trajectory(), collect())


def test_the_assembler_says_what_is_missing_until_nothing_is():
    assembler = assembler_of()
    assert assembler.missing() == '5 of 5 joint states, 4 of 4 rewards, actions of robots 0, 1'
    for datum in (*STATES, *ACTIONS[0], *REWARDS[1:], *ACTIONS[1][:-1]):
        hand_over(assembler, datum)
    assert assembler.missing() == '0 of 5 joint states, 1 of 4 rewards, actions of robots 1'
    assert not assembler.complete
    for datum in (REWARDS[0], ACTIONS[1][-1]):
        hand_over(assembler, datum)
    assert assembler.complete


@pytest.mark.parametrize('left_out', range(len(FOR_TRAINER)))
def test_a_rollout_is_complete_with_its_last_datum_whichever_that_is(left_out):
    assembler = assembler_of()
    for datum in FOR_TRAINER[:left_out] + FOR_TRAINER[left_out + 1:]:
        hand_over(assembler, datum)
    assert not assembler.complete
    hand_over(assembler, FOR_TRAINER[left_out])
    assert assembler.complete


def test_a_rollout_begun_anew_keeps_nothing_of_the_one_before():
    assembler = assembler_of()
    for datum in FOR_TRAINER[:-1]:
        hand_over(assembler, datum)
    again = REQUEST._replace(attempt=2)
    assembler.begin(again)
    refused('stale', hand_over, assembler, FOR_TRAINER[-1])
    assert not assembler.complete
    for datum in FOR_TRAINER:
        hand_over(assembler, stamped(datum, attempt=2))
    trajectory = assembler.trajectory()
    assert_same(trajectory, collect())
    assembler.begin(REQUEST._replace(rollout=4))
    for datum in STATES:
        hand_over(assembler, stamped(datum, rollout=4)._replace(state=datum.state + 1))
    assert_same(trajectory, collect())


STALE = [stamped(datum, attempt=0) for datum in FOR_TRAINER] + [stamped(datum, rollout=2) for datum in FOR_TRAINER]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=strategies.data())
def test_data_in_any_order_with_duplicates_and_stale_ones_among_them_are_joined_to_the_same_trajectory(data):
    noise = strategies.lists(strategies.sampled_from([*FOR_TRAINER, *STALE, *(bad.datum for bad in BAD_FOR_TRAINER)]),
                             max_size=15)
    order = data.draw(strategies.permutations([*FOR_TRAINER, *data.draw(noise)]))
    assembler, taken = assembler_of(), []
    for datum in order:
        try:
            hand_over(assembler, datum)
        except Refused:
            continue
        taken.append(datum)
    assert len(taken) == len(FOR_TRAINER) and assembler.complete
    assert_same(assembler.trajectory(), collect())


# The world.


def world_at(step):
    """A world end that took in the first steps of the rollout."""
    world = WorldEnd(Drifting())
    world.on_request(REQUEST)
    for at in range(step):
        for robot in range(N):
            world.on_action(ACTIONS[robot][at])
    return world


def rest_of(world, step):
    """What the world says from a step to the end of the rollout."""
    return [datum for at in range(step, T) for robot in range(N) for datum in world.on_action(ACTIONS[robot][at])]


FROM_STEP = [rest_of(world_at(step), step) for step in range(T + 1)]


def test_the_world_says_the_observations_first_and_the_joint_state_and_reward_of_each_step():
    world = WorldEnd(Drifting())
    assert world.waiting_for == []
    assert_same(world.on_request(REQUEST), [OBSERVATIONS[0][0], OBSERVATIONS[1][0], STATES[0]])
    for step in range(T):
        assert world.waiting_for == [0, 1]
        assert world.on_action(ACTIONS[1][step]) == []
        assert world.waiting_for == [0]
        said = world.on_action(ACTIONS[0][step])
        observations = [OBSERVATIONS[robot][step + 1] for robot in range(N)] if step + 1 < T else []
        assert_same(said, [REWARDS[step], *observations, STATES[step + 1]])
    assert world.waiting_for == []


def bad_for_the_world(step):
    action = ACTIONS[0][step]
    bad = misplaced(action, T - 1)[:-2] + malformed_actions(action)
    bad += [Bad('unexpected', stamped(action, step=later)) for later in (step + 1, T, 2**32 - 1)]
    bad += [Bad('duplicate', stamped(action, step=earlier)) for earlier in range(step)]
    return bad


@pytest.mark.parametrize('step', range(T))
def test_the_world_refuses_actions_that_do_not_belong_and_nothing_changes(step):
    for bad in bad_for_the_world(step):
        world = world_at(step)
        refused(bad.reason, world.on_action, bad.datum)
        assert world.waiting_for == [0, 1]
        assert world.on_action(ACTIONS[1][step]) == []
        refused(bad.reason, world.on_action, bad.datum)
        assert world.waiting_for == [0] and world.request == REQUEST
        said = [*world.on_action(ACTIONS[0][step]), *rest_of(world, step + 1)]
        assert_same(said, FROM_STEP[step])


def test_the_world_takes_each_robot_s_first_action_of_a_step_and_refuses_the_second():
    world = world_at(1)
    world.on_action(ACTIONS[0][1])
    other = ACTIONS[0][1]._replace(actions=ACTIONS[0][1].probabilities.argmin(1))
    for again in (ACTIONS[0][1], other):
        refused('duplicate', world.on_action, again)
    said = [*world.on_action(ACTIONS[1][1]), *rest_of(world, 2)]
    assert_same(said, FROM_STEP[1])


def test_the_world_refuses_actions_before_a_rollout_and_after_its_last_step():
    for world in (WorldEnd(Drifting()), WorldEnd(Drifting(), run=5)):
        refused('unexpected', world.on_action, ACTIONS[0][0])
    world = world_at(T)
    refused('duplicate', world.on_action, ACTIONS[0][T - 1])
    refused('unexpected', world.on_action, stamped(ACTIONS[0][T - 1], step=T))


def test_the_world_begins_anew_for_a_later_request_and_for_no_other():
    world = world_at(2)
    for reason, request in [
            ('duplicate', REQUEST), ('duplicate', REQUEST._replace(seed=12)), ('stale', REQUEST._replace(rollout=2)),
            ('stale', REQUEST._replace(rollout=4, attempt=0)), ('wrong_run', REQUEST._replace(run=6, rollout=9)),
            ('wrong_run', REQUEST._replace(run=0, rollout=9))]:
        refused(reason, world.on_request, request)
        assert world.request == REQUEST and world.waiting_for == [0, 1]
    assert_same(rest_of(world, 2), FROM_STEP[2])
    world = world_at(2)
    world.on_action(ACTIONS[0][2])
    said = world.on_request(REQUEST._replace(attempt=2))
    assert_same(said, [stamped(datum, attempt=2) for datum in (OBSERVATIONS[0][0], OBSERVATIONS[1][0], STATES[0])])
    refused('stale', world.on_action, ACTIONS[1][2])
    assert world.waiting_for == [0, 1]


def test_world_and_agent_follow_a_trainer_that_came_back_at_an_earlier_rollout_and_no_message_from_before():
    world, agent = world_at(2), agent_with(0, 1)
    back = REQUEST._replace(rollout=1, attempt=2)
    assert world.on_request(back)[0].stamp.order == back.order
    agent.on_request(back)
    for late in (REQUEST, REQUEST._replace(rollout=9)):
        refused('stale', world.on_request, late)
        refused('stale', agent.on_request, late)
    refused('stale', world.on_action, ACTIONS[0][2])
    refused('stale', agent.on_observation, OBSERVATIONS[0][2])
    assert world.request == agent.request == back
    assert agent.on_observation(stamped(OBSERVATIONS[0][0], rollout=1, attempt=2)) is not None


def test_a_world_without_a_run_joins_that_of_its_first_request_and_one_with_a_run_keeps_it():
    world = WorldEnd(Drifting())
    world.on_request(REQUEST)
    assert world.run == 5
    bound = WorldEnd(Drifting(), run=6)
    refused('wrong_run', bound.on_request, REQUEST)
    assert bound.request is None
    refused('wrong_run', WorldEnd(Drifting()).on_request, REQUEST._replace(run=0))


# The agent.


def agent_with(*steps, robot=0):
    """An agent end that knows request and policy and acted at the given steps."""
    agent = AgentEnd(robot)
    agent.on_request(REQUEST)
    agent.on_policy(RUN, VERSION, POLICY)
    for step in steps:
        assert_same(agent.on_observation(OBSERVATIONS[robot][step]), ACTIONS[robot][step])
    return agent


@pytest.mark.parametrize('order', ['rpo', 'pro', 'rop', 'por', 'orp', 'opr'])
def test_an_agent_acts_once_request_policy_and_observation_are_there_in_whatever_order(order):
    agent = AgentEnd(1)
    takes = {'r': lambda: agent.on_request(REQUEST), 'p': lambda: agent.on_policy(RUN, VERSION, POLICY),
             'o': lambda: agent.on_observation(OBSERVATIONS[1][0])}
    answers = [takes[what]() for what in order]
    assert answers[:2] == [None, None]
    assert_same(answers[2], ACTIONS[1][0])
    for step in range(1, T):
        assert_same(agent.on_observation(OBSERVATIONS[1][step]), ACTIONS[1][step])


def test_an_agent_acts_with_the_version_asked_for_and_with_no_other():
    agent = AgentEnd(0)
    agent.on_policy(RUN, VERSION - 1, make_policy(VERSION - 1))
    agent.on_request(REQUEST)
    assert agent.missing_version == VERSION and agent.newest_version == VERSION - 1
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    assert agent.on_policy(RUN, VERSION + 1, make_policy(VERSION + 1)) is None
    assert agent.missing_version == VERSION and agent.newest_version == VERSION + 1
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])
    assert agent.missing_version is None


def test_an_agent_keeps_the_version_in_use_however_many_newer_ones_come():
    agent = agent_with(0)
    for version in range(VERSION + 1, VERSION + 5):
        agent.on_policy(RUN, version, make_policy(version))
    for step in range(1, T):
        assert_same(agent.on_observation(OBSERVATIONS[0][step]), ACTIONS[0][step])


def test_an_agent_refuses_a_version_it_holds():
    agent = agent_with(0)
    refused('duplicate', agent.on_policy, RUN, VERSION, make_policy(1))
    assert_same(agent.on_observation(OBSERVATIONS[0][1]), ACTIONS[0][1])


def bad_for_the_agent(step):
    observation = OBSERVATIONS[0][step]
    values = observation.values
    return [
        Bad('wrong_run', stamped(observation, run=6)), Bad('wrong_run', stamped(observation, run=0)),
        Bad('wrong_run', stamped(observation, run=6, rollout=9)),
        Bad('stale', stamped(observation, rollout=2)), Bad('stale', stamped(observation, attempt=0)),
        Bad('wrong_robot', observation._replace(robot=1)),
        Bad('not_finite', observation._replace(values=with_entry(values, (2, 1), np.nan))),
        Bad('not_finite', observation._replace(values=with_entry(values, (0, 0), np.inf))),
        Bad('duplicate', stamped(observation, step=step - 1)), Bad('unexpected', stamped(observation, step=step + 1)),
        Bad('wrong_version', observation._replace(policy_version=VERSION + 1)),
        Bad('wrong_shape', observation._replace(values=wider(values))),
        Bad('wrong_shape', observation._replace(values=values[:-1], episode_start=observation.episode_start[:-1])),
    ]


@pytest.mark.parametrize('step', range(1, T))
def test_an_agent_refuses_observations_that_do_not_belong_and_nothing_changes(step):
    for bad in bad_for_the_agent(step):
        agent = agent_with(*range(step))
        refused(bad.reason, agent.on_observation, bad.datum)
        for later in range(step, T):
            assert_same(agent.on_observation(OBSERVATIONS[0][later]), ACTIONS[0][later])


def test_an_agent_acts_once_on_an_observation():
    agent = agent_with(0, 1)
    for step in (0, 1):
        refused('duplicate', agent.on_observation, OBSERVATIONS[0][step])


def test_an_agent_begins_anew_for_a_later_request_and_for_no_other():
    agent = agent_with(0, 1)
    for request in (REQUEST, REQUEST._replace(rollout=2), REQUEST._replace(rollout=4, attempt=0)):
        with pytest.raises(Refused) as caught:
            agent.on_request(request)
        assert caught.value.reason in ('stale', 'duplicate')
    for run in (0, 6):
        refused('wrong_run', agent.on_request, REQUEST._replace(run=run, rollout=9))
    assert_same(agent.on_observation(OBSERVATIONS[0][2]), ACTIONS[0][2])
    agent.on_request(REQUEST._replace(attempt=2))
    for step in range(T):  # from the first step, without the memory of the attempt before
        answer = agent.on_observation(stamped(OBSERVATIONS[0][step], attempt=2))
        assert_same(answer, stamped(ACTIONS[0][step], attempt=2))


def test_an_agent_begins_a_rollout_without_memory_also_where_no_episode_starts_with_it():
    agent = agent_with(0, 1)
    agent.on_request(REQUEST._replace(attempt=2))
    observation = stamped(OBSERVATIONS[0][2], attempt=2, step=0)._replace(episode_start=np.zeros(W, bool))
    answer = agent.on_observation(observation)
    probabilities, _ = POLICY.act(observation.values, POLICY.initial_state(W), observation.episode_start)
    np.testing.assert_array_equal(answer.probabilities, probabilities)


def test_an_agent_takes_another_number_of_worlds_with_a_new_rollout():
    agent = agent_with(0, 1)
    agent.on_request(REQUEST._replace(rollout=4))
    first = stamped(OBSERVATIONS[0][0], rollout=4)
    answer = agent.on_observation(first._replace(values=first.values[:2], episode_start=first.episode_start[:2]))
    assert answer.actions.shape == (2,)


def test_an_agent_that_waits_for_a_policy_forgets_the_observation_of_an_attempt_given_up():
    agent = AgentEnd(0)
    agent.on_request(REQUEST)
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    agent.on_request(REQUEST._replace(attempt=2))
    assert agent.on_policy(RUN, VERSION, POLICY) is None
    answer = agent.on_observation(stamped(OBSERVATIONS[0][0], attempt=2))
    assert_same(answer, stamped(ACTIONS[0][0], attempt=2))


def test_an_agent_keeps_an_observation_that_came_before_its_request_and_one_more_that_was_given_up():
    agent = AgentEnd(0)
    agent.on_policy(RUN, VERSION, POLICY)
    assert agent.on_observation(stamped(OBSERVATIONS[0][0], attempt=2)) is None
    assert agent.on_request(REQUEST) is None
    assert_same(agent.on_request(REQUEST._replace(attempt=2)), stamped(ACTIONS[0][0], attempt=2))


def test_an_agent_that_waits_for_a_policy_refuses_a_second_observation_of_the_step_whatever_it_holds():
    agent, genuine = AgentEnd(0), OBSERVATIONS[0][0]
    agent.on_request(REQUEST)
    assert agent.on_observation(genuine) is None
    for other in (genuine, genuine._replace(values=genuine.values + 1), genuine._replace(values=wider(genuine.values))):
        refused('duplicate', agent.on_observation, other)
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])


def test_an_agent_without_a_run_joins_that_of_its_first_request_and_one_with_a_run_keeps_it():
    agent = AgentEnd(0)
    agent.on_request(REQUEST)
    assert agent.run == 5
    bound = AgentEnd(0, run=6)
    refused('wrong_run', bound.on_request, REQUEST)
    refused('wrong_run', bound.on_observation, OBSERVATIONS[0][0])
    assert bound.request is None


def test_an_agent_without_a_run_acts_with_the_policy_of_the_run_that_asks_it_and_of_no_other():
    agent = AgentEnd(0)
    agent.on_policy(6, VERSION, make_policy(1))
    agent.on_observation(stamped(OBSERVATIONS[0][0], run=6))
    assert agent.on_request(REQUEST) is None and agent.missing_version == VERSION
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])
    refused('wrong_run', agent.on_policy, 6, VERSION + 1, POLICY)


def test_an_agent_without_a_run_keeps_policies_of_a_few_runs_until_one_asks_it():
    agent = AgentEnd(0)
    for run in (RUN, 6, 7, 8):
        for version in (VERSION - 2, VERSION - 1, VERSION):
            agent.on_policy(run, version, POLICY if run == RUN else make_policy(run))
    agent.on_request(REQUEST)
    assert_same(agent.on_observation(OBSERVATIONS[0][0]), ACTIONS[0][0])
    flooded = AgentEnd(0)
    for run in range(1, 1000):
        flooded.on_policy(run, VERSION, POLICY)
    flooded.on_request(REQUEST)
    assert flooded.missing_version == VERSION


# All of them, on a network that delays, reorders and repeats.


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
