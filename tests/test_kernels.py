"""The native kernels give the same bits always, refuse what does not fit, hide no nan, and are not needed."""

import copy
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from dae_ros.learning import kernels, losses, networks
from dae_ros.learning.native import build
from tests.kernel_cases import (
    LAYOUTS,
    Batch,
    Linear,
    Row,
    changed,
    double,
    examples,
    layer,
    native,
    randoms,
    recurrent_network,
    results,
)

EXAMPLES = pytest.mark.parametrize('example', range(6), ids=[
    'actor', 'critic', *(f'{name}, {how}' for name in networks.REWARD_NETWORKS for how in ('looked up', 'computed'))])


@pytest.fixture(scope='module')
def all_examples():
    return examples()


def bits(found):
    return {name: x.detach().contiguous().numpy().tobytes() for name, x in found.items()}


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


SANITIZERS = '-fsanitize=address,undefined', '-fno-sanitize-recover=all', '-O0', '-g'
RUN_ODD_SHAPES = """
import runpy, sys
from dae_ros.learning import kernels
from dae_ros.learning.native import library
kernels.library = library.opened(sys.argv[1])
library.chosen = lambda: kernels.library
cases, tests_of_policy = map(runpy.run_path, sys.argv[2:])
for network, batch, loss in cases['odd_shapes']():
    cases['results'](network, batch, loss)
    for laid_out in cases['LAYOUTS'].values():
        cases['results'](network, cases['changed'](batch, laid_out), cases['changed'](loss, laid_out))
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
    cases, tests_of_policy = map(Path(__file__).with_name, ('kernel_cases.py', 'test_policy.py'))
    result = subprocess.run([sys.executable, '-c', RUN_ODD_SHAPES, path, cases, tests_of_policy], env=environment,
                            capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
