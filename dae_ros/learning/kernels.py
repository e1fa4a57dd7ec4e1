"""The native layers as differentiable torch operations, and whether they can be had here.

`library` is chosen once, at import: the compiled kernels, or None where there is no C compiler or where the environment
variable DAE_ROS_KERNELS is `torch`; then, and for tensors that are not float32 on the CPU, `networks` computes the
same with torch's own operations. The two differ by rounding, so a run keeps to one of them. Calls give up Python's
lock: threads run side by side.
"""

from __future__ import annotations

import ctypes
import os
import warnings
from typing import NamedTuple, Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dae_ros.learning.native.build import BuildError, library_path

_ACTIVATIONS = {'identity': 0, 'relu': 1, 'tanh': 2}

# Sizes and addresses each kernel takes.
_SIGNATURES = {'gru_forward': (4, 9), 'gru_backward': (4, 14), 'layer_forward': (4, 8), 'layer_backward': (4, 11),
               'looked_up_forward': (3, 8), 'looked_up_backward': (4, 9)}


class Step(NamedTuple):
    """One step of a chain: a GRU, or LayerNorm(activation(x weight^T + bias)) of which any part may be left out.

    Parameters of a GRU: weight_ih, weight_hh, bias_ih, bias_hh, as in `gru.gru_sequence`; otherwise weight [O, I] and
    bias [O], scale and shift [O] of the LayerNorm.
    """

    kind: str  # 'gru', or the activation: 'identity', 'relu' or 'tanh'
    parameters: tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]


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
    for name, (sizes, pointers) in _SIGNATURES.items():
        function = getattr(loaded, name)
        function.argtypes = [ctypes.c_long] * sizes + [ctypes.c_void_p] * pointers
        function.restype = ctypes.c_int
    loaded.keep_freed_memory()
    return loaded


def available() -> bool:
    """Whether the compiled kernels are in use."""
    return library is not None


def usable(*tensors: Tensor) -> bool:
    """Whether the compiled kernels are in use and take these tensors."""
    return library is not None and all(x.dtype == torch.float32 and x.device.type == 'cpu' for x in tensors)


def chain(steps: Sequence[Step], x: Tensor, initial: Tensor | None = None,
          episode_start: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
    """The steps one after another, of which at most one is a GRU; then x is [L, R, I].

    initial: the GRU's state before the first step [R, H]. episode_start: [L, R] bool; its state is zeroed before those
    steps. Returns what the last step gives [..., O], and the GRU's states [L, R, H].
    """
    kinds = tuple(step.kind for step in steps)
    parameters = [part for step in steps for part in step.parameters]
    if _tracked(x, initial, *parameters):
        return _Chain.apply(kinds, x, initial, episode_start, *parameters)
    parameters = _contiguous(parameters)
    x, initial, start = _contiguous((x, initial, episode_start))
    states = None
    for index, kind in enumerate(kinds):
        own = parameters[4 * index:4 * index + 4]
        if kind == 'gru':
            x = states = _gru_forward(x, initial, start, own, None)
        else:
            x = _layer_forward(x, kind, own, None, None)
    return x, states


def looked_up(table: Tensor, codes: Tensor | None, shared: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """LayerNorm(relu(table[codes] + shared)), without writing down what is normalised.

    table: [K, O]. codes: [M, N] int64 in 0 .. K - 1, or None: one row of the table after another, K = M N.
    shared: [M, O]. scale and shift [O]: of the LayerNorm. Returns [M, N, O].
    """
    if _tracked(table, shared, scale, shift):
        return _LookedUp.apply(table, codes, shared, scale, shift)
    table, codes, shared, scale, shift = _contiguous((table, codes, shared, scale, shift))
    y = _looked_up_output(table, codes, shared)
    M, N, O = y.shape
    _call('looked_up_forward', (M * N, N, O), codes, table, shared, scale, shift, y, None, y)
    return y


class _Chain(torch.autograd.Function):
    """All steps in one operation: autograd's own work per operation would cost as much as a small layer."""

    @staticmethod
    def forward(ctx, kinds, x, initial, start, *parameters):
        ctx.kinds = kinds
        ctx.set_materialize_grads(False)
        parameters = _contiguous(parameters)
        x, initial, start = _contiguous((x, initial, start))
        saved, states = [], None
        for index, kind in enumerate(kinds):
            own, inputs = parameters[4 * index:4 * index + 4], x
            if kind == 'gru':
                gates = x.new_empty(*x.shape[:2], 4 * initial.shape[1])
                x = states = _gru_forward(inputs, initial, start, own, gates)
                saved += [inputs, states, gates]
            else:
                weight, scale = own[0], own[2]
                width = x.shape[-1] if weight is None else len(weight)
                # The kernel writes `activated` only where it is neither the layer's input nor its output.
                apart = scale is not None and (weight is not None or kind != 'identity')
                activated = x.new_empty(*x.shape[:-1], width) if apart else None
                statistics = None if scale is None else x.new_empty(*x.shape[:-1], 2)
                x = _layer_forward(inputs, kind, own, activated, statistics)
                saved += [inputs, activated if apart else x if scale is None else inputs, statistics]
        ctx.save_for_backward(initial, start, *parameters, *saved)
        return x, states

    @staticmethod
    @once_differentiable
    def backward(ctx, grad, grad_of_states):
        initial, start, *rest = ctx.saved_tensors
        parameters, saved = rest[:4 * len(ctx.kinds)], rest[4 * len(ctx.kinds):]
        grads: list[Tensor | None] = [None] * len(parameters)
        grad_initial = None
        for index in reversed(range(len(ctx.kinds))):
            kind, own = ctx.kinds[index], parameters[4 * index:4 * index + 4]
            inputs, first, second = saved[3 * index:3 * index + 3]
            if kind == 'gru' and grad_of_states is not None:
                grad = grad_of_states if grad is None else grad + grad_of_states
            if grad is None:
                continue
            grad, = _contiguous((grad,))
            of_own = [None if part is None else torch.empty_like(part) for part in own]
            of_inputs = torch.empty_like(inputs) if index or ctx.needs_input_grad[1] else None
            I, O = inputs.shape[-1], grad.shape[-1]
            if kind == 'gru':
                grad_initial = torch.empty_like(initial) if ctx.needs_input_grad[2] else None
                _call('gru_backward', (*inputs.shape[:2], I, O), inputs, initial, start, own[0], own[1], first, second,
                      grad, of_inputs, grad_initial, *of_own)
            else:
                _call('layer_backward', (inputs.numel() // I, I, O, _ACTIVATIONS[kind]), inputs, own[0], own[2], first,
                      second, grad, of_inputs, *of_own)
            grads[4 * index:4 * index + 4] = of_own
            grad = of_inputs
        return None, grad, grad_initial, None, *grads


class _LookedUp(torch.autograd.Function):

    @staticmethod
    def forward(ctx, table, codes, shared, scale, shift):
        table, codes, shared, scale, shift = _contiguous((table, codes, shared, scale, shift))
        y = _looked_up_output(table, codes, shared)
        activated, statistics = torch.empty_like(y), y.new_empty(*y.shape[:2], 2)
        M, N, O = y.shape
        _call('looked_up_forward', (M * N, N, O), codes, table, shared, scale, shift, activated, statistics, y)
        ctx.table_rows = len(table)
        ctx.save_for_backward(codes, scale, activated, statistics)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        codes, scale, activated, statistics = ctx.saved_tensors
        M, N, O = grad.shape
        grad_table, grad_shared = grad.new_empty(ctx.table_rows, O), grad.new_empty(M, O)
        grad_scale, grad_shift = torch.empty_like(scale), torch.empty_like(scale)
        _call('looked_up_backward', (M * N, N, O, ctx.table_rows), codes, scale, activated, statistics,
              grad.contiguous(), grad_table, grad_shared, grad_scale, grad_shift)
        return grad_table, None, grad_shared, grad_scale, grad_shift


def _tracked(*tensors: Tensor | None) -> bool:
    return torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors)


def _contiguous(tensors: Sequence[Tensor | None]) -> list[Tensor | None]:
    return [None if x is None else x.contiguous() for x in tensors]


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor | None) -> None:
    """Calls a kernel with the tensors' addresses; they must be contiguous."""
    if getattr(library, name)(*sizes, *(None if x is None else x.data_ptr() for x in tensors)):
        raise MemoryError(f'no memory for the scratch space of {name} at sizes {sizes}')


def _gru_forward(x, initial, start, parameters, gates):
    states = x.new_empty(*x.shape[:2], initial.shape[1])
    _call('gru_forward', (*x.shape, initial.shape[1]), x, initial, start, *parameters, states, gates)
    return states


def _layer_forward(x, activation, parameters, activated, statistics):
    I = x.shape[-1]
    O = I if parameters[0] is None else len(parameters[0])
    y = x.new_empty(*x.shape[:-1], O)
    _call('layer_forward', (x.numel() // I, I, O, _ACTIVATIONS[activation]), x, *parameters, activated, statistics, y)
    return y


def _looked_up_output(table, codes, shared):
    rows = len(shared)
    return table.new_empty(rows, len(table) // max(rows, 1) if codes is None else codes.shape[1], table.shape[1])


library = _load()
