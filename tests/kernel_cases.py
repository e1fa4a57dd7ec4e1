"""Networks, batches and losses for the tests of the kernels, and what the kernels must compute with them."""

import copy
import functools
import math
from typing import NamedTuple
from unittest import mock

import pytest
import torch

from dae_ros.config import RewardNetworkSettings
from dae_ros.learning import kernels, losses, networks
from dae_ros.types import WorldSpec

native = pytest.mark.skipif(not kernels.available(), reason='the kernels cannot be compiled here, or are off')


def randoms(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def one_of(values, *shape, seed=0):
    return torch.tensor(values)[torch.randint(len(values), shape, generator=torch.Generator().manual_seed(seed))]


class Batch(NamedTuple):
    """What a network is called with."""

    inputs: torch.Tensor
    initial: torch.Tensor
    episode_start: torch.Tensor
    actions: torch.Tensor | None = None


def batch_for(network, L, C, rows, inputs, rows_at_gru, actions=None, seed=0):
    return Batch(randoms(L, C, rows, inputs, seed=seed), randoms(C, rows_at_gru, network.hidden_size, seed=seed),
                 uniform(L, C, seed=seed) < 0.2, actions)


def with_random_parameters(network, seed=0):
    """The network, with no parameter at a value that would hide a mistake, as 0 and 1 do."""
    with torch.no_grad():
        for index, parameter in enumerate(network.parameters()):
            parameter.copy_(randoms(*parameter.shape, seed=index + seed) / parameter.shape[-1] ** (0.5 * (parameter.dim() - 1)))
    return network


def double(value):
    """The same in double precision: networks, tensors, and tuples with tensors in them."""
    if isinstance(value, torch.nn.Module):
        return copy.deepcopy(value).double()
    if isinstance(value, torch.Tensor):
        return value.double() if value.is_floating_point() else value
    return type(value)(*map(double, value)) if isinstance(value, tuple) else value


def exact_outputs(network, batch):
    """In double precision, and how close what goes into a relu comes to where the slope jumps."""
    distances = [math.inf]

    def relu(x):
        distances.extend(x.abs().flatten().tolist())
        return torch.relu(x)

    with torch.no_grad(), mock.patch.dict(networks._ACTIVATIONS, relu=relu):
        return double(network)(*double(batch))[0], min(distances)


def clear_of_jumps(make):
    """(network, batch, its exact outputs) of the first seed for which rounding moves nothing across relu's edge."""
    for seed in range(0, 10_000, 100):
        network, batch = make(seed)
        outputs, distance = exact_outputs(network, batch)
        if distance > 3e-6:
            return network, batch, outputs
    raise AssertionError('no seed will do')


def some_weights(*shape):
    """Some of them zero, as for filling and for agents that have left."""
    weights = (0.1 + uniform(*shape)) * one_of([0.0, 1.0, 1.0, 1.0], *shape)
    weights[0] = 1
    return weights


def policy_loss(outputs, bonus=0.3, masked=False):
    """Of ratios within the clip range and far out of it, on both sides."""
    actions = one_of(range(outputs.shape[-1]), *outputs.shape[:3], seed=3)
    available = None
    if masked:
        available = one_of([True, True, False], *outputs.shape, seed=6).scatter(-1, actions.unsqueeze(-1), True)
        outputs = outputs.masked_fill(~available, -1e10)
    chosen = torch.log_softmax(outputs, -1).gather(-1, actions.unsqueeze(-1)).squeeze(-1)
    log_ratios = one_of([-0.8, -0.15, 0.0, 0.12, 0.5], *chosen.shape, seed=4) + 0.03 * uniform(*chosen.shape)
    return losses.PolicyLoss(actions, (chosen - log_ratios).float(), randoms(*chosen.shape, seed=5),
                             some_weights(*chosen.shape), 0.2, bonus, available)


def value_loss(outputs):
    """Of values within the clip range and out of it, with errors within delta and beyond."""
    values = outputs.squeeze(-1)
    old = values + one_of([-0.7, -0.1, 0.0, 0.05, 0.6], *values.shape, seed=4)
    targets = values + one_of([-3.0, -0.4, 0.3, 2.5], *values.shape, seed=5) + 0.03 * uniform(*values.shape)
    return losses.ValueLoss(old.float(), targets.float(), some_weights(*values.shape), 0.2, 1.0, 0.5)


def reward_loss(outputs, make=losses.RewardLoss):
    """`make` of what was predicted, [L, C, N, A]."""
    L, C, N, A = outputs.shape
    return make(one_of(range(A), L, C, N, seed=3), 2 * randoms(L, C, seed=4), some_weights(L, C, N))


def results(network, batch, loss):
    """Outputs, states, each parameter's gradient and the loss's sums, by name."""
    with torch.no_grad():
        outputs, states = network(*batch)
    flat, sums = network.gradient(loss, *batch)
    named = dict(network.named_parameters())
    gradients = flat.split([parameter.numel() for parameter in named.values()])
    return {'outputs': outputs, 'sums': sums} | ({} if states is None else {'states': states}) | dict(zip(named, gradients))


def changed(value, change):
    """The tuple with `change` made to its tensors."""
    return type(value)(*(change(part) if isinstance(part, torch.Tensor) else part for part in value))


def assert_exact_to_rounding(network, batch, loss, tolerance=1e-4):
    """What is native lies within rounding of torch's in double precision."""
    assert kernels.usable(batch.inputs)
    ours, exact = results(network, batch, loss), results(double(network), double(batch), double(loss))
    largest = max(float(exact[name].abs().max()) for name, _ in network.named_parameters())
    for name, right in exact.items():
        assert ours[name].dtype == torch.float32 and right.dtype == torch.float64 and ours[name].shape == right.shape, name
        scale = max(float(right.abs().max()), 0.01 * largest if name in dict(network.named_parameters()) else 1, 1e-3)
        error = float((ours[name] - right).abs().max()) / scale
        assert error <= tolerance, f'{name} is off by {error:.1e} of {scale:.1e}'


class Row(networks.Network):
    """Any row of steps, each given as the function that makes it and its arguments; actions are codes of the table."""

    def __init__(self, *steps, hidden_size=0, table_rows=None):
        super().__init__()
        self.hidden_size, self._steps = hidden_size, steps
        widths = [step.outputs for step in self.steps() if step.kind == 'fan_out']
        self.table = torch.nn.Parameter(torch.empty(table_rows, *widths)) if widths else None
        self.parts = torch.nn.ModuleList(part for step in steps for part in step if isinstance(part, torch.nn.Module))

    def steps(self):
        return [make(*arguments) for make, *arguments in self._steps]

    def _table(self, actions, shared):
        if self.table is None:
            return None
        return networks.Table(self.table, None if len(self.table) == actions.numel() else actions, lambda grad: [grad])


def activation_alone(width, activation):
    return kernels.Step('layer', activation, width, width, (None,) * 4)


Linear, Norm, Gru, layer, gru, fan_out = (torch.nn.Linear, torch.nn.LayerNorm, networks.Gru, networks.layer, networks.gru,
                                          networks.fan_out)
# Steps on inputs of width I, with outputs of width K.
ROWS_OF_STEPS = {
    'linear': lambda I, K: [(layer, Linear(I, K))],
    'linear without a bias': lambda I, K: [(layer, Linear(I, K, bias=False))],
    'linear, relu': lambda I, K: [(layer, Linear(I, K), 'relu')],
    'linear, tanh': lambda I, K: [(layer, Linear(I, K), 'tanh')],
    'linear, norm': lambda I, K: [(layer, Linear(I, K), 'identity', Norm(K))],
    'linear, relu, norm': lambda I, K: [(layer, Linear(I, K), 'relu', Norm(K))],
    'linear without a bias, tanh, norm': lambda I, K: [(layer, Linear(I, K, bias=False), 'tanh', Norm(K))],
    'norm': lambda I, K: [(layer, None, 'identity', Norm(K))],
    'relu, norm': lambda I, K: [(layer, None, 'relu', Norm(K))],
    'tanh, norm': lambda I, K: [(layer, None, 'tanh', Norm(K))],
    'norms and activations after a layer': lambda I, K: [
        (layer, Linear(I, K)), (activation_alone, K, 'tanh'), (layer, None, 'identity', Norm(K)), (activation_alone, K, 'relu'),
        (layer, None, 'tanh', Norm(K)), (activation_alone, K, 'identity')],
    'GRU': lambda I, K: [(gru, Gru(I, K))],
    'layer, GRU, layer': lambda I, K: [(layer, Linear(I, 9), 'tanh'), (gru, Gru(9, 21)), (layer, Linear(21, K))],
    'fan-out': lambda I, K: [(fan_out, Norm(K))],
    'layer, fan-out': lambda I, K: [(layer, Linear(I, K)), (fan_out, Norm(K))],
    'layer, fan-out, GRU': lambda I, K: [(layer, Linear(I, 12), 'tanh'), (fan_out, Norm(12)), (gru, Gru(12, K))],
    'GRU, fan-out, layer': lambda I, K: [(gru, Gru(I, 12)), (fan_out, Norm(12)), (layer, Linear(12, K))],
}


def row_of_steps(kind, L, C, N, I, K, looked_up=False, seed=0):
    steps = ROWS_OF_STEPS[kind](I, K)
    made = [make(*arguments) for make, *arguments in steps]
    I, fan_out_at = made[0].inputs, next((at for at, step in enumerate(made) if step.kind == 'fan_out'), len(made))
    gru_at, hidden = next(((at, step.outputs) for at, step in enumerate(made) if step.kind == 'gru'), (0, 0))
    rows = N if fan_out_at == len(made) else 1
    network = with_random_parameters(Row(*steps, hidden_size=hidden, table_rows=11 if looked_up else L * C * N), seed)
    codes = one_of(range(11), L, C, N, seed=seed) if looked_up else torch.zeros(L, C, N, dtype=torch.int64)
    return network, batch_for(network, L, C, rows, I, N if gru_at > fan_out_at else rows, codes, seed)


def recurrent_network(activation, layers, L, C, rows, outputs, seed=0):
    network = with_random_parameters(networks.RecurrentNetwork(18, outputs, 33, layers, activation), seed)
    return network, batch_for(network, L, C, rows, 18, rows, seed=seed)


def actor(seed=0, L=7, C=33, N=3):
    return recurrent_network('relu', 2, L, C, N, 5, seed)


def reward_network(architecture, N, A, C, L=5, hidden=20, seed=0):
    settings = RewardNetworkSettings(architecture, hidden_size=hidden, trunk_size=hidden - 3)
    network = with_random_parameters(networks.REWARD_NETWORKS[architecture](WorldSpec(N, A, 4, 11, False), settings), seed)
    batch = batch_for(network, L, C, 1, 11, network.states_per_world(), one_of(range(A), L, C, N, seed=seed), seed)
    return network, batch._replace(inputs=network.inputs(batch.inputs, batch.actions, batch.episode_start))


def examples():
    """(network, batch, loss) of all kinds, each of several blocks and of odd sizes."""
    made = [(*actor(), policy_loss), (*recurrent_network('tanh', 1, 11, 101, 1, 1), value_loss)]
    for architecture in networks.REWARD_NETWORKS:
        for team in ((3, 5, 50), (6, 5, 14)):
            network, batch = reward_network(architecture, *team)
            made.append((network, batch, functools.partial(reward_loss, make=network.loss)))
    return [(network, batch, make_loss(exact_outputs(network, batch)[0])) for network, batch, make_loss in made]


def odd_shapes():
    """A few of the cases above: (network, batch, loss), most of them with a last block, vector or panel that is not full."""
    for kind, sizes in [('linear, relu, norm', (1, 50, 1, 5, 7)), ('tanh, norm', (3, 2, 1, 33, 33)), ('GRU', (10, 49, 1, 16, 17)),
                        ('layer, fan-out, GRU', (2, 3, 51, 3, 9)), ('GRU, fan-out, layer', (40, 1, 2, 8, 1))]:
        network, batch, outputs = clear_of_jumps(lambda seed: row_of_steps(kind, *sizes, seed=seed))
        yield network, batch, policy_loss(outputs)
    yield from examples()


LAYOUTS = {
    'columns before steps': lambda x: x.transpose(0, 1).contiguous().transpose(0, 1),
    'part of more columns': lambda x: torch.stack([x, x], 1).flatten(1, 2)[:, :x.shape[1]],
    'every other column': lambda x: x.repeat_interleave(2, dim=1)[:, ::2],
    'steps far apart': lambda x: x.repeat_interleave(3, dim=0)[::3],
    'each number apart': lambda x: x.repeat_interleave(2, dim=-1)[..., ::2],
    'last axis first': lambda x: x.movedim(-1, 0).contiguous().movedim(0, -1),
}
