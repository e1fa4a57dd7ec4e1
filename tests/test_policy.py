"""The policy robots act with: the same network as the learner's actor, and draws keyed by what they are for."""

import math
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros import draws
from dae_ros.config import LearnerSettings
from dae_ros.learning.native import library
from dae_ros.learning.networks import make_actor
from dae_ros.learning.policy import Policy, PolicyArchitecture, choose
from dae_ros.types import WorldSpec

native = pytest.mark.skipif(library.chosen() is None, reason='the library cannot be compiled here, or is off')

SIZES = PolicyArchitecture(observation_size=7, num_actions=5, hidden_size=16, mlp_layers=2, activation='relu')
ARCHITECTURES = [SIZES, SIZES._replace(activation='tanh'), SIZES._replace(mlp_layers=3, num_actions=2),
                 SIZES._replace(mlp_layers=1, hidden_size=5, observation_size=3)]
# None a multiple of the vectors' width or within one panel of the products, and the smallest there is.
ODD_SIZES = [PolicyArchitecture(*sizes, layers, activation) for sizes in ((18, 5, 33), (35, 17, 70), (1, 1, 1))
             for layers in (1, 2, 3) for activation in ('relu', 'tanh')]


@pytest.fixture(params=[pytest.param('native', marks=native), 'numpy'])
def either_way(request, monkeypatch):
    """The test runs with the compiled policy and with that in numpy."""
    if request.param == 'numpy':
        monkeypatch.setattr(library, 'chosen', lambda: None)


EITHER_WAY = pytest.mark.usefixtures('either_way')


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


def random_policy(architecture, seed=1):
    """A policy of which every bias and scale counts."""
    random = np.random.default_rng(seed)
    return Policy(architecture, {name: random.normal(0, 0.5, shape).astype(np.float32)
                                 for name, shape in architecture.shapes().items()})


def in_numpy(policy):
    """The same policy without the compiled library."""
    with mock.patch.object(library, 'chosen', lambda: None):
        return Policy(policy.architecture, policy.tensors)


def act_in_both(architecture, worlds):
    """What six steps give compiled, and in numpy."""
    policy = random_policy(architecture)
    values, episode_start = observations(6, worlds, architecture)
    initial = np.random.default_rng(2).uniform(-1, 1, (worlds, architecture.hidden_size)).astype(np.float32)
    return [act_through(one, values, episode_start, initial) for one in (policy, in_numpy(policy))]


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


@EITHER_WAY
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


def assert_equal_to_rounding(architecture):
    # The deviation of a single unit is 0, and a LayerNorm divides rounding by little more than that.
    tolerance = 1e-2 if architecture.hidden_size == 1 else 1e-4
    for compiled, plain in zip(*act_in_both(architecture, 50)):
        assert compiled.dtype == plain.dtype == np.float32
        np.testing.assert_allclose(compiled, plain, rtol=tolerance, atol=tolerance / 10)


@native
@pytest.mark.parametrize('architecture', ODD_SIZES, ids=str)
def test_the_compiled_policy_equals_that_in_numpy_to_rounding(architecture):
    assert_equal_to_rounding(architecture)


@native
@pytest.mark.parametrize('lanes', [8, 16])
def test_vectors_of_either_width_act_the_same(lanes, compiled, monkeypatch):
    opened = library.opened(compiled(f'-DLANES={lanes}', '-O1'))
    monkeypatch.setattr(library, 'chosen', lambda: opened)
    for architecture in ODD_SIZES:
        assert_equal_to_rounding(architecture)


@EITHER_WAY
@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('scale', [1e30, 1e6, 1e-6, 1e-30, 0])
def test_huge_and_tiny_weights_saturate_cleanly(scale):
    policy = random_policy(SIZES)
    extreme = Policy(SIZES, {name: np.float32(scale) * tensor if name.startswith(('gru.', 'head.')) else tensor
                             for name, tensor in policy.tensors.items()})
    values, episode_start = observations(4, 20, SIZES)
    probabilities, states = act_through(extreme, values, episode_start, policy.initial_state(20))
    assert np.isfinite(states).all() and (np.abs(states) <= 1).all()
    np.testing.assert_allclose(probabilities.sum(-1), 1, atol=1e-5)


@EITHER_WAY
def test_a_nan_stays_visible_and_only_in_its_world():
    policy = random_policy(SIZES)
    values = observations(1, 60, SIZES)[0][0]
    values[17, 3] = np.nan
    found = policy.act(values, policy.initial_state(60), np.zeros(60, bool))
    for part in found:
        assert np.isnan(part).any(axis=1).nonzero()[0].tolist() == [17]


@EITHER_WAY
@pytest.mark.parametrize('architecture', ARCHITECTURES, ids=str)
def test_probabilities_are_positive_and_sum_to_1(architecture):
    values, episode_start = observations(4, 200, architecture)
    policy = policy_of(actor_of(architecture), architecture)
    probabilities, _ = act_through(policy, 1000 * values, episode_start, policy.initial_state(200))
    assert (probabilities > 0).all()
    np.testing.assert_allclose(probabilities.sum(-1, dtype=np.float64), 1, atol=1e-6)


@EITHER_WAY
def test_the_state_is_forgotten_where_an_episode_starts_and_only_there():
    policy = policy_of(actor_of(SIZES), SIZES)
    values = observations(1, 4, SIZES)[0][0]
    history = np.random.default_rng(3).uniform(-1, 1, (4, SIZES.hidden_size)).astype(np.float32)
    fresh, fresh_state = policy.act(values, policy.initial_state(4), np.zeros(4, bool))
    mixed, mixed_state = policy.act(values, history, np.array([True, False, True, False]))
    np.testing.assert_array_equal(mixed[::2], fresh[::2])
    np.testing.assert_array_equal(mixed_state[::2], fresh_state[::2])
    assert (np.abs(mixed[1::2] - fresh[1::2]).max(axis=1) > 1e-3).all()


@EITHER_WAY
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


def parts_of_batches(policy, worlds, seed, others):
    """Pairs: what worlds give among `others` of the batch, given as index arrays, and in the whole batch."""
    values, episode_start = observations(1, worlds, policy.architecture, seed)
    state = np.random.default_rng(seed).uniform(-1, 1, (worlds, policy.architecture.hidden_size)).astype(np.float32)
    together = policy.act(values[0], state, episode_start[0])
    for chosen in others:
        for part, whole in zip(policy.act(values[0, chosen], state[chosen], episode_start[0, chosen]), together):
            yield part, whole[chosen]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(worlds=strategies.integers(1, 40), seed=strategies.integers(0, 1000))
def test_in_numpy_a_world_gets_the_same_probabilities_to_rounding_in_whatever_batch_it_is(worlds, seed):
    for part, whole in parts_of_batches(in_numpy(random_policy(SIZES)), worlds, seed, [[world] for world in range(worlds)]):
        np.testing.assert_allclose(part, whole, rtol=1e-5, atol=1e-6)


COMPILED = [random_policy(architecture) for architecture in [SIZES, *ODD_SIZES]]


@native
@settings(max_examples=100, deadline=None, derandomize=True)
@given(policy=strategies.sampled_from(COMPILED), worlds=strategies.integers(1, 130), seed=strategies.integers(0, 1000),
       data=strategies.data())
def test_compiled_a_world_gets_the_same_bits_in_whatever_batch_it_is(policy, worlds, seed, data):
    among = data.draw(strategies.lists(strategies.integers(0, worlds - 1), min_size=1, max_size=130))
    for part, whole in parts_of_batches(policy, worlds, seed, [among, among[:1]]):
        assert part.tobytes() == whole.tobytes()


@native
def test_a_policy_deeper_than_the_kernels_take_is_refused():
    with pytest.raises(ValueError, match='13 layers are more than a policy may have'):
        random_policy(SIZES._replace(mlp_layers=13))
    assert_equal_to_rounding(SIZES._replace(mlp_layers=12))


@native
def test_several_threads_act_with_one_policy_at_once_and_get_the_same_bits():
    policy = random_policy(SIZES._replace(hidden_size=64))
    values, episode_start = observations(3, 100, SIZES)
    expected = act_through(policy, values, episode_start, policy.initial_state(100))
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: act_through(policy, values, episode_start, policy.initial_state(100)), range(40)):
            assert [part.tobytes() for part in found] == [part.tobytes() for part in expected]


@EITHER_WAY
def test_a_policy_stays_as_it_was_made_whatever_becomes_of_the_tensors():
    tensors = {name: tensor.copy() for name, tensor in random_policy(SIZES).tensors.items()}
    policy = Policy(SIZES, tensors)
    arguments = observations(1, 3, SIZES)[0][0], policy.initial_state(3), np.zeros(3, bool)
    before = policy.act(*arguments)
    for tensor in tensors.values():
        tensor[...] = np.nan
    for one, other in zip(policy.act(*arguments), before):
        np.testing.assert_array_equal(one, other)


@EITHER_WAY
def test_observations_in_any_layout_and_no_worlds_at_all_are_taken():
    policy = random_policy(SIZES)
    values, episode_start = (part[0] for part in observations(1, 9, SIZES))
    state = np.ones((9, SIZES.hidden_size), np.float32)
    expected = policy.act(values, state, episode_start)
    wide = np.repeat(values, 2, axis=1)[:, ::2], np.asfortranarray(state), np.repeat(episode_start, 2)[::2]
    for one, other in zip(policy.act(*wide), expected):
        np.testing.assert_array_equal(one, other)
    assert [part.shape for part in policy.act(values[:0], state[:0], episode_start[:0])] == [(0, 5), (0, 16)]


@EITHER_WAY
@pytest.mark.parametrize('spoil', [
    lambda x: x[:-1], lambda x: x[None], lambda x: x.astype(np.float64), lambda x: x.astype(np.int8), lambda x: x[0],
    lambda x: x.reshape(-1, 1)], ids=['too few', 'an axis more', 'float64', 'int8', 'an axis less', 'a column'])
@pytest.mark.parametrize('place', range(3), ids=['observations', 'state', 'episode starts'])
def test_arguments_of_another_shape_or_type_are_refused(place, spoil):
    policy = random_policy(SIZES)
    arguments = [np.zeros((4, 7), np.float32), policy.initial_state(4), np.zeros(4, bool)]
    arguments[place] = spoil(arguments[place])
    with pytest.raises(ValueError, match='observations, state and episode starts are .* where .* needed'):
        policy.act(*arguments)


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
