"""The networks: a GRU that is PyTorch's, a credit that ignores the agent's own action, and how all of them begin."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import joint_reward
from dae_ros.learning.gru import gru_sequence
from dae_ros.learning.networks import REWARD_NETWORKS, make_actor, make_critic, make_reward_network
from dae_ros.types import WorldSpec

SPEC = WorldSpec(num_agents=3, num_actions=4, observation_size=5, state_size=9, state_is_observations=False)
LEARNER = LearnerSettings(hidden_size=16)
REWARD = RewardNetworkSettings(hidden_size=24, trunk_size=20)


def normal(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def starts(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) < 0.3


def reference_gru(inputs, initial, episode_start, weights):
    """torch.nn.GRU, one step at a time, its state zeroed by hand; differentiable in everything."""
    gru = torch.nn.GRU(inputs.shape[-1], initial.shape[-1]).double()
    names = ('weight_ih_l0', 'weight_hh_l0', 'bias_ih_l0', 'bias_hh_l0')
    state, states = initial.unsqueeze(0), []
    for values, start in zip(inputs, episode_start):
        state = state.masked_fill(start[None, :, None], 0)
        _, state = torch.func.functional_call(gru, dict(zip(names, weights)), (values.unsqueeze(0), state))
        states.append(state[0])
    return torch.stack(states)


@pytest.mark.parametrize('dtype, tolerance', [(torch.float32, 2e-5), (torch.float64, 1e-11)], ids=['32 bit', '64 bit'])
@pytest.mark.parametrize('sizes', [(1, 1, 1, 1), (10, 7, 5, 16), (4, 300, 16, 24), (25, 3, 20, 9)], ids=str)
def test_the_gru_is_torch_s_with_the_state_zeroed_at_episode_starts_gradients_included(sizes, dtype, tolerance):
    steps, rows, inputs, hidden = sizes
    shapes = [(steps, rows, inputs), (rows, hidden), (3 * hidden, inputs), (3 * hidden, hidden)] + [(3 * hidden,)] * 2
    exact = [normal(*shape, seed=index, dtype=torch.float64) / math.sqrt(shape[-1])
             for index, shape in enumerate(shapes)]
    taken = [tensor.to(dtype).requires_grad_() for tensor in exact]
    exact = [tensor.requires_grad_() for tensor in exact]
    episode_start = starts(steps, rows)
    expected = reference_gru(exact[0], exact[1], episode_start, exact[2:])
    states = gru_sequence(taken[0], taken[1], episode_start, *taken[2:])
    torch.testing.assert_close(states.double(), expected, rtol=tolerance, atol=tolerance)
    direction = normal(*expected.shape, seed=9, dtype=torch.float64)
    expected_gradients = torch.autograd.grad((expected * direction).sum(), exact)
    gradients = torch.autograd.grad((states * direction.to(dtype)).sum(), taken)
    for gradient, right in zip(gradients, expected_gradients):
        assert gradient.dtype == dtype
        scale = float(right.abs().max()) or 1.0
        torch.testing.assert_close(gradient.double(), right, rtol=10 * tolerance, atol=10 * tolerance * scale)


def test_no_gradient_passes_an_episode_start_backwards():
    inputs, initial = normal(5, 2, 3).requires_grad_(), normal(2, 4, seed=1).requires_grad_()
    weights = [normal(12, 3, seed=2), normal(12, 4, seed=3), normal(12, seed=4), normal(12, seed=5)]
    episode_start = torch.tensor([[False, True]] + [[False, False]] * 2 + [[True, False]] + [[False, False]])
    states = gru_sequence(inputs, initial, episode_start, *weights)
    of_inputs, of_initial = torch.autograd.grad(states[-1].sum(), (inputs, initial))
    assert (of_inputs[:3, 0] == 0).all() and (of_inputs[3:, 0] != 0).any(1).all()
    assert (of_inputs[:, 1] != 0).any(1).all()
    assert (of_initial == 0).all()
    states = gru_sequence(inputs, initial, torch.zeros(5, 2, dtype=torch.bool), *weights)
    assert (torch.autograd.grad(states[-1].sum(), initial)[0] != 0).any(1).all()


def test_a_batch_without_rows_has_states_without_rows():
    weights = [normal(12, 3), normal(12, 4), normal(12), normal(12)]
    states = gru_sequence(torch.zeros(1, 0, 3), torch.zeros(0, 4), torch.zeros(1, 0, dtype=torch.bool), *weights)
    assert states.shape == (1, 0, 4)


def reward_network(architecture, seed=1, member=0):
    """One that has taken its scale, and minds earlier actions as it does once it has learnt."""
    network = make_reward_network(SPEC, replace(REWARD, architecture=architecture), seed, member)
    network.take_scale(normal(20))
    if architecture == 'shared_trunk':
        with torch.no_grad():
            network.trunk.weight[:, SPEC.state_size:] = normal(REWARD.trunk_size, SPEC.num_agents * SPEC.num_actions)
    return network


def some_actions(*shape, seed=2):
    return torch.randint(SPEC.num_actions, (*shape, SPEC.num_agents), generator=torch.Generator().manual_seed(seed))


def begin():
    """Actor, critic and reward networks as they begin, by name."""
    return {'actor': make_actor(SPEC, LEARNER, 1), 'critic': make_critic(SPEC, LEARNER, 1)} | {
        f'{architecture} reward network': reward_network(architecture) for architecture in REWARD_NETWORKS}


NETWORKS = pytest.mark.parametrize('name', begin())
REWARDS = pytest.mark.parametrize('architecture', REWARD_NETWORKS)


def sequences(name):
    """A network as a function of a part of its sequences and what it remembers, and the shape of its memory."""
    network, episode_start = begin()[name], torch.zeros(12, 6, dtype=torch.bool)
    if name == 'actor':
        inputs, actions, rows = normal(12, 6, SPEC.num_agents, SPEC.observation_size), None, SPEC.num_agents
    else:
        inputs, actions, rows = normal(12, 6, 1, SPEC.state_size), None, 1
    if 'reward' in name:
        actions, rows = some_actions(12, 6), network.states_per_world()
        episode_start[5] = True
        inputs = network.inputs(inputs, actions, episode_start)

    def part(first, last, initial, episode_start):
        return network(inputs[first:last], initial, episode_start, None if actions is None else actions[first:last])

    return part, (6, rows, network.hidden_size)


@NETWORKS
def test_a_sequence_cut_in_two_goes_on_from_the_state_of_the_first_part(name):
    network, memory = sequences(name)
    with torch.no_grad():
        initial = normal(*memory, seed=7)
        episode_start = starts(12, 6)
        outputs, states = network(0, 12, initial, episode_start)
        first, middle = network(0, 5, initial, episode_start[:5])
        second, last = network(5, 12, middle[-1], episode_start[5:])
    assert outputs.shape[:2] == (12, 6) and states.shape == (12, *memory)
    torch.testing.assert_close(torch.cat([first, second]), outputs, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(torch.cat([middle, last]), states, rtol=1e-5, atol=1e-6)


@NETWORKS
def test_an_episode_begins_without_memory_of_the_one_before(name):
    network, memory = sequences(name)
    episode_start = torch.zeros(12, 6, dtype=torch.bool)
    episode_start[5] = True
    with torch.no_grad():
        whole, _ = network(0, 12, normal(*memory, seed=7), episode_start)
        alone, _ = network(5, 12, torch.zeros(memory), torch.zeros(7, 6, dtype=torch.bool))
        other, _ = network(0, 12, normal(*memory, seed=7), torch.zeros(12, 6, dtype=torch.bool))
    torch.testing.assert_close(whole[5:], alone, rtol=1e-5, atol=1e-6)
    assert ((other[5] - whole[5]).abs() > 1e-4 * whole[5].abs().max()).any()


def predictions(network, states, actions, episode_start):
    """[T, W, N, A] for states [T, W, S], actions [T, W, N] and episode starts [T, W]."""
    with torch.no_grad():
        initial = torch.zeros(actions.shape[1], network.states_per_world(), network.hidden_size)
        inputs = network.inputs(states.unsqueeze(2), actions, episode_start)
        return network(inputs, initial, episode_start, actions)[0]


def changes_of_the_last_prediction(network, worlds, agent, when, changed, episode_start):
    """How much the last prediction for `agent` changes, per world, with each other action of `changed` at step `when`."""
    states, actions = normal(4, worlds, SPEC.state_size), torch.zeros(4, worlds, SPEC.num_agents, dtype=torch.int64)
    before = predictions(network, states, actions, episode_start)
    assert before.shape == (4, worlds, SPEC.num_agents, SPEC.num_actions)
    for action in range(1, SPEC.num_actions):
        other = actions.clone()
        other[when, :, changed] = action
        yield (predictions(network, states, other, episode_start) - before)[3, :, agent].abs().amax(-1)


PAST, CURRENT = 0, 3


@REWARDS
@pytest.mark.parametrize('when', [PAST, CURRENT], ids=['past', 'current'])
@pytest.mark.parametrize('worlds', [2, 40])
def test_the_reward_predicted_for_an_agent_depends_on_the_others_actions_and_not_on_its_own(architecture, when, worlds):
    """But a trunk shared by all agents has seen their earlier actions, the agent's own among them."""
    network, episode_start = reward_network(architecture), torch.zeros(4, worlds, dtype=torch.bool)
    for agent, changed in itertools.product(range(SPEC.num_agents), repeat=2):
        seen = changed != agent or (architecture == 'shared_trunk' and when == PAST)
        for difference in changes_of_the_last_prediction(network, worlds, agent, when, changed, episode_start):
            assert (difference > 1e-3).all() if seen else (difference < 1e-5).all()


@REWARDS
@pytest.mark.parametrize('start', [1, 3])
@pytest.mark.parametrize('worlds', [2, 40])
def test_the_reward_predicted_does_not_depend_on_actions_of_an_earlier_episode(architecture, start, worlds):
    network, episode_start = reward_network(architecture), torch.zeros(4, worlds, dtype=torch.bool)
    episode_start[start, 1:] = True
    for agent, changed in itertools.product(range(SPEC.num_agents), repeat=2):
        for difference in changes_of_the_last_prediction(network, worlds, agent, start - 1, changed, episode_start):
            assert (difference[1:] == 0).all()
            assert difference[0] > 1e-4 or (architecture == 'per_agent' and changed == agent)


@REWARDS
def test_no_later_action_changes_a_prediction(architecture):
    network, states, episode_start = reward_network(architecture), normal(4, 5, SPEC.state_size), starts(4, 5)
    actions = some_actions(4, 5)
    before = predictions(network, states, actions, episode_start)
    for step in range(1, 4):
        other = actions.clone()
        other[step:] = (other[step:] + 1) % SPEC.num_actions
        assert torch.equal(predictions(network, states, other, episode_start)[:step], before[:step])


@REWARDS
def test_the_reward_predicted_for_a_world_does_not_depend_on_how_many_worlds_there_are(architecture):
    network = reward_network(architecture)
    states, episode_start, actions = normal(4, 60, SPEC.state_size), starts(4, 60), some_actions(4, 60)
    together = predictions(network, states, actions, episode_start)
    for first in range(0, 60, 7):
        some = slice(first, first + 2)
        alone = predictions(network, states[:, some], actions[:, some], episode_start[:, some])
        torch.testing.assert_close(alone, together[:, some], rtol=1e-4, atol=1e-5)


@REWARDS
def test_the_reward_predicted_tells_the_agents_and_their_actions_apart(architecture):
    network = reward_network(architecture)
    actions, episode_start = torch.zeros(1, 1, SPEC.num_agents, dtype=torch.int64), torch.ones(1, 1, dtype=torch.bool)
    predicted = predictions(network, normal(1, 1, SPEC.state_size), actions, episode_start)[0, 0]
    for one in range(SPEC.num_agents):
        for other in range(one):
            assert (predicted[one] - predicted[other]).abs().max() > 1e-3
    assert (predicted.std(1) > 1e-3).all()


@REWARDS
def test_the_reward_predicted_depends_on_the_state(architecture):
    network = reward_network(architecture)
    actions, episode_start = torch.zeros(1, 1, SPEC.num_agents, dtype=torch.int64), torch.ones(1, 1, dtype=torch.bool)
    states = (normal(1, 1, SPEC.state_size, seed=seed) for seed in (1, 2))
    one, other = (predictions(network, state, actions, episode_start) for state in states)
    assert ((one - other).abs().amax(-1) > 1e-3).all()


def gain_of(weight):
    """The g of a matrix whose rows, or columns if there are fewer of them, are orthogonal and of length g."""
    rows = weight.detach().double()
    rows = rows if rows.shape[0] <= rows.shape[1] else rows.t()
    gain = float(rows[0].norm())
    identity = torch.eye(len(rows), dtype=torch.float64)
    torch.testing.assert_close(rows @ rows.t() / gain**2, identity, rtol=1e-5, atol=1e-5)
    return gain


@pytest.mark.parametrize('activation, gain', [('relu', math.sqrt(2)), ('tanh', 5 / 3)])
@pytest.mark.parametrize('make, head_gain', [(make_actor, 0.01), (make_critic, 1.0)], ids=['actor', 'critic'])
def test_actor_and_critic_begin_orthogonal_with_the_paper_s_gains(make, head_gain, activation, gain):
    gains = {'mlp': gain, 'gru': 1.0, 'head': head_gain}
    for name, parameter in make(SPEC, LearnerSettings(activation=activation), 1).named_parameters():
        if parameter.dim() == 2:
            assert gain_of(parameter) == pytest.approx(gains[name.split('.')[0]], rel=1e-4), name


@REWARDS
def test_the_reward_network_begins_orthogonal_and_a_shared_trunk_without_heed_of_earlier_actions(architecture):
    network = make_reward_network(SPEC, replace(REWARD, architecture=architecture), 1, 0)
    for name, parameter in network.named_parameters():
        if parameter.dim() == 2 and name != 'trunk.weight':
            expected = network.head_gain if name.startswith('head') else 1.0 if name.startswith('gru') else math.sqrt(2)
            assert gain_of(parameter) == pytest.approx(expected, rel=1e-4), name
    if architecture == 'shared_trunk':
        of_state, of_actions = network.trunk.weight.split([SPEC.state_size, SPEC.num_agents * SPEC.num_actions], 1)
        assert of_state.all() and not of_actions.any()


def test_a_shared_trunk_learns_in_units_of_the_first_rewards_and_predicts_0_before():
    network = make_reward_network(SPEC, replace(REWARD, architecture='shared_trunk'), 1, 0)
    arguments = network, normal(4, 2, SPEC.state_size), some_actions(4, 2), starts(4, 2)
    assert not predictions(*arguments).any()
    network.take_scale(torch.full((3,), 7.0))
    first = predictions(*arguments)
    assert first.std() > 0.01
    network.take_scale(torch.tensor([1.0, 5.0]))  # not the first any more
    assert torch.equal(predictions(*arguments), first)
    other = make_reward_network(SPEC, replace(REWARD, architecture='shared_trunk'), 1, 0)
    other.take_scale(torch.tensor([1.0, 5.0]))
    torch.testing.assert_close(predictions(other, *arguments[1:]), 3.0 + 2.0 * (first - 7.0))


@pytest.mark.parametrize('agents', [1, 2, 4])
def test_what_all_own_actions_are_worth_is_what_their_joint_actions_are(agents):
    outputs = normal(5, 3, joint_reward.size(agents, 3))
    actions = torch.randint(3, (5, 3, agents), generator=torch.Generator().manual_seed(1))
    found = joint_reward.of_own_actions(outputs, actions)
    for agent, action in itertools.product(range(agents), range(3)):
        joint = actions.clone()
        joint[..., agent] = action
        torch.testing.assert_close(found[..., agent, action], joint_reward.of_joint_action(outputs, joint))
    every = outputs.view(5, 3, agents, 3, -1).gather(3, actions[..., None, None].expand(-1, -1, -1, 1, 1 + joint_reward.RANK))
    alone, vectors = every[..., 0, 0], every[..., 0, 1:]
    pairs = sum((vectors[..., i, :] * vectors[..., j, :]).sum(-1) for i in range(agents) for j in range(i))
    torch.testing.assert_close(joint_reward.of_joint_action(outputs, actions), alone.sum(-1) + pairs / agents ** 2)


@NETWORKS
def test_biases_begin_at_0_and_layer_norms_as_the_identity(name):
    for path, parameter in begin()[name].named_parameters():
        if parameter.dim() == 1 and path != 'scale':
            scale = 'norm' in path and path.endswith('weight')
            assert (parameter == (1.0 if scale else 0.0)).all(), path


@pytest.mark.parametrize(('steps', 'looked_up'), [(12, True), (1, False)])
def test_the_way_back_of_a_table_by_hand_is_that_of_autograd_to_the_network_s_first_parameters(steps, looked_up):
    network = reward_network('per_agent').double()
    with torch.no_grad():
        network.action_bias.copy_(normal(*network.action_bias.shape))
    table = network._table(some_actions(steps, 6), None)
    assert (table.codes is not None) == looked_up
    grad = normal(*table.rows.shape, dtype=torch.float64)
    by_hand = table.gradient(grad)
    assert len(by_hand) == 4
    expected = torch.autograd.grad(table.rows, list(network.parameters())[:4], grad)
    torch.testing.assert_close(list(by_hand), list(expected))


def test_the_actor_begins_close_to_uniform():
    with torch.no_grad():
        logits, _ = make_actor(SPEC, LEARNER, 1)(normal(8, 50, 3, 5), torch.zeros(50, 3, 16), starts(8, 50))
    assert (torch.softmax(logits, -1) - 1 / SPEC.num_actions).abs().max() < 0.02


def flat(network):
    return torch.cat([parameter.detach().reshape(-1) for parameter in network.parameters()])


def test_a_network_begins_as_its_seed_and_its_name_say_and_nothing_else():
    def make(seed):
        return [make_actor(SPEC, LEARNER, seed), make_critic(SPEC, LEARNER, seed),
                *(reward_network(architecture, seed, member) for architecture in REWARD_NETWORKS for member in range(2))]

    first = [flat(network) for network in make(1)]
    torch.manual_seed(7)
    torch.rand(3)
    for one, again, other in zip(first, make(1), make(2)):
        assert torch.equal(one, flat(again))
        assert not torch.equal(one, flat(other))
    assert not torch.equal(first[2], first[3]) and not torch.equal(first[4], first[5])
    same_sizes = WorldSpec(3, 1, 9, 9, False)
    actor, critic = make_actor(same_sizes, LEARNER, 1), make_critic(same_sizes, LEARNER, 1)
    assert not torch.equal(actor.mlp[0].weight, critic.mlp[0].weight)
