"""The policy robots act with: the same network as the learner's actor, and draws keyed by what they are for."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros import draws
from dae_ros.config import LearnerSettings
from dae_ros.learning.networks import make_actor
from dae_ros.learning.policy import Policy, PolicyArchitecture, choose
from dae_ros.types import WorldSpec

SIZES = PolicyArchitecture(observation_size=7, num_actions=5, hidden_size=16, mlp_layers=2, activation='relu')
ARCHITECTURES = [SIZES, SIZES._replace(activation='tanh'), SIZES._replace(mlp_layers=3, num_actions=2),
                 SIZES._replace(mlp_layers=1, hidden_size=5, observation_size=3)]


def actor_of(architecture, seed=1):
    """The learner's network, moved off its initial values so that every bias and scale counts."""
    spec = WorldSpec(3, architecture.num_actions, architecture.observation_size, 1, False)
    actor = make_actor(spec, LearnerSettings(hidden_size=architecture.hidden_size, mlp_layers=architecture.mlp_layers,
                                             activation=architecture.activation), seed)
    noise = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=noise)
    return actor


def policy_of(actor, architecture):
    return Policy(architecture, {name: parameter.detach().numpy() for name, parameter in actor.named_parameters()})


def observations(steps, worlds, architecture, seed=1):
    """Values [T, W, O] float32 and episode starts [T, W], some of them in the middle and not all at the first step."""
    random = np.random.default_rng(seed)
    values = random.normal(0, 2, (steps, worlds, architecture.observation_size)).astype(np.float32)
    return values, random.random((steps, worlds)) < 0.3


def act_through(policy, values, episode_start, state):
    probabilities, states = [], []
    for at_step in zip(values, episode_start):
        given_out, state = policy.act(at_step[0], state, at_step[1])
        probabilities.append(given_out)
        states.append(state)
    return np.stack(probabilities), np.stack(states)


@pytest.mark.parametrize('architecture', ARCHITECTURES, ids=str)
def test_robots_act_with_the_network_the_learner_trains(architecture):
    actor = actor_of(architecture)
    values, episode_start = observations(12, 9, architecture)
    initial = np.random.default_rng(2).uniform(-1, 1, (9, architecture.hidden_size)).astype(np.float32)
    probabilities, states = act_through(policy_of(actor, architecture), values, episode_start, initial)
    with torch.no_grad():
        logits, hidden = actor(*map(torch.from_numpy, (values[:, :, None], initial[:, None], episode_start)))
    np.testing.assert_allclose(probabilities, torch.softmax(logits, -1).squeeze(2).numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(states, hidden.squeeze(2).numpy(), rtol=1e-4, atol=2e-6)
    assert probabilities.dtype == states.dtype == np.float32
    assert probabilities.std(axis=(0, 1)).min() > 0.01  # the comparison above is of something


def test_the_tensors_of_a_policy_are_those_of_the_actor_in_the_order_of_the_forward_pass():
    shapes = {name: tuple(parameter.shape) for name, parameter in actor_of(SIZES).named_parameters()}
    assert SIZES.shapes() == shapes
    assert list(SIZES.shapes())[0] == 'input_norm.weight' and list(SIZES.shapes())[-1] == 'head.bias'


@pytest.mark.parametrize('architecture', ARCHITECTURES, ids=str)
def test_probabilities_are_positive_and_sum_to_1(architecture):
    values, episode_start = observations(4, 200, architecture)
    policy = policy_of(actor_of(architecture), architecture)
    probabilities, _ = act_through(policy, 1000 * values, episode_start, policy.initial_state(200))
    assert (probabilities > 0).all()
    np.testing.assert_allclose(probabilities.sum(-1, dtype=np.float64), 1, atol=1e-6)


def test_the_state_is_forgotten_where_an_episode_starts_and_only_there():
    policy = policy_of(actor_of(SIZES), SIZES)
    values = observations(1, 4, SIZES)[0][0]
    history = np.random.default_rng(3).uniform(-1, 1, (4, SIZES.hidden_size)).astype(np.float32)
    fresh, fresh_state = policy.act(values, policy.initial_state(4), np.zeros(4, bool))
    mixed, mixed_state = policy.act(values, history, np.array([True, False, True, False]))
    np.testing.assert_array_equal(mixed[::2], fresh[::2])
    np.testing.assert_array_equal(mixed_state[::2], fresh_state[::2])
    assert (np.abs(mixed[1::2] - fresh[1::2]).max(axis=1) > 1e-3).all()


def test_acting_leaves_the_observation_and_the_state_as_they_were():
    policy = policy_of(actor_of(SIZES), SIZES)
    values, episode_start = (part[0] for part in observations(1, 6, SIZES))
    state = np.ones((6, SIZES.hidden_size), np.float32)
    arguments = (values, state, episode_start)
    copies = [argument.copy() for argument in arguments]
    first = policy.act(*arguments)
    again = policy.act(*arguments)
    for argument, copy in zip(arguments, copies):
        np.testing.assert_array_equal(argument, copy)
    for one, other in zip(first, again):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(worlds=strategies.integers(1, 40), seed=strategies.integers(0, 1000))
def test_a_world_gets_the_same_probabilities_in_whatever_batch_it_is(worlds, seed):
    policy = policy_of(actor_of(SIZES), SIZES)
    values, episode_start = observations(1, worlds, SIZES, seed)
    state = np.random.default_rng(seed).uniform(-1, 1, (worlds, SIZES.hidden_size)).astype(np.float32)
    together = policy.act(values[0], state, episode_start[0])
    for world in range(worlds):
        alone = policy.act(values[0, world:world + 1], state[world:world + 1], episode_start[0, world:world + 1])
        for one, all_of_them in zip(alone, together):
            np.testing.assert_allclose(one[0], all_of_them[world], rtol=1e-5, atol=1e-6)


def spoiled(change):
    tensors = {name: np.zeros(shape, np.float32) for name, shape in SIZES.shapes().items()}
    change(tensors)
    return tensors


@pytest.mark.parametrize('change', [
    lambda tensors: tensors.pop('gru.bias_hh'),
    lambda tensors: tensors.update(more=np.zeros(1, np.float32)),
    lambda tensors: tensors.update({'head.bias': np.zeros(4, np.float32)}),
    lambda tensors: tensors.update({'head.weight': np.zeros((16, 5), np.float32)}),
], ids=['one missing', 'one too many', 'too short', 'transposed'])
def test_tensors_of_another_architecture_are_refused(change):
    with pytest.raises(ValueError, match='^these tensors are not a policy of PolicyArchitecture'):
        Policy(SIZES, spoiled(change))


def random_probabilities(worlds, actions, seed=1):
    return np.random.default_rng(seed).dirichlet(np.ones(actions), worlds).astype(np.float32)


def test_a_greedy_choice_is_the_most_probable_action_whatever_the_key():
    probabilities = random_probabilities(500, 5)
    chosen = choose(probabilities, True, seed=1, rollout=2, step=3, robot=0)
    np.testing.assert_array_equal(chosen, probabilities.argmax(axis=1))
    np.testing.assert_array_equal(chosen, choose(probabilities, True, seed=9, rollout=8, step=7, robot=6))
    assert chosen.dtype == np.uint16


def test_a_drawn_choice_depends_on_seed_rollout_step_and_robot_and_on_nothing_else():
    probabilities = random_probabilities(500, 5)
    key = {'seed': 1, 'rollout': 2, 'step': 3, 'robot': 0}
    chosen = choose(probabilities, False, **key)
    np.random.random(3)
    np.testing.assert_array_equal(chosen, choose(probabilities.copy(), False, **key))
    assert chosen.dtype == np.uint16
    for name in key:
        other = choose(probabilities, False, **{**key, name: key[name] + 1})
        assert 0.1 < (other == chosen).mean() < 0.7, name


def test_a_world_s_draw_does_not_depend_on_how_many_worlds_there_are():
    probabilities = random_probabilities(100, 5)
    chosen = choose(probabilities, False, 1, 2, 3, 0)
    np.testing.assert_array_equal(choose(probabilities[:30], False, 1, 2, 3, 0), chosen[:30])


@pytest.mark.parametrize('probabilities', [[0.5, 0.5], [0.05, 0.0, 0.7, 0.25], [0.001, 0.999], [0.2] * 5])
def test_actions_are_drawn_as_often_as_they_are_probable(probabilities):
    worlds = 40_000
    chosen = choose(np.tile(np.array(probabilities, np.float32), (worlds, 1)), False, 1, 0, 0, 0)
    counts = np.bincount(chosen, minlength=len(probabilities))
    for count, probability in zip(counts, probabilities):
        assert abs(count - worlds * probability) <= 4 * math.sqrt(worlds * probability * (1 - probability))


ROWS = strategies.lists(strategies.sampled_from([0.0, 0.0, 1e-45, 1e-20, 1e-7, 0.1, 0.3, 1.0]), min_size=1, max_size=7)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(rows=ROWS.filter(any), step=strategies.integers(0, 10**6))
def test_an_action_of_probability_0_is_never_drawn(rows, step):
    weights = np.array(rows, np.float32)
    probabilities = np.tile(weights / weights.sum(dtype=np.float32), (50, 1))
    for greedy in (False, True):
        chosen = choose(probabilities, greedy, 1, 0, step, 0)
        assert (probabilities[np.arange(50), chosen] > 0).all()


@pytest.mark.parametrize('probabilities', [[0, 0.4, 0, 0.6, 0, 0], [0, 0, 1], [1, 0], [0, 0.3333333, 0.3333333, 0]])
def test_the_smallest_and_the_largest_draw_there_are_hit_possible_actions(probabilities, monkeypatch):
    class Extremes:
        def random(self, size):
            return np.array([0.0, 1 - 2**-53])[:size]

    monkeypatch.setattr(draws, 'generator', lambda *name: Extremes())
    chosen = choose(np.array([probabilities] * 2, np.float32), False, 1, 0, 0, 0)
    possible = np.flatnonzero(probabilities)
    assert chosen.tolist() == [possible[0], possible[-1]]
