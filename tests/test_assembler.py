"""The assembler joins data on their stamps in whatever order they come, and what does not belong changes nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies

from dae_ros.errors import Refused
from dae_ros.rollout.assembler import Assembler
from dae_ros.types import Action, JointState, Observation, SharedReward
from tests.played import (
    ACTIONS,
    DATA,
    REQUEST,
    REWARDS,
    SPEC,
    STATES,
    Bad,
    T,
    W,
    assert_same,
    collect,
    malformed_actions,
    misplaced,
    names_of,
    refused,
    stamped,
    wider,
    with_entry,
)


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
