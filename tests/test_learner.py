"""The learner: what must not change an update by a bit, chunks and mini-batches, ends of episodes, and that it learns."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning.networks import REWARD_NETWORKS, RewardNetwork
from dae_ros.learning.policy import choose
from dae_ros.weights.codec import decode_checkpoint, encode_checkpoint, encode_policy
from tests.learners import (
    COMA,
    LEARNER,
    PLAIN,
    PLAIN_REWARD,
    REPLAY,
    REWARD,
    REWARDS,
    SHARED_TRUNK,
    SPEC,
    assert_same_bits,
    parameters,
    random_trajectory,
    same_weights,
    state_of,
)

# What must not change an update by a bit.


def updated(learner, rollouts, **kind):
    """Metrics of the last of some updates on rollouts of noise."""
    for rollout in rollouts:
        metrics = learner.update(random_trajectory(seed=rollout, **kind), rollout)
    return metrics


@REWARDS
@pytest.mark.parametrize('mini_batches', [1, 3])
def test_the_weights_do_not_depend_on_the_number_of_threads(mini_batches, reward_settings, make_learner):
    settings = replace(LEARNER, num_mini_batches=mini_batches)
    states, metrics = [], []
    for threads in (1, 2, 3):
        learner = make_learner(replace(settings, learner_threads=threads), replace(reward_settings, ensemble_size=2))
        metrics.append(updated(learner, range(2), steps=10, worlds=210))  # three shards of the actor's rows
        states.append(state_of(learner))
    for other in (1, 2):
        assert_same_bits(states[0], states[other])
        assert metrics[0] == metrics[other]


@REWARDS
def test_the_same_seed_learns_the_same_and_another_seed_something_else(reward_settings, make_learner):
    states = []
    for seed in (1, 1, 2):
        learner = make_learner(reward_settings=reward_settings, seed=seed)
        updated(learner, range(2))
        states.append(state_of(learner))
    assert_same_bits(states[0], states[1])
    for network in ('actor', 'critic', 'reward_network.0'):
        assert not same_weights(states[0], states[2], network)


@pytest.mark.parametrize('settings, reward_settings', [
    (LEARNER, REWARD), (replace(LEARNER, beta=0.0), REWARD), (replace(LEARNER, num_mini_batches=2), REWARD),
    (LEARNER, replace(REWARD, ensemble_size=2)), (LEARNER, SHARED_TRUNK), (COMA, REWARD),
    (replace(LEARNER, estimator='coma_nstep'), SHARED_TRUNK), (LEARNER, replace(REPLAY, ensemble_size=2))],
    ids=['beta 0.9', 'beta 0', 'mini-batches', 'ensemble', 'shared trunk', 'coma', 'coma n-step', 'replay'])
def test_a_learner_goes_on_from_a_checkpoint_bit_for_bit(settings, reward_settings, make_learner):
    one, other = make_learner(settings, reward_settings), make_learner(settings, reward_settings, seed=1)
    updated(one, range(3))
    tensors, _ = decode_checkpoint(encode_checkpoint(one.state(), {}))
    updated(other, [7])
    other.load_state(tensors)
    assert_same_bits(state_of(one), state_of(other))
    assert encode_policy(one.policy) == encode_policy(other.policy)
    assert updated(one, range(3, 5)) == updated(other, range(3, 5))
    assert_same_bits(state_of(one), state_of(other))


def test_a_learner_does_not_keep_the_memory_of_the_state_it_took_over(make_learner):
    one, other = make_learner(), make_learner()
    updated(one, range(2))
    saved = state_of(one)
    kept = {name: tensor.copy() for name, tensor in saved.items()}
    other.load_state(saved)
    updated(other, [2])
    assert_same_bits(saved, kept)


def test_the_state_of_another_network_is_not_taken_over(make_learner):
    learner = make_learner()
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(replace(LEARNER, hidden_size=9))))
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(replace(LEARNER, beta=0.0))))
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(reward_settings=SHARED_TRUNK)))


def test_an_update_leaves_the_rollout_and_earlier_policies_as_they_were(make_learner):
    learner, trajectory = make_learner(), random_trajectory()
    copies = trajectory.map(np.copy)
    policy = learner.policy
    encoded = encode_policy(policy)
    learner.update(trajectory, 0)
    for part, copy in zip(trajectory, copies):
        np.testing.assert_array_equal(part, copy)
    assert encode_policy(policy) == encoded != encode_policy(learner.policy)


# beta = 0.


def test_at_beta_0_there_is_no_reward_network_and_its_settings_change_nothing(make_learner):
    states = []
    others = replace(SHARED_TRUNK, hidden_size=5, ensemble_size=3, learning_rate=0.5, epochs=7)
    for reward_settings in (REWARD, others):
        learner = make_learner(replace(LEARNER, beta=0.0), reward_settings)
        metrics = updated(learner, range(2))
        assert not [name for name in (*learner.state(), *metrics) if 'reward' in name]
        states.append(state_of(learner))
    assert_same_bits(*states)


@REWARDS
def test_at_beta_0_no_reward_network_is_built_or_run(reward_settings, make_learner, monkeypatch):
    def refuse(*arguments, **more):
        raise AssertionError('a reward network at beta 0')

    for name in ('__init__', 'inputs', 'forward', 'gradient'):
        for architecture in (RewardNetwork, *REWARD_NETWORKS.values()):
            monkeypatch.setattr(architecture, name, refuse)
    updated(make_learner(replace(LEARNER, beta=0.0), reward_settings), range(1))
    with pytest.raises(AssertionError, match='a reward network at beta 0'):
        make_learner(LEARNER, reward_settings)


# Chunks, filling and mini-batches.

IDLE = replace(LEARNER, learning_rate=0.0, epochs=1)  # shows the losses of the first epoch, undisturbed
IDLE_REWARD = replace(REWARD, learning_rate=0.0, epochs=1)


def close_metrics(one, other, tolerance=1e-4):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name] == pytest.approx(other[name], rel=tolerance, abs=1e-5), name


@REWARDS
@pytest.mark.parametrize('length', [1, 3, 5, 21, 50])
def test_losses_do_not_depend_on_how_the_rollout_is_cut(length, reward_settings, make_learner):
    idle = replace(reward_settings, learning_rate=0.0, epochs=1)

    def losses(chunk_length):
        metrics = updated(make_learner(replace(IDLE, chunk_length=chunk_length), idle), range(1))
        return {name: value for name, value in metrics.items() if not name.endswith('gradient_norm')}

    close_metrics(losses(length), losses(7))


@pytest.mark.parametrize('length', [2, 4, 10, 40])
def test_filling_leaves_the_gradients_what_they_are(length, make_learner):
    """Of episodes of one step: nothing is passed on in time, so however they are cut, only the filling differs."""
    states = []
    for chunk_length in (length, 1):
        learner = make_learner(replace(PLAIN, chunk_length=chunk_length), PLAIN_REWARD)
        close = updated(learner, range(1), terminations=1.0)
        states.append((state_of(learner), close))
    (filled, filled_metrics), (exact, exact_metrics) = states
    close_metrics(filled_metrics, exact_metrics)
    for name in exact:
        if '.parameters.' in name:
            np.testing.assert_allclose(filled[name], exact[name], rtol=1e-4, atol=2e-6, err_msg=name)


@pytest.mark.parametrize('mini_batches', [2, 4, 8])
def test_mini_batches_hold_every_chunk_once(mini_batches, make_learner):
    """With weights at rest, the mean loss of equal mini-batches is the loss of the whole."""
    def losses(parts):
        settings = replace(IDLE, chunk_length=5, num_mini_batches=parts)
        metrics = updated(make_learner(settings, IDLE_REWARD), range(1), steps=10, worlds=4)
        return {name: value for name, value in metrics.items() if not name.endswith('gradient_norm')}

    close_metrics(losses(mini_batches), losses(1))


def test_mini_batches_are_shuffled_by_seed_and_rollout_and_each_makes_a_step_of_its_own(make_learner):
    trajectory = random_trajectory(10, 4)

    def learnt(parts, rollout, seed=1):
        learner = make_learner(replace(LEARNER, chunk_length=5, num_mini_batches=parts), seed=seed)
        start = state_of(make_learner(replace(LEARNER, chunk_length=5)))
        learner.load_state(start)
        learner.update(trajectory, rollout)
        return state_of(learner)

    first = learnt(2, 0)
    assert_same_bits(first, learnt(2, 0))
    for other in (learnt(2, 1), learnt(2, 0, seed=2), learnt(1, 0)):
        for network in ('actor', 'critic', 'reward_network.0'):
            assert not same_weights(first, other, network)
    assert_same_bits(learnt(1, 0), learnt(1, 1))


def test_mini_batches_are_shuffled_anew_in_every_epoch(make_learner):
    """With weights at rest, the same mini-batches again would have the same gradients."""
    def norms(epochs):
        settings = replace(IDLE, chunk_length=5, num_mini_batches=2, epochs=epochs)
        metrics = updated(make_learner(settings, replace(IDLE_REWARD, epochs=epochs)), range(1), steps=10, worlds=4)
        return [value for name, value in metrics.items() if name.endswith('gradient_norm')]

    for once, twice in zip(norms(1), norms(2)):
        assert abs(twice / once - 1) > 1e-4


def test_there_may_be_more_mini_batches_than_chunks(make_learner):
    metrics = updated(make_learner(replace(LEARNER, num_mini_batches=1000)), range(1))
    assert all(math.isfinite(value) for value in metrics.values())


def test_a_rollout_of_one_step_of_one_world_is_learnt_from(make_learner):
    learner = make_learner()
    metrics = updated(learner, range(2), steps=1, worlds=1)
    assert all(math.isfinite(value) for value in metrics.values())
    assert all(np.isfinite(tensor).all() for tensor in learner.state().values())


# Ends of episodes.


@pytest.mark.parametrize('how, last_state_counts, final_state_counts', [
    ('goes on', True, False), ('terminated', False, False), ('truncated', False, True)])
def test_an_episode_is_bootstrapped_from_where_it_was_cut_off_and_from_nothing_where_it_ended(
        how, last_state_counts, final_state_counts, make_learner):
    trajectory = random_trajectory(terminations=0.0, truncations=0.0)
    trajectory.terminated[-1] = how == 'terminated'
    trajectory.truncated[-1] = how == 'truncated'
    trajectory.episode_start[-1] = how != 'goes on'
    finals = np.random.default_rng(1).normal(size=(3 if how == 'truncated' else 0, 7)).astype(np.float32)
    trajectory = trajectory._replace(final_states=finals)
    moved_last = trajectory._replace(states=trajectory.states.copy())
    moved_last.states[-1, :, 0] += 1  # not all by the same, which the LayerNorm takes away
    moved_final = trajectory._replace(final_states=finals + np.eye(1, 7, dtype=np.float32))
    states = []
    for one in (trajectory, moved_last, moved_final):
        learner = make_learner()
        learner.update(one, 0)
        states.append(state_of(learner))
    original, with_last, with_final = states
    for network in ('actor', 'critic'):
        assert same_weights(original, with_last, network) != last_state_counts
        assert same_weights(original, with_final, network) != final_state_counts
    assert same_weights(original, with_last, 'reward_network.0')


def test_each_final_state_goes_to_the_world_whose_episode_was_cut_off(make_learner):
    trajectory = random_trajectory(terminations=0.0, truncations=0.4, seed=2)
    assert len(trajectory.final_states) > 2
    swapped = trajectory._replace(final_states=trajectory.final_states[::-1].copy())
    states = []
    for one in (trajectory, swapped):
        learner = make_learner()
        learner.update(one, 0)
        states.append(state_of(learner))
    assert not same_weights(*states, 'critic')


def test_the_two_value_targets_differ_where_there_is_credit_and_only_there(make_learner):
    def learnt(value_target, beta):
        learner = make_learner(replace(LEARNER, value_target=value_target, beta=beta))
        updated(learner, range(1))
        return state_of(learner)

    assert not same_weights(learnt('difference', 0.9), learnt('gae', 0.9), 'critic')
    assert same_weights(learnt('difference', 0.9), learnt('gae', 0.9), 'actor')
    one, other = learnt('difference', 0.0), learnt('gae', 0.0)
    for name, tensor in parameters(one, 'critic').items():
        np.testing.assert_allclose(tensor, parameters(other, 'critic')[name], atol=1e-5)


# Learning.


def played(learner, rewards_of, steps=8, worlds=32, spec=SPEC, rollout=0):
    """A rollout whose actions the learner's own policy chose; the reward is a function of the joint action [W, N]."""
    trajectory, policy = random_trajectory(steps, worlds, spec, seed=rollout), learner.policy
    for robot in range(spec.num_agents):
        memory = policy.initial_state(worlds)
        for t in range(steps):
            observed, start = trajectory.observations[t, :, robot], trajectory.episode_start[t]
            probabilities, memory = policy.act(observed, memory, start)
            trajectory.probabilities[t, :, robot] = probabilities
            trajectory.actions[t, :, robot] = choose(probabilities, False, 1, rollout, t, robot)
    for t in range(steps):
        trajectory.rewards[t] = rewards_of(trajectory.actions[t])
    return trajectory


def how_many_chose_1(actions):
    return (actions == 1).sum(-1)


@pytest.mark.parametrize('mini_batches', [1, 2])
def test_the_ratio_is_1_in_the_first_epoch_also_in_the_middle_of_episodes(mini_batches, make_learner):
    learner = make_learner(replace(IDLE, clip=1e-4, chunk_length=4, num_mini_batches=mini_batches))
    state, random = state_of(learner), np.random.default_rng(1)
    for name in state:
        if name.startswith('actor.parameters.'):  # a policy far from uniform, which remembers
            state[name] += random.normal(0, 0.5, state[name].shape).astype(np.float32)
    learner.load_state(state)
    metrics = learner.update(played(learner, how_many_chose_1), 0)
    assert metrics['policy/clipped_fraction'] == 0
    assert abs(metrics['policy/kl']) < 1e-6 and abs(metrics['policy/loss']) < 1e-5
    assert metrics['policy/entropy'] < 0.98 * math.log(SPEC.num_actions)


@pytest.mark.parametrize('beta, reward_settings', [(0.0, REWARD), (0.95, REWARD), (1.0, REWARD), (0.95, SHARED_TRUNK)])
def test_one_update_makes_a_rewarded_action_more_probable_and_more_updates_certain(beta, reward_settings, make_learner):
    settings = LearnerSettings(hidden_size=8, beta=beta, learning_rate=5e-3, learner_threads=1)
    learner = make_learner(settings, reward_settings)

    def probability_of_1():
        return float(played(learner, how_many_chose_1, rollout=99).probabilities[..., 1].mean())

    before = probability_of_1()
    learner.update(played(learner, how_many_chose_1), 0)
    assert probability_of_1() > before + 0.02
    for rollout in range(1, 8):
        learner.update(played(learner, how_many_chose_1, rollout=rollout), rollout)
    assert probability_of_1() > 0.8


@pytest.mark.parametrize('ensemble', [1, 2])
@pytest.mark.parametrize('architecture', REWARD_NETWORKS)
def test_the_reward_network_learns_a_reward_that_hangs_on_all_actions(architecture, ensemble, make_learner):
    settings = RewardNetworkSettings(architecture, hidden_size=16, ensemble_size=ensemble, epochs=15, learning_rate=5e-3)
    learner = make_learner(replace(LEARNER, learning_rate=0.0), settings)
    explained = [learner.update(played(learner, how_many_chose_1, rollout=rollout), rollout)
                 ['reward_network/explained_variance'] for rollout in range(8)]
    assert explained[0] < 0.2 and explained[-1] > 0.9


@pytest.mark.parametrize('reward_settings', [REWARD, SHARED_TRUNK, REPLAY, replace(REWARD, ensemble_size=2)])
def test_credit_is_told_before_the_rollout_is_learnt_from_or_if_asked_after(reward_settings, make_learner):
    trajectory, learnt = random_trajectory(8, 32), []
    for first in (False, True):
        learner = make_learner(reward_settings=replace(reward_settings, learns_first=first))
        learner.watched_world = 3
        before = learner.expected_rewards(trajectory)
        metrics = learner.update(trajectory, 0)
        after = learner.expected_rewards(trajectory)
        told = trajectory.rewards[:, 3, None] - learner.credit.differences
        assert not np.allclose(before, after, atol=1e-3)
        np.testing.assert_allclose(told, (after if first else before)[:, 3], atol=1e-5)
        learnt.append((parameters(state_of(learner), 'reward_network.0'), metrics['reward_network/explained_variance'],
                       metrics['reward_network/loss']))
    (one, *told_of_one), (other, *told_of_other) = learnt
    assert told_of_one == told_of_other
    assert all(np.array_equal(one[name], other[name]) for name in one)  # what it learns is the same


def test_the_members_of_an_ensemble_are_networks_of_their_own(make_learner):
    learner = make_learner(reward_settings=replace(REWARD, ensemble_size=2))
    for _ in range(2):
        state = state_of(learner)
        one, other = (parameters(state, f'reward_network.{member}') for member in range(2))
        assert one.keys() == other.keys() and 'reward_network.2.parameters.head.bias' not in state
        assert all(not np.array_equal(one[name], other[name]) for name in one if one[name].ndim == 2)
        updated(learner, range(1))


def test_the_critic_learns_the_rewards_to_come_from_the_state(make_learner):
    settings = LearnerSettings(hidden_size=16, beta=0.0, learning_rate=5e-3, gamma=0.0, learner_threads=1)
    learner, losses = make_learner(settings), []
    for rollout in range(10):
        trajectory = random_trajectory(8, 32, seed=rollout)
        trajectory = trajectory._replace(rewards=30 * trajectory.states[:-1, :, 0] - 170)
        losses.append(learner.update(trajectory, rollout)['value/loss'])
    assert losses[-1] < 0.2 * losses[0]
    mean, mean_square, weight = learner.state()['value_norm']
    assert mean / weight == pytest.approx(-170, abs=5)
    assert math.sqrt(mean_square / weight - (mean / weight)**2) == pytest.approx(30, rel=0.2)


def test_an_update_tells_how_it_went_in_numbers(make_learner):
    metrics = updated(make_learner(), range(1))
    assert metrics.keys() >= {'policy/loss', 'policy/entropy', 'policy/clipped_fraction', 'policy/kl', 'value/loss',
                              'reward_network/loss', 'reward_network/explained_variance'}
    assert all(type(value) is float and math.isfinite(value) for value in metrics.values())
    assert 0 <= metrics['policy/clipped_fraction'] <= 1 and 0 < metrics['policy/entropy'] <= math.log(SPEC.num_actions)
