"""The native kernels compute what torch computes, with the same bits always, and are not needed."""

import copy
import functools
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest
import torch

from dae_ros.config import RewardNetworkSettings
from dae_ros.learning import kernels, losses, networks
from dae_ros.learning.native import build, library
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


LOSSES = {'policy': policy_loss, 'no bonus': functools.partial(policy_loss, bonus=0.0),
          'some actions': functools.partial(policy_loss, masked=True), 'reward': reward_loss}


def results(network, batch, loss):
    """Outputs, states, each parameter's gradient and the loss's sums, by name."""
    with torch.no_grad():
        outputs, states = network(*batch)
    flat, sums = network.gradient(loss, *batch)
    named = dict(network.named_parameters())
    gradients = flat.split([parameter.numel() for parameter in named.values()])
    return {'outputs': outputs, 'sums': sums} | ({} if states is None else {'states': states}) | dict(zip(named, gradients))


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
# L steps of C columns of N agents; I inputs, K outputs; K is also I where nothing changes the width.
SIZES = [(1, 1, 1, 1, 1), (3, 2, 1, 5, 7), (10, 49, 1, 16, 16), (1, 301, 1, 33, 17), (2, 101, 3, 18, 64), (40, 1, 2, 8, 9),
         (2, 5, 60, 3, 33), (1, 3, 1, 300, 130), (2, 4, 2, 20, 300), (5, 50, 5, 7, 24), (2, 2, 49, 31, 32)]


def row_of_steps(kind, L, C, N, I, K, looked_up=False, seed=0):
    steps = ROWS_OF_STEPS[kind](I, K)
    made = [make(*arguments) for make, *arguments in steps]
    I, fan_out_at = made[0].inputs, next((at for at, step in enumerate(made) if step.kind == 'fan_out'), len(made))
    gru_at, hidden = next(((at, step.outputs) for at, step in enumerate(made) if step.kind == 'gru'), (0, 0))
    rows = N if fan_out_at == len(made) else 1
    network = with_random_parameters(Row(*steps, hidden_size=hidden, table_rows=11 if looked_up else L * C * N), seed)
    codes = one_of(range(11), L, C, N, seed=seed) if looked_up else torch.zeros(L, C, N, dtype=torch.int64)
    return network, batch_for(network, L, C, rows, I, N if gru_at > fan_out_at else rows, codes, seed)


@native
@pytest.mark.parametrize('sizes', SIZES, ids=str)
@pytest.mark.parametrize('kind', ROWS_OF_STEPS)
def test_any_row_of_steps_and_its_gradients_equal_torch_in_double_precision(kind, sizes):
    for looked_up in {False, 'fan-out' in kind}:
        network, batch, outputs = clear_of_jumps(lambda seed: row_of_steps(kind, *sizes, looked_up, seed))
        # The deviation of a single unit is 0, and a LayerNorm divides rounding by little more than that.
        tolerance = 3e-2 if sizes[-1] == 1 and any(step.parameters[2] is not None for step in network.steps()) else 1e-4
        for make_loss in LOSSES.values():
            assert_exact_to_rounding(network, batch, make_loss(outputs), tolerance)


@native
@pytest.mark.parametrize('sizes', [(1, 1, 1), (3, 70, 5), (25, 7, 33), (2, 301, 18)], ids=str)
@pytest.mark.parametrize('kind', ['linear', 'linear, tanh', 'GRU', 'layer, GRU, layer'])
def test_the_value_loss_of_a_row_of_steps_equals_torch_in_double_precision(kind, sizes):
    L, C, I = sizes
    for rows in (1, 3):  # the team's value, or each agent's
        network, batch, outputs = clear_of_jumps(lambda seed: row_of_steps(kind, L, C, rows, I, 1, seed=seed))
        assert outputs.shape == (L, C, rows, 1)
        assert_exact_to_rounding(network, batch, value_loss(outputs))


@native
def test_a_value_within_the_clip_range_always_moves_however_the_difference_from_the_old_one_is_rounded():
    network = with_random_parameters(Row((layer, Linear(3, 1, bias=False))))
    batch = batch_for(network, 10, 400, 1, 3, 1)
    batch = batch._replace(inputs=0.05 * batch.inputs)
    values = exact_outputs(network, batch)[0].squeeze(-1)
    old, targets = values + 0.19 * (2 * uniform(10, 400, 1) - 1), values + randoms(10, 400, 1)
    loss = losses.ValueLoss(old.float(), targets.float(), torch.ones(10, 400, 1), 0.2, 1.0, 0.5)
    assert_exact_to_rounding(network, batch, loss)


def recurrent_network(activation, layers, L, C, rows, outputs, seed=0):
    network = with_random_parameters(networks.RecurrentNetwork(18, outputs, 33, layers, activation), seed)
    return network, batch_for(network, L, C, rows, 18, rows, seed=seed)


def actor(seed=0, L=7, C=33, N=3):
    return recurrent_network('relu', 2, L, C, N, 5, seed)


@native
@pytest.mark.parametrize('sizes', [(9, 20, 3), (13, 50, 1), (1, 4, 51)], ids=str)
@pytest.mark.parametrize('layers', [1, 2, 8])
@pytest.mark.parametrize('activation', ['relu', 'tanh'])
def test_actor_and_critic_and_their_gradients_equal_torch_in_double_precision(activation, layers, sizes):
    L, C, N = sizes
    network, batch, outputs = clear_of_jumps(functools.partial(recurrent_network, activation, layers, *sizes, 5))
    assert_exact_to_rounding(network, batch, policy_loss(outputs))
    network, batch, outputs = clear_of_jumps(functools.partial(recurrent_network, activation, layers, L, C * N, 1, 1))
    assert_exact_to_rounding(network, batch, value_loss(outputs))


def reward_network(architecture, N, A, C, L=5, hidden=20, seed=0):
    settings = RewardNetworkSettings(architecture, hidden_size=hidden, trunk_size=hidden - 3)
    network = with_random_parameters(networks.REWARD_NETWORKS[architecture](WorldSpec(N, A, 4, 11, False), settings), seed)
    batch = batch_for(network, L, C, 1, 11, network.states_per_world(), one_of(range(A), L, C, N, seed=seed), seed)
    return network, batch._replace(inputs=network.inputs(batch.inputs, batch.actions, batch.episode_start))


ARCHITECTURES = pytest.mark.parametrize('architecture', networks.REWARD_NETWORKS)
# N agents, A actions, C columns: with more to do for the others than the batch has rows, and with less.
TEAMS = pytest.mark.parametrize(('N', 'A', 'C'), [(3, 5, 50), (1, 4, 6), (2, 3, 9), (6, 5, 4), (50, 2, 3), (3, 1, 5)])


@native
@ARCHITECTURES
@TEAMS
def test_reward_networks_and_their_gradients_equal_torch_in_double_precision(architecture, N, A, C):
    network, batch, outputs = clear_of_jumps(lambda seed: reward_network(architecture, N, A, C, seed=seed))
    assert_exact_to_rounding(network, batch, reward_loss(outputs, network.loss))


@pytest.mark.parametrize(('N', 'A', 'C'), [(3, 5, 50), (1, 4, 6), (2, 3, 9)])
def test_table_of_the_others_actions_gives_what_each_agent_sees(N, A, C, monkeypatch):
    network, batch = map(double, reward_network('per_agent', N, A, C))
    loss = reward_loss(network(*batch)[0].detach())
    assert network._table(batch.actions, None).codes is not None
    with_table = results(network, batch, loss)
    monkeypatch.setattr(networks, '_LOOK_UP_BELOW', 0)
    assert network._table(batch.actions, None).codes is None
    torch.testing.assert_close(results(network, batch, loss), with_table)


def test_parts_that_share_a_table_have_gradients_that_add_up_to_that_of_the_whole():
    network, batch = reward_network('per_agent', 3, 5, 50)
    loss = reward_loss(network(*batch)[0].detach())
    with torch.no_grad():
        table = network.shared_table(batch.actions)
        assert network.shared_table(batch.actions[:, :8]) is None

    def of(columns):
        cut = changed(batch, lambda x: x[:, columns])._replace(initial=batch.initial[columns])
        return network.gradient(changed(loss, lambda x: x[:, columns]), *cut, shared=table)[0]

    found = table.to_parameters(of(slice(0, 8)) + of(slice(8, 8)) + of(slice(8, 50)))
    whole = network.gradient(loss, *batch)[0]
    torch.testing.assert_close(found, whole, rtol=1e-4, atol=1e-5 * float(whole.abs().max()))


def examples():
    """(network, batch, loss) of all kinds, each of several blocks and of odd sizes."""
    made = [(*actor(), policy_loss), (*recurrent_network('tanh', 1, 11, 101, 1, 1), value_loss)]
    for architecture in networks.REWARD_NETWORKS:
        for team in ((3, 5, 50), (6, 5, 14)):
            network, batch = reward_network(architecture, *team)
            made.append((network, batch, functools.partial(reward_loss, make=network.loss)))
    return [(network, batch, make_loss(exact_outputs(network, batch)[0])) for network, batch, make_loss in made]


EXAMPLES = pytest.mark.parametrize('example', range(6), ids=[
    'actor', 'critic', *(f'{name}, {how}' for name in networks.REWARD_NETWORKS for how in ('looked up', 'computed'))])


@pytest.fixture(scope='module')
def all_examples():
    return examples()


def bits(found):
    return {name: x.detach().contiguous().numpy().tobytes() for name, x in found.items()}


def changed(value, change):
    """The tuple with `change` made to its tensors."""
    return type(value)(*(change(part) if isinstance(part, torch.Tensor) else part for part in value))


@native
@EXAMPLES
def test_same_bits_again_and_from_several_threads_at_once(all_examples, example):
    expected = bits(results(*all_examples[example]))
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: bits(results(*all_examples[example])), range(16)):
            assert found == expected


@native
@EXAMPLES
@pytest.mark.parametrize('offset', [1, 3, 16])
def test_same_bits_at_any_address(all_examples, example, offset):
    def moved(x):
        return torch.empty(x.numel() + offset, dtype=x.dtype)[offset:].view(x.shape).copy_(x)

    network, batch, loss = all_examples[example]
    elsewhere = copy.deepcopy(network)
    for parameter in elsewhere.parameters():
        parameter.data = moved(parameter.data)
    assert bits(results(elsewhere, changed(batch, moved), changed(loss, moved))) == bits(results(network, batch, loss))


LAYOUTS = {
    'columns before steps': lambda x: x.transpose(0, 1).contiguous().transpose(0, 1),
    'part of more columns': lambda x: torch.stack([x, x], 1).flatten(1, 2)[:, :x.shape[1]],
    'every other column': lambda x: x.repeat_interleave(2, dim=1)[:, ::2],
    'steps far apart': lambda x: x.repeat_interleave(3, dim=0)[::3],
    'each number apart': lambda x: x.repeat_interleave(2, dim=-1)[..., ::2],
    'last axis first': lambda x: x.movedim(-1, 0).contiguous().movedim(0, -1),
}


@native
@EXAMPLES
@pytest.mark.parametrize('layout', LAYOUTS)
def test_tensors_in_any_layout_are_taken(all_examples, example, layout):
    def laid_out(x):
        return LAYOUTS[layout](x)

    network, batch, loss = all_examples[example]
    assert not laid_out(batch.inputs).is_contiguous() and torch.equal(laid_out(batch.inputs), batch.inputs)
    assert bits(results(network, changed(batch, laid_out), changed(loss, laid_out))) == bits(results(network, batch, loss))


@native
@EXAMPLES
def test_what_a_column_gives_does_not_depend_on_the_columns_beside_it(all_examples, example):
    network, batch, _ = all_examples[example]
    with torch.no_grad():
        outputs, states = network(*batch)
        for some in (slice(3, 29), slice(1, 12)):
            table = None if batch.actions is None else network._table(batch.actions[:, some], None)
            looked_up = table is not None and table.codes is not None
            if table is not None and looked_up != (network._table(batch.actions, None).codes is not None):
                continue  # the table is torch's product, of other sizes
            part = Batch(batch.inputs[:, some], batch.initial[some], batch.episode_start[:, some],
                         None if batch.actions is None else batch.actions[:, some])
            for one, other in zip(network(*part), (outputs[:, some], states[:, some])):
                assert torch.equal(one, other)


@native
def test_the_gradient_is_that_of_the_very_outputs_the_forward_pass_gives():
    network, batch = recurrent_network('relu', 2, 9, 101, 1, 1)
    with torch.no_grad():
        values = network(*batch)[0].squeeze(-1)
    gradient, sums = network.gradient(losses.ValueLoss(values, values, torch.ones(9, 101, 1), 0.2, 1.0, 1.0), *batch)
    assert not gradient.any() and not sums.any()


@EXAMPLES
def test_gradients_of_parts_of_a_batch_add_up_to_that_of_the_whole(all_examples, example):
    network, batch, loss = all_examples[example]

    def of(columns):
        def cut(x):
            return x[:, columns].contiguous()

        part = changed(batch, cut)._replace(initial=batch.initial[columns])
        return network.gradient(changed(loss, cut), *part)

    C = batch.inputs.shape[1]
    whole, parts = of(slice(0, C)), [of(slice(0, 5)), of(slice(5, C))]
    for one, (first, second) in zip(whole, zip(*parts)):
        torch.testing.assert_close(first + second, one, rtol=1e-4, atol=1e-4 * float(one.abs().max()))


@EXAMPLES
def test_a_gradient_leaves_no_trace_on_the_parameters(all_examples, example):
    network, batch, loss = all_examples[example]
    before = [parameter.detach().clone() for parameter in network.parameters()]
    network.gradient(loss, *batch)
    assert all(parameter.grad is None and torch.equal(parameter, old) for parameter, old in zip(network.parameters(), before))


@EXAMPLES
def test_without_columns_there_are_no_outputs_and_gradients_and_sums_are_zero(all_examples, example):
    network, batch, loss = all_examples[example]
    nothing = changed(batch, lambda x: x[:, :0])._replace(initial=batch.initial[:0])
    found, whole = results(network, nothing, changed(loss, lambda x: x[:, :0])), results(network, batch, loss)
    for name, x in whole.items():
        assert found[name].shape == (x[:, :0].shape if name in ('outputs', 'states') else x.shape)
        assert not found[name].any()


@native
@EXAMPLES
def test_what_the_kernels_would_read_beyond_its_end_is_refused(all_examples, example):
    network, batch, loss = all_examples[example]
    wrong = [lambda x: x[:, :-1], lambda x: x[:-1], lambda x: x[..., :-1], lambda x: x.unsqueeze(0), lambda x: x.char()]
    for call in (batch, loss):
        for name, part in call._asdict().items():
            for spoil in wrong if isinstance(part, torch.Tensor) else []:
                if part is batch.actions and spoil(part).shape == part.shape:
                    continue  # codes in the table are int64 whatever the actions are
                spoilt = call._replace(**{name: spoil(part)})
                with pytest.raises((ValueError, RuntimeError, IndexError)):
                    results(network, spoilt if call is batch else batch, spoilt if call is loss else loss)


@native
@EXAMPLES
def test_huge_inputs_saturate_cleanly(all_examples, example):
    network, batch, loss = all_examples[example]
    for scale in (1e6, 1e-6, 1e-30, 0.0):
        found = results(network, batch._replace(inputs=batch.inputs * scale), loss)
        assert all(x.isfinite().all() for x in found.values())
        assert found['states'].abs().max() <= batch.initial.abs().max().clamp_min(1)


def test_logits_that_are_all_but_certain_have_finite_gradients():
    network = Row((layer, Linear(4, 4)))
    with torch.no_grad():
        network.parts[0].weight.copy_(torch.eye(4))
        network.parts[0].bias.zero_()
    inputs = 1e4 * randoms(3, 5, 1, 4)
    loss = losses.PolicyLoss(inputs.argmax(-1), torch.zeros(3, 5, 1), randoms(3, 5, 1), torch.ones(3, 5, 1), 0.2, 0.3)
    gradient, sums = network.gradient(loss, inputs, torch.empty(5, 1, 0), torch.zeros(3, 5, dtype=torch.bool))
    assert gradient.isfinite().all() and sums.isfinite().all()
    assert sums[1] == pytest.approx(0, abs=1e-5)  # no entropy


@EXAMPLES
def test_a_nan_among_the_inputs_stays_visible_from_its_step_on_and_only_in_its_column(all_examples, example):
    network, batch, loss = all_examples[example]
    inputs = batch.inputs.clone()
    inputs[2, 3] = torch.nan
    poisoned = batch._replace(inputs=inputs, episode_start=torch.zeros_like(batch.episode_start))
    found = results(network, poisoned, loss)
    for name in ('outputs', 'states'):
        assert found[name][2:, 3].isnan().flatten(2).any(-1).all()
        assert not found[name][:2].isnan().any() and not found[name][:, :3].isnan().any() and not found[name][:, 4:].isnan().any()
    assert found['sums'].isnan().any()
    assert all(found[name].isnan().any() for name, _ in network.named_parameters() if name != 'scale')  # which no loss moves


@EXAMPLES
def test_a_nan_in_what_the_loss_compares_with_stays_visible_in_the_gradient(all_examples, example):
    network, batch, loss = all_examples[example]
    for name, part in loss._asdict().items():
        if isinstance(part, torch.Tensor) and part.is_floating_point():
            poisoned = part.clone()
            poisoned[2, 3] = torch.nan
            gradient, sums = network.gradient(loss._replace(**{name: poisoned}), *batch)
            assert sums.isnan().any(), name
            stopped = name == 'old_values' and not kernels.available()  # by torch's own clamp
            assert gradient.isnan().any() or stopped, name


def test_other_precisions_go_to_torch(all_examples):
    for example in all_examples:
        assert all(x.dtype == torch.float64 for x in results(*map(double, example)).values())


@native
@EXAMPLES
def test_without_the_kernels_torch_computes_the_same(all_examples, example, monkeypatch):
    found = results(*all_examples[example])
    monkeypatch.setattr(kernels, 'library', None)
    fallback = results(*all_examples[example])
    assert bits(fallback) != bits(found)
    for name, x in found.items():
        torch.testing.assert_close(fallback[name], x, rtol=1e-3, atol=1e-4 * float(x.abs().max()))


def odd_shapes():
    """A few of the cases above: (network, batch, loss), most of them with a last block, vector or panel that is not full."""
    for kind, sizes in [('linear, relu, norm', (1, 50, 1, 5, 7)), ('tanh, norm', (3, 2, 1, 33, 33)), ('GRU', (10, 49, 1, 16, 17)),
                        ('layer, fan-out, GRU', (2, 3, 51, 3, 9)), ('GRU, fan-out, layer', (40, 1, 2, 8, 1))]:
        network, batch, outputs = clear_of_jumps(lambda seed: row_of_steps(kind, *sizes, seed=seed))
        yield network, batch, policy_loss(outputs)
    yield from examples()


@native
@pytest.mark.parametrize('lanes', [8, 16])
def test_vectors_of_either_width_compute_the_same(lanes, compiled, monkeypatch):
    monkeypatch.setattr(kernels, 'library', library.opened(compiled(f'-DLANES={lanes}', '-O1')))
    for case in odd_shapes():
        assert_exact_to_rounding(*case)


SANITIZERS = '-fsanitize=address,undefined', '-fno-sanitize-recover=all', '-O0', '-g'
RUN_ODD_SHAPES = """
import runpy, sys
from dae_ros.learning import kernels
from dae_ros.learning.native import library
kernels.library = library.opened(sys.argv[1])
library.chosen = lambda: kernels.library
tests, tests_of_policy = map(runpy.run_path, sys.argv[2:])
for network, batch, loss in tests['odd_shapes']():
    tests['results'](network, batch, loss)
    for laid_out in tests['LAYOUTS'].values():
        tests['results'](network, tests['changed'](batch, laid_out), tests['changed'](loss, laid_out))
for architecture in tests_of_policy['ODD_SIZES']:
    tests_of_policy['act_in_both'](architecture, 50)
"""


@native
@pytest.mark.slow  # compiles, and Python under the sanitizer
def test_nothing_is_read_or_written_beyond_its_end(compiled):
    try:
        path = compiled(*SANITIZERS)
    except build.BuildError as error:
        pytest.skip(f'the compiler has no sanitizers: {error}')
    # The sanitizer watches memory from the first allocation of a process on, so the process must begin with it.
    linked = subprocess.run(['ldd', path], capture_output=True, text=True, timeout=60).stdout.split()
    sanitizer = [word for word in linked if word.startswith('/') and 'asan' in word]
    if not sanitizer:
        pytest.skip('the sanitizer is no library of its own here')
    environment = os.environ | {'LD_PRELOAD': sanitizer[0], 'ASAN_OPTIONS': 'detect_leaks=0', 'DAE_ROS_KERNELS': 'torch'}
    tests_of_policy = Path(__file__).with_name('test_policy.py')
    result = subprocess.run([sys.executable, '-c', RUN_ODD_SHAPES, path, __file__, tests_of_policy], env=environment,
                            capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
