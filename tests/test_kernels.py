"""The native kernels compute what torch computes, with the same bits always, and are not needed."""

import copy
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from dae_ros.learning import kernels, networks
from dae_ros.types import WorldSpec

native = pytest.mark.skipif(not kernels.available(), reason='the kernels cannot be compiled here, or are off')


def randoms(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def starts(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(7)) < 0.2


def outputs_and_gradients(function, tensors):
    """What `function` gives for the tensors, and the gradients of a fixed linear functional of it."""
    tensors = [x.detach().requires_grad_() if x.is_floating_point() else x for x in tensors]
    outputs = [x for x in function(*tensors) if x is not None]
    loss = sum((x * randoms(*x.shape, seed=index).to(x.dtype)).sum() for index, x in enumerate(outputs))
    return outputs + list(torch.autograd.grad(loss, [x for x in tensors if x.requires_grad]))


def assert_exact_to_rounding(function, tensors, tolerance=2e-5):
    """The native result lies within rounding of torch's in double precision."""
    doubles = [x.double() if x.is_floating_point() else x for x in tensors]
    for index, (ours, exact) in enumerate(zip(outputs_and_gradients(function, tensors),
                                              outputs_and_gradients(function, doubles), strict=True)):
        assert ours.dtype == torch.float32 and exact.dtype == torch.float64
        assert (ours - exact).abs().max() <= tolerance * exact.abs().max().clamp_min(1), f'result {index}'


def gru(inputs, initial, start, *weights):
    return networks.run([kernels.Step('gru', weights)], inputs, initial, start)


def gru_tensors(L, R, I, H):
    weights = [randoms(3 * H, I) / I ** 0.5, randoms(3 * H, H, seed=1) / H ** 0.5, randoms(3 * H),
               randoms(3 * H, seed=2)]
    return [randoms(L, R, I), randoms(R, H), starts(L, R), *weights]


@native
@pytest.mark.parametrize('sizes', [(1, 1, 1, 1), (3, 2, 5, 7), (10, 49, 16, 16), (25, 7, 3, 33), (2, 101, 40, 64),
                                   (5, 250, 18, 20), (40, 1, 8, 9), (2, 3, 300, 130)])
def test_gru_and_all_its_gradients_equal_torch_in_double_precision(sizes):
    assert_exact_to_rounding(gru, gru_tensors(*sizes))


@native
@pytest.mark.parametrize('rows', [1, 5, 48, 301])
@pytest.mark.parametrize('sizes', [(1, 5), (18, 64), (33, 7), (300, 17)])
@pytest.mark.parametrize('activation', ['identity', 'relu', 'tanh'])
@pytest.mark.parametrize('norm', [False, True])
def test_layer_and_all_its_gradients_equal_torch_in_double_precision(rows, sizes, activation, norm):
    I, O = sizes
    # Small integers make the sums before the activation exact, so that no rounding moves one across relu's edge.
    x, weight = (randoms(rows, I) * 2).round(), (randoms(O, I) * 2).round()
    parameters = [weight, torch.full((O,), 0.5), *([randoms(O), randoms(O, seed=1)] if norm else [])]

    def layer(x, weight, bias, scale=None, shift=None):
        return networks.run([kernels.Step(activation, (weight / 64, bias / 64, scale, shift))], x)

    assert_exact_to_rounding(layer, [x, *parameters], 1e-4 if norm else 2e-5)


@native
@pytest.mark.parametrize('activation', ['identity', 'relu', 'tanh'])
@pytest.mark.parametrize('width', [5, 8, 50])
def test_norm_without_a_product_equals_torch(activation, width):
    def layer(x, scale, shift):
        return networks.run([kernels.Step(activation, (None, None, scale, shift))], x)

    assert_exact_to_rounding(layer, [randoms(7, 9, width), randoms(width), randoms(width, seed=1)])


def network_function(network):
    """The network as a function of its inputs and parameters, in the precision of these; and parameters for it."""
    names = [name for name, _ in network.named_parameters()]

    def function(*tensors):
        inputs, parameters = tensors[:-len(names)], tensors[-len(names):]
        return torch.func.functional_call(network, dict(zip(names, parameters)), inputs)

    return function, [randoms(*p.shape, seed=index) / p.shape[-1] ** (0.5 * (p.dim() - 1)) for index, p in
                      enumerate(network.parameters())]


@native
@pytest.mark.parametrize('layers', [1, 2])
def test_recurrent_network_equals_torch(layers):
    network, parameters = network_function(networks.RecurrentNetwork(18, 5, 33, layers, 'tanh'))
    assert_exact_to_rounding(network, [randoms(9, 20, 18), randoms(20, 33), starts(9, 20), *parameters], 1e-4)


@native
@pytest.mark.parametrize(('N', 'A', 'C'), [(3, 5, 50), (1, 4, 6), (2, 3, 5), (6, 5, 4)])
def test_reward_network_equals_torch_with_and_without_its_table(N, A, C):
    network, parameters = network_function(networks.PerAgentRewardNetwork(WorldSpec(N, A, 4, 11, False), 20))
    actions = torch.randint(A, (4, C, N), generator=torch.Generator().manual_seed(3))
    assert_exact_to_rounding(network, [randoms(4, C, 11), actions, randoms(C * N, 20), starts(4, C), *parameters], 1e-4)


@pytest.mark.parametrize(('N', 'A', 'C'), [(3, 5, 50), (1, 4, 6), (2, 3, 9)])
def test_table_of_the_others_actions_gives_what_each_agent_sees(N, A, C, monkeypatch):
    network, parameters = network_function(networks.PerAgentRewardNetwork(WorldSpec(N, A, 4, 11, False), 20))
    actions = torch.randint(A, (4, C, N), generator=torch.Generator().manual_seed(3))
    tensors = [randoms(4, C, 11), actions, randoms(C * N, 20), starts(4, C), *parameters]
    tensors = [x.double() if x.is_floating_point() else x for x in tensors]
    with_table = outputs_and_gradients(network, tensors)
    monkeypatch.setattr(networks, '_LOOK_UP_BELOW', 0)
    for a, b in zip(with_table, outputs_and_gradients(network, tensors), strict=True):
        torch.testing.assert_close(a, b)


def bits(tensors):
    return [x.detach().contiguous().view(torch.uint8).numpy().tobytes() for x in tensors]


@native
def test_same_bits_again_from_several_threads_at_once_and_at_any_address():
    tensors = gru_tensors(5, 101, 19, 21)
    expected = bits(outputs_and_gradients(gru, tensors))
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: bits(outputs_and_gradients(gru, tensors)), range(16)):
            assert result == expected
    moved = [torch.empty(x.numel() + 3, dtype=x.dtype)[3:].view(x.shape).copy_(x) for x in tensors]
    assert bits(outputs_and_gradients(gru, moved)) == expected


@native
def test_a_rows_bits_do_not_depend_on_the_rows_beside_it():
    inputs, initial, start, *weights = gru_tensors(5, 101, 19, 21)
    states = gru(inputs, initial, start, *weights)[0]
    some = gru(inputs[:, 31:50], initial[31:50], start[:, 31:50], *weights)[0]
    assert bits([states[:, 31:50]]) == bits([some])


@native
def test_same_bits_with_and_without_gradients():
    network = networks.RecurrentNetwork(18, 5, 33, 2, 'relu')
    for index, parameter in enumerate(network.parameters()):
        parameter.data = randoms(*parameter.shape, seed=index) / 4
    arguments = randoms(9, 20, 18), randoms(20, 33), starts(9, 20)
    with torch.no_grad():
        without = network(*arguments)
    assert bits(without) == bits(network(*arguments))


@native
def test_tensors_in_any_layout_are_taken():
    inputs, initial, start, *weights = gru_tensors(5, 30, 19, 21)
    expected = bits(outputs_and_gradients(gru, [inputs, initial, start, *weights]))
    strided = [x if x.dim() == 1 else x.transpose(0, 1).contiguous().transpose(0, 1)
               for x in (inputs, initial, start, *weights)]
    assert not strided[0].is_contiguous() and not strided[2].is_contiguous()
    assert bits(outputs_and_gradients(gru, strided)) == expected


@native
def test_no_rows_give_no_outputs_and_zero_gradients():
    inputs, initial, start, *weights = gru_tensors(5, 30, 19, 21)
    states, *gradients = outputs_and_gradients(gru, [inputs[:, :0], initial[:0], start[:, :0], *weights])
    assert states.shape == (5, 0, 21)
    assert all(not gradient.any() for gradient in gradients)
    network = networks.PerAgentRewardNetwork(WorldSpec(3, 5, 4, 11, False), 20)
    predicted, _ = network(randoms(4, 0, 11), torch.zeros(4, 0, 3, dtype=torch.int64), randoms(0, 20), starts(4, 0))
    assert predicted.shape == (4, 0, 3, 5)


@native
def test_gates_saturate_cleanly_and_a_nan_stays_visible():
    inputs, initial, start, *weights = gru_tensors(3, 4, 5, 6)
    states, gradient, *_ = outputs_and_gradients(gru, [inputs * 1e6, initial, start, *weights])
    assert states.isfinite().all() and gradient.isfinite().all()
    assert states.abs().max() <= initial.abs().max().clamp_min(1)
    inputs[1, 2, 3] = torch.nan
    states = gru(inputs, initial, start & False, *weights)[0]
    assert states[1:, 2].isnan().any() and not states[:, :2].isnan().any() and not states[0].isnan().any()


def test_other_precisions_go_to_torch():
    network = copy.deepcopy(networks.RecurrentNetwork(4, 2, 8, 1, 'relu')).double()
    outputs, _ = network(randoms(2, 3, 4).double(), randoms(3, 8).double(), starts(2, 3))
    assert outputs.dtype == torch.float64


ASK = 'import torch; from dae_ros.learning import kernels; print(kernels.available())'


def answer(**environment):
    """What a fresh process says about the kernels, and what it warns of."""
    result = subprocess.run([sys.executable, '-c', ASK], env=os.environ | environment, capture_output=True, text=True,
                            timeout=180)
    return result.stdout.strip(), result.stderr


def test_kernels_can_be_switched_off():
    assert answer(DAE_ROS_KERNELS='torch') == ('False', '')
    assert 'must be native or torch' in answer(DAE_ROS_KERNELS='fast')[1]


def test_without_a_compiler_torch_takes_over_with_one_warning(tmp_path):
    available, warnings = answer(DAE_ROS_KERNELS='native', CC='no-such-compiler', XDG_CACHE_HOME=str(tmp_path))
    assert available == 'False'
    assert warnings.count('several times slower') == 1 and 'no C compiler' in warnings


@native
def test_processes_that_start_at_once_all_get_whole_kernels(tmp_path):
    with ThreadPoolExecutor(3) as pool:
        answers = list(pool.map(lambda _: answer(DAE_ROS_KERNELS='native', XDG_CACHE_HOME=str(tmp_path)), range(3)))
    assert answers == [('True', '')] * 3
    assert len(list((tmp_path / 'dae_ros').iterdir())) == 1


@native
def test_kernels_are_built_even_where_no_cache_can_be_kept(tmp_path):
    (tmp_path / 'file').touch()
    assert answer(DAE_ROS_KERNELS='native', XDG_CACHE_HOME=str(tmp_path / 'file')) == ('True', '')
