"""A policy as an ONNX model, for robots that have neither Python nor this package; recurrent state in and out.

Inputs: `observation` [W, O] and `state` [W, H], zeros where an episode begins. Outputs: `probabilities` [W, A] and `next_state`
[W, H]. All are float32, W is free. Where only some actions are available, take the probabilities of these, divided by their sum.
"""

from __future__ import annotations

import json

import numpy as np

from dae_ros.errors import DaeRosError
from dae_ros.learning.policy import LAYER_NORM_EPSILON, Policy

OPSET = 17      # the first with LayerNormalization
IR_VERSION = 8  # of that time, so that older runtimes read it


def encode_onnx(policy: Policy) -> bytes:
    """The model. Raises DaeRosError where the package `onnx` is not installed."""
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise DaeRosError('an ONNX model needs the package onnx: pip install onnx') from error
    sizes, tensors, nodes = policy.architecture, _tensors(policy), []

    def apply(operation: str, inputs: list[str], output: str, **attributes) -> str:
        nodes.append(helper.make_node(operation, inputs, [output], **attributes))
        return output

    def normalise(x: str, norm: str) -> str:
        return apply('LayerNormalization', [x, f'{norm}.weight', f'{norm}.bias'], norm, axis=-1,
                     epsilon=float(LAYER_NORM_EPSILON))

    x = normalise('observation', 'input_norm')
    for layer in range(sizes.mlp_layers):
        x = apply('Gemm', [x, f'mlp.{layer}.weight', f'mlp.{layer}.bias'], f'mlp.{layer}', transB=1)
        x = normalise(apply({'relu': 'Relu', 'tanh': 'Tanh'}[sizes.activation], [x], f'activation.{layer}'), f'mlp_norm.{layer}')
    # A recurrent operator wants a sequence, which here is of one step, and a direction.
    x, before = (apply('Unsqueeze', [name, 'first_axis'], f'{name}.sequence') for name in (x, 'state'))
    nodes.append(helper.make_node('GRU', [x, 'gru.weight_ih', 'gru.weight_hh', 'gru.bias', '', before], ['', 'gru'],
                                  hidden_size=sizes.hidden_size, linear_before_reset=1))
    x = normalise(apply('Squeeze', ['gru', 'first_axis'], 'next_state'), 'gru_norm')
    apply('Softmax', [apply('Gemm', [x, 'head.weight', 'head.bias'], 'scores', transB=1)], 'probabilities', axis=-1)

    def described(name: str, size: int):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ['W', size])

    graph = helper.make_graph(
        nodes, 'policy', [described('observation', sizes.observation_size), described('state', sizes.hidden_size)],
        [described('probabilities', sizes.num_actions), described('next_state', sizes.hidden_size)],
        [numpy_helper.from_array(tensor, name) for name, tensor in tensors.items()])
    opset = helper.make_opsetid('', OPSET)
    model = helper.make_model(graph, producer_name='dae_ros', ir_version=IR_VERSION, opset_imports=[opset])
    helper.set_model_props(model, {'dae_ros': json.dumps(sizes._asdict())})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def _tensors(policy: Policy) -> dict[str, np.ndarray]:
    """The policy's tensors as ONNX wants them: a GRU's gates in the order update, reset, candidate, with a direction."""
    tensors, H = dict(policy.tensors), policy.architecture.hidden_size

    def reordered(gates: np.ndarray) -> np.ndarray:
        return np.concatenate([gates[H:2 * H], gates[:H], gates[2 * H:]])

    biases = [reordered(tensors.pop(f'gru.bias_{side}')) for side in ('ih', 'hh')]
    for side in ('ih', 'hh'):
        tensors[f'gru.weight_{side}'] = reordered(tensors[f'gru.weight_{side}'])[None]
    tensors |= {'gru.bias': np.concatenate(biases)[None], 'first_axis': np.zeros(1, np.int64)}
    return dict(sorted(tensors.items()))  # a file's tensors come in no fixed order
