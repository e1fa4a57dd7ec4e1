"""The native layers as differentiable torch operations, and whether they can be had here.

`library` is chosen once, at import: the compiled kernels, or None where there is no C compiler or where the environment
variable DAE_ROS_KERNELS is `torch`; then, and for tensors that are not float32 on the CPU, `networks` and `gru` compute the
same with torch's own operations. The two differ by rounding, so a run keeps to one of them. Calls give up Python's lock:
threads run side by side.
"""

from __future__ import annotations

import ctypes
import os
import warnings

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dae_ros.learning.native.build import BuildError, library_path

ACTIVATIONS = {'identity': 0, 'relu': 1, 'tanh': 2}


def _load() -> ctypes.CDLL | None:
    choice = os.environ.get('DAE_ROS_KERNELS', 'native')
    if choice not in ('native', 'torch'):
        raise ValueError(f'DAE_ROS_KERNELS must be native or torch, not {choice!r}')
    if choice == 'torch':
        return None
    try:
        with library_path() as path:
            loaded = ctypes.CDLL(str(path))
    except (BuildError, OSError) as error:
        warnings.warn(f'the learner runs without its native kernels, several times slower: {error}', stacklevel=2)
        return None
    for name, sizes, pointers in (('gru_forward', 4, 9), ('gru_backward', 4, 14), ('layer_forward', 3, 8),
                                  ('layer_backward', 3, 11)):
        function = getattr(loaded, name)
        scalars = [ctypes.c_long] * sizes + ([ctypes.c_int] if name.startswith('layer') else [])
        function.argtypes = scalars + [ctypes.c_void_p] * pointers
        function.restype = ctypes.c_int
    return loaded


library = _load()


def available() -> bool:
    """Whether the compiled kernels are in use."""
    return library is not None


def usable(*tensors: Tensor) -> bool:
    """Whether the compiled kernels are in use and take these tensors."""
    return library is not None and all(x.dtype == torch.float32 and x.device.type == 'cpu' for x in tensors)


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor | None) -> None:
    """Calls a kernel with the tensors' addresses; they must be contiguous."""
    if getattr(library, name)(*sizes, *(None if x is None else x.data_ptr() for x in tensors)):
        raise MemoryError(f'no memory for the scratch space of {name} at sizes {sizes}')


def _tracked(*tensors: Tensor | None) -> bool:
    return torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors)


class _Gru(torch.autograd.Function):

    @staticmethod
    def forward(ctx, inputs, initial, start, weight_ih, weight_hh, bias_ih, bias_hh):
        inputs, initial, start = inputs.contiguous(), initial.contiguous(), start.contiguous()
        weights = [x.contiguous() for x in (weight_ih, weight_hh)]
        states, gates = _gru_forward(inputs, initial, start, *weights, bias_ih, bias_hh, save=True)
        ctx.save_for_backward(inputs, initial, start, *weights, states, gates)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_states):
        inputs, initial, start, weight_ih, weight_hh, states, gates = ctx.saved_tensors
        L, R, I = inputs.shape
        grad_inputs = torch.empty_like(inputs) if ctx.needs_input_grad[0] else None
        grads = [torch.empty_like(x) for x in (initial, weight_ih, weight_hh)] + [
            inputs.new_empty(len(weight_hh)) for _ in range(2)]
        _call('gru_backward', (L, R, I, initial.shape[1]), inputs, initial, start, weight_ih, weight_hh, states, gates,
              grad_states.contiguous(), grad_inputs, *grads)
        return grad_inputs, grads[0], None, *grads[1:]


def _gru_forward(inputs, initial, start, weight_ih, weight_hh, bias_ih, bias_hh, save):
    L, R, I = inputs.shape
    H = initial.shape[1]
    states = inputs.new_empty(L, R, H)
    gates = inputs.new_empty(L, R, 4 * H) if save else None
    _call('gru_forward', (L, R, I, H), inputs, initial, start, weight_ih, weight_hh, bias_ih.contiguous(),
          bias_hh.contiguous(), states, gates)
    return states, gates


def gru(inputs: Tensor, initial: Tensor, episode_start: Tensor, weight_ih: Tensor, weight_hh: Tensor, bias_ih: Tensor,
        bias_hh: Tensor) -> Tensor:
    """`gru.gru_sequence`, natively: same arguments, same result [L, R, H] to rounding."""
    parts = (inputs, initial, episode_start, weight_ih, weight_hh, bias_ih, bias_hh)
    if _tracked(*parts):
        return _Gru.apply(*parts)
    return _gru_forward(*(x.contiguous() for x in parts), save=False)[0]


class _Layer(torch.autograd.Function):

    @staticmethod
    def forward(ctx, x, weight, bias, activation, scale, shift):
        x = x.contiguous()
        weight, scale = (None if part is None else part.contiguous() for part in (weight, scale))
        y, activated, statistics = _layer_forward(x, weight, bias, activation, scale, shift, save=True)
        ctx.activation = activation
        ctx.save_for_backward(x, weight, scale, activated, statistics)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_y):
        x, weight, scale, activated, statistics = ctx.saved_tensors
        I, O = x.shape[-1], grad_y.shape[-1]
        grad_x = torch.empty_like(x) if ctx.needs_input_grad[0] or weight is None else None
        grad_weight, grad_bias = (None, None) if weight is None else (torch.empty_like(weight), x.new_empty(O))
        grad_scale, grad_shift = (None, None) if scale is None else (x.new_empty(O), x.new_empty(O))
        _call('layer_backward', (grad_y.numel() // O, I, O, ctx.activation), x, weight, scale, activated, statistics,
              grad_y.contiguous(), grad_x, grad_weight, grad_bias, grad_scale, grad_shift)
        return grad_x, grad_weight, grad_bias, None, grad_scale, grad_shift


def _layer_forward(x, weight, bias, activation, scale, shift, save):
    I = x.shape[-1]
    O = I if weight is None else len(weight)
    rows = x.numel() // I
    y = x.new_empty(*x.shape[:-1], O)
    activated = statistics = None
    if save:
        # The kernel writes `activated` only where it is neither the layer's input nor its output.
        as_it_is = weight is None and activation == ACTIVATIONS['identity']
        activated = y if scale is None else x if as_it_is else torch.empty_like(y)
        statistics = None if scale is None else x.new_empty(rows, 2)
    bias, scale, shift = (None if part is None else part.contiguous() for part in (bias, scale, shift))
    _call('layer_forward', (rows, I, O, activation), x, weight, bias, scale, shift, activated, statistics, y)
    return y, activated, statistics


def layer(x: Tensor, weight: Tensor | None, bias: Tensor | None, activation: str, scale: Tensor | None,
          shift: Tensor | None) -> Tensor:
    """LayerNorm(activation(x weight^T + bias)).

    x: [..., I]. weight [O, I] and bias [O], or both None: x itself. activation: identity, relu or tanh. scale and shift
    [O], or both None: no LayerNorm. Returns [..., O].
    """
    activation = ACTIVATIONS[activation]
    if _tracked(x, weight, bias, scale, shift):
        return _Layer.apply(x, weight, bias, activation, scale, shift)
    weight = None if weight is None else weight.contiguous()
    return _layer_forward(x.contiguous(), weight, bias, activation, scale, shift, save=False)[0]
