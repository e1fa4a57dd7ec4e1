"""The native kernels compute what torch computes in double precision, to rounding, whatever the network and its sizes."""

import functools

import pytest
import torch

from dae_ros.learning import kernels, losses, networks
from dae_ros.learning.native import library
from tests.kernel_cases import (
    ROWS_OF_STEPS,
    Linear,
    Row,
    assert_exact_to_rounding,
    batch_for,
    changed,
    clear_of_jumps,
    double,
    exact_outputs,
    layer,
    native,
    odd_shapes,
    policy_loss,
    randoms,
    recurrent_network,
    results,
    reward_loss,
    reward_network,
    row_of_steps,
    uniform,
    value_loss,
    with_random_parameters,
)

LOSSES = {'policy': policy_loss, 'no bonus': functools.partial(policy_loss, bonus=0.0),
          'some actions': functools.partial(policy_loss, masked=True), 'reward': reward_loss}
# L steps of C columns of N agents; I inputs, K outputs; K is also I where nothing changes the width.
SIZES = [(1, 1, 1, 1, 1), (3, 2, 1, 5, 7), (10, 49, 1, 16, 16), (1, 301, 1, 33, 17), (2, 101, 3, 18, 64), (40, 1, 2, 8, 9),
         (2, 5, 60, 3, 33), (1, 3, 1, 300, 130), (2, 4, 2, 20, 300), (5, 50, 5, 7, 24), (2, 2, 49, 31, 32)]
ARCHITECTURES = pytest.mark.parametrize('architecture', networks.REWARD_NETWORKS)
# N agents, A actions, C columns: with more to do for the others than the batch has rows, and with less.
TEAMS = pytest.mark.parametrize(('N', 'A', 'C'), [(3, 5, 50), (1, 4, 6), (2, 3, 9), (6, 5, 4), (50, 2, 3), (3, 1, 5)])


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


@native
@pytest.mark.parametrize('lanes', [8, 16])
def test_vectors_of_either_width_compute_the_same(lanes, compiled, monkeypatch):
    monkeypatch.setattr(kernels, 'library', library.opened(compiled(f'-DLANES={lanes}', '-O1')))
    for case in odd_shapes():
        assert_exact_to_rounding(*case)
