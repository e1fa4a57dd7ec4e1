"""A policy as an ONNX model: its numbers are the policy's, whoever runs it."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.weights.codec import decode_policy
from dae_ros.weights.onnx_file import encode_onnx

REPOSITORY = Path(__file__).parent.parent
SHIPPED = REPOSITORY / 'config' / 'policies' / 'navigation.safetensors'


RUNTIMES = ['onnx', pytest.param('onnxruntime', marks=pytest.mark.skipif(not importlib.util.find_spec('onnxruntime'),
                                                                         reason='needs onnxruntime: pip install onnxruntime'))]


def some_policy(activation: str) -> Policy:
    """A policy whose tensors, norms and biases among them, are all different."""
    draw, sizes = np.random.default_rng(1), PolicyArchitecture(9, 5, 12, 3, activation)
    return Policy(sizes, {name: draw.normal(size=shape).astype(np.float32) for name, shape in sizes.shapes().items()})


def runner(name: str, data: bytes):
    """A function of the inputs by name that gives the outputs."""
    if name == 'onnxruntime':
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(data, options, providers=['CPUExecutionProvider'])
    else:
        import onnx.reference

        session = onnx.reference.ReferenceEvaluator(onnx.load_from_string(data))
    return lambda inputs: session.run(['probabilities', 'next_state'], inputs)


@pytest.mark.parametrize('policy', [decode_policy(SHIPPED.read_bytes()), some_policy('relu'), some_policy('tanh')],
                         ids=['navigation', 'relu', 'tanh'])
@pytest.mark.parametrize('runtime', RUNTIMES)
def test_an_exported_policy_gives_the_same_probabilities_and_states_through_two_episodes(runtime, policy):
    run, draw, W = runner(runtime, encode_onnx(policy)), np.random.default_rng(2), 7
    state = exported = policy.initial_state(W)
    for step in range(50):
        start = np.full(W, step % 25 == 0)
        values = draw.normal(size=(W, policy.architecture.observation_size)).astype(np.float32)
        probabilities, state = policy.act(values, state, start)
        answers, exported = run({'observation': values, 'state': np.where(start[:, None], np.float32(0), exported)})
        np.testing.assert_allclose(answers, probabilities, rtol=0, atol=1e-5)
        np.testing.assert_allclose(exported, state, rtol=0, atol=1e-5)
    assert np.ptp(state) > 0.1 and np.ptp(probabilities) > 0.1


def test_equal_policies_give_equal_files():
    assert encode_onnx(some_policy('relu')) == encode_onnx(some_policy('relu'))


def export(*arguments, code='') -> subprocess.CompletedProcess:
    call = f'{code}\nfrom dae_ros_nodes.export_policy import main\nimport sys\nsys.exit(main({list(map(str, arguments))!r}))'
    return subprocess.run([sys.executable, '-c', call], capture_output=True, text=True, timeout=60)


def test_the_command_of_the_documentation_writes_the_model_and_says_what_goes_in_and_comes_out(tmp_path):
    source, output = re.search(r'/export_policy (\S+) (\S+)$', (REPOSITORY / 'docs/robots.md').read_text(), re.MULTILINE).groups()
    done = export(REPOSITORY / source, tmp_path / output)
    assert done.returncode == 0, done.stderr
    assert 'observation [W, 18], state [W, 64] to probabilities [W, 5], next_state [W, 64]' in done.stdout
    assert (tmp_path / 'policy.onnx').read_bytes() == encode_onnx(decode_policy(SHIPPED.read_bytes()))


@pytest.mark.parametrize('source, code, sentence', [
    ('nowhere.safetensors', '', 'cannot read the file nowhere.safetensors: No such file'), (__file__, '', 'is no policy: '),
    (SHIPPED, 'import sys; sys.modules["onnx"] = None', 'an ONNX model needs the package onnx: pip install onnx')])
def test_what_cannot_be_exported_is_said_in_one_sentence(source, code, sentence, tmp_path):
    done = export(source, tmp_path / 'policy.onnx', code=code)
    assert done.returncode == 2 and sentence in done.stderr and 'Traceback' not in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())
