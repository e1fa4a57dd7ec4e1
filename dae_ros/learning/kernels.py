"""The compiled kernels for the learner: a network's outputs, and the gradient of a loss of them, in one call each.

Without the library (see `native.library`), and for tensors that are not float32 on the CPU, `networks` computes the same
with torch's own operations. The two differ by rounding, so a run keeps to one of them. Calls give up Python's lock:
threads run side by side.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple, Sequence

import torch
from torch import Tensor

from dae_ros.learning.native.library import CArray, CBatch, CLoss, CStep, c_step, chosen

_LOSSES = {'policy': 0, 'value': 1, 'reward': 2, 'joint_reward': 3}
_OF_TEAM = ('reward', 'joint_reward')  # whose targets are [L, C]
_MOST_SUMS = 4


class Step(NamedTuple):
    """One step of a network; what it computes is said in native/kernels.c, with the shapes of its parameters."""

    kind: str        # 'layer', 'gru' or 'fan_out'
    activation: str  # of a layer: 'identity', 'relu' or 'tanh'
    inputs: int
    outputs: int
    parameters: tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]


class Batch(NamedTuple):
    """L steps of C columns, which are worlds or pieces of their history, of N agents each."""

    inputs: Tensor         # [L, C, R, I] with R = N, or 1 for the team as a whole
    initial: Tensor        # [C, rows at the GRU, H] its state before the first step
    episode_start: Tensor  # [L, C] bool; its state is zeroed before those steps
    num_agents: int        # N
    table: Tensor | None = None  # [K, O] what a fan-out adds
    codes: Tensor | None = None  # [L, C, N] int64 which row of it; None: one after another, K = L C N


class LossTerms(NamedTuple):
    """A loss as the kernels take it (see native/kernels.c)."""

    kind: str                   # 'policy', 'value', 'reward' or 'joint_reward'
    numbers: tuple[float, ...]  # at most 3
    actions: Tensor | None      # [L, C, N] int64
    data: tuple[Tensor, ...]    # at most 2
    weights: Tensor             # [L, C, N]; of a value loss [L, C]
    available: Tensor | None = None  # [L, C, N, A] bool actions a policy may choose; None: all


def available() -> bool:
    """Whether the compiled kernels are in use."""
    return library is not None


def usable(*tensors: Tensor) -> bool:
    """Whether the compiled kernels are in use and take these tensors."""
    return library is not None and all(x.dtype == torch.float32 and x.device.type == 'cpu' for x in tensors)


def forward(steps: Sequence[Step], batch: Batch) -> tuple[Tensor, Tensor]:
    """Outputs [L, C, rows, K] of the last step, and the GRU's states [L, C, rows, H] after each step of time, which are
    empty if there is none."""
    L, C = batch.episode_start.shape
    rows, *of_states = _rows(steps, batch)
    outputs, states = batch.inputs.new_empty(L, C, rows, steps[-1].outputs), batch.inputs.new_empty(L, C, *of_states)
    kept: list[Tensor] = []
    _check(library.network_forward(_steps(steps, {}), len(steps), _batch(steps, batch, kept), outputs.data_ptr(),
                                   states.data_ptr()))
    return outputs, states


def gradient(steps: Sequence[Step], parameters: Sequence[Tensor], batch: Batch,
             loss: LossTerms) -> tuple[Tensor, Tensor]:
    """Gradient of a loss of what `forward` gives.

    parameters: those of the steps, and others. Returns their gradients one after another in one flat vector, zeros for
    the others, and behind them that of the table [K, O]; and the loss's sums [4], of which the kind of loss says how many
    there are.
    """
    flat = torch.zeros(sum(x.numel() for x in (*parameters, batch.table) if x is not None))
    gradients, address = {}, flat.data_ptr()
    for parameter in parameters:
        gradients[parameter.data_ptr()] = address
        address += 4 * parameter.numel()
    sums = torch.zeros(_MOST_SUMS, dtype=torch.float64)
    kept: list[Tensor] = []
    columns = batch.episode_start.shape
    agents = (*columns, batch.num_agents)
    rows, outputs = _rows(steps, batch)[0], steps[-1].outputs
    if rows != (1 if loss.kind == 'joint_reward' else batch.num_agents) or loss.kind == 'value' and outputs != 1:
        raise ValueError(f'no {loss.kind} loss of {rows} rows of {outputs} outputs for {batch.num_agents} agents')
    numbers = loss.numbers + (0.0,) * (3 - len(loss.numbers))
    shape = columns if loss.kind in _OF_TEAM else agents
    data = [_array(x, shape, torch.float32, kept) for x in (*loss.data, None)[:2]]
    weights = _array(loss.weights, agents, torch.float32, kept)
    terms = CLoss(_LOSSES[loss.kind], (ctypes.c_double * 3)(*numbers), _array(loss.actions, agents, torch.int64, kept),
                  (CArray * 2)(*data), weights, _array(loss.available, (*agents, outputs), torch.bool, kept))
    _check(library.network_gradient(_steps(steps, gradients), len(steps), _batch(steps, batch, kept), terms,
                                    None if batch.table is None else address, sums.data_ptr()))
    return flat, sums.float()


def _rows(steps: Sequence[Step], batch: Batch) -> tuple[int, int, int]:
    """Rows per column at the end and at the GRU, and its units (0 and 0: there is none)."""
    rows, at_gru, units = batch.inputs.shape[2], 0, 0
    for step in steps:
        if step.kind == 'fan_out':
            rows = batch.num_agents
        elif step.kind == 'gru':
            at_gru, units = rows, step.outputs
    return rows, at_gru, units


def _steps(steps: Sequence[Step], gradients: dict[int, int]) -> ctypes.Array:
    """`gradients`: by a parameter's address, that of its gradient."""
    array = (CStep * len(steps))()
    for index, step in enumerate(steps):
        addresses = [None if x is None else _dense(x, x.shape).data_ptr() for x in step.parameters]
        array[index] = c_step(step.kind, step.activation, step.inputs, step.outputs, addresses)
        array[index].gradients[:] = [gradients.get(address) for address in addresses]
    return array


def _batch(steps: Sequence[Step], batch: Batch, kept: list[Tensor]) -> CBatch:
    """The batch for a kernel; what must live until that has been called is added to `kept`."""
    L, C = batch.episode_start.shape
    N, R = batch.num_agents, batch.inputs.shape[2]
    _, rows, units = _rows(steps, batch)
    if R not in (1, N):
        raise ValueError(f'inputs of {R} rows for {N} agents')
    initial = batch.initial.contiguous()
    kept.append(initial)
    arrays = (_array(batch.inputs, (L, C, R, steps[0].inputs), torch.float32, kept),
              _array(batch.episode_start, (L, C), torch.bool, kept), _array(batch.codes, (L, C, N), torch.int64, kept))
    table = None
    if batch.table is not None:
        kept.append(batch.table)
        width = next(step.outputs for step in steps if step.kind == 'fan_out')
        table = _dense(batch.table, (L * C * N if batch.codes is None else len(batch.table), width)).data_ptr()
    return CBatch(L, C, N, R, *arrays, _dense(initial, (C, rows, units)).data_ptr() if rows else None, table)


def _dense(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    if tensor.dtype != torch.float32 or tensor.shape != torch.Size(shape) or not tensor.is_contiguous():
        raise ValueError(f'{tensor.dtype} {tuple(tensor.shape)} where dense float32 {tuple(shape)} is needed')
    return tensor


def _array(tensor: Tensor | None, shape: Sequence[int], dtype: torch.dtype, kept: list[Tensor]) -> CArray:
    """A tensor [L, C, ...]; copied only if what belongs to one step of a column does not lie together."""
    if tensor is None:
        return CArray(None, 0, 0)
    if tensor.dtype != dtype or tensor.shape != torch.Size(shape):
        raise ValueError(f'{tensor.dtype} {tuple(tensor.shape)} where {dtype} {tuple(shape)} is needed')
    inner, together = 1, True
    for size, stride in zip(shape[:1:-1], tensor.stride()[:1:-1]):
        together &= size == 1 or stride == inner
        inner *= size or 1
    if not together or any(stride % inner for stride in tensor.stride()[:2]):
        tensor = tensor.contiguous()
    kept.append(tensor)
    step, column = tensor.stride()[:2]
    return CArray(tensor.data_ptr(), step // inner, column // inner)


def _check(failed: int) -> None:
    if failed:
        raise MemoryError('no memory for the scratch space of a network')


library = chosen()
if library is not None:
    library.keep_freed_memory()
