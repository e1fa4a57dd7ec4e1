"""A replayed run gives its rollouts whole and in order, whatever the order of its messages, and none of another training."""

import random

import numpy as np
import pytest

from dae_ros.errors import SettingsError, StalledError
from dae_ros.replay.bag import Bag
from dae_ros.replay.replayed_run import MOST_EARLY, ReplayedRun
from dae_ros.rollout.groups import join
from dae_ros.types import RolloutRequest
from tests.bags import Team, write_bag

ROLLOUTS = 12


def messages(path):
    return list(Bag(path, {}).messages())


@pytest.fixture(scope='module')
def played():
    team = Team()
    return [team.play(rollout) for rollout in range(ROLLOUTS)]


@pytest.fixture
def bag(played, tmp_path):
    return messages(write_bag(tmp_path / 'bag', [datum for _, data in played for datum in data]))


def replayed(groups=1):
    return ReplayedRun(Team().spec, 4, groups)


def wanted(rollout, **changes):
    request = Team().play(rollout)[1][0]
    assert isinstance(request, RolloutRequest)
    return request._replace(run=99, attempt=5, **changes)  # the training's own


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_rollouts_come_in_order_whatever_the_order_of_the_messages(played, bag):
    run = replayed()
    random.Random(1).shuffle(bag)
    for message in bag:
        run.take(message)
    assert all(same(run.answer(wanted(rollout)), played[rollout][0]) for rollout in range(ROLLOUTS))
    assert run.answer(wanted(ROLLOUTS)) is None and not run.skipped


def test_the_groups_of_a_rollout_are_joined_in_their_order(played, tmp_path):
    other = Team(policy_seed=1)
    others = [other.play(rollout) for rollout in range(2)]
    groups = [[datum for _, data in played[:2] for datum in data], [datum for _, data in others for datum in data]]
    bags = [messages(write_bag(tmp_path / f'bag_{group}', data, group=f'/group_{group}')) for group, data in enumerate(groups)]
    run = replayed(2)
    for message in bags[1]:
        run.take(message)
    assert run.answer(wanted(0)) is None
    for message in bags[0]:
        run.take(message)
    for rollout in range(2):
        assert same(run.answer(wanted(rollout)), join([played[rollout][0], others[rollout][0]]))


def test_a_replay_that_is_repeated_or_of_another_run_changes_nothing(played, bag, tmp_path):
    run = replayed()
    stranger = messages(write_bag(tmp_path / 'stranger', Team().play(1, run=8)[1]))
    for message in [*bag[:len(bag) // 2], *stranger, *bag]:
        run.take(message)
    assert all(same(run.answer(wanted(rollout)), played[rollout][0]) for rollout in range(ROLLOUTS))
    assert run.skipped['other_run'] == 1 and run.skipped['duplicate'] > 0


def test_a_training_that_was_resumed_passes_over_what_it_has_learnt(played, bag):
    run = replayed()
    assert run.answer(wanted(3)) is None
    for message in bag:
        run.take(message)
    assert run.skipped == {'earlier': 3} and same(run.answer(wanted(3)), played[3][0])


def test_a_rollout_that_is_missing_is_named(played, bag):
    run = replayed()
    for message in bag[:10] + bag[11:]:
        run.take(message)
    with pytest.raises(StalledError, match='rollout 0 is missing from the replay'):
        run.answer(wanted(0))
    assert MOST_EARLY < ROLLOUTS - 1


@pytest.mark.parametrize('change', [{'seed': 2}, {'policy_version': 3}, {'num_steps': 7}, {'greedy': True}])
def test_a_run_of_other_settings_is_refused_in_one_sentence(change, bag):
    run = replayed()
    for message in bag:
        run.take(message)
    (name, value), = change.items()
    with pytest.raises(SettingsError, match=f'rollout 0 was recorded with {name} .*, and {value} is asked for'):
        run.answer(wanted(0, **change))


def test_worlds_of_other_sizes_are_not_used(bag):
    run = ReplayedRun(Team().spec, 8, 1)
    for message in bag:
        run.take(message)
    assert run.skipped == {'other_sizes': ROLLOUTS} and run.answer(wanted(0)) is None
