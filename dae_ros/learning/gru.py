"""A GRU over a whole sequence as one differentiable operation.

Autograd over a step-by-step GRU records some twenty small operations per step; here the forward pass saves the gates
and the backward pass is written out, with the weights' gradients as one product over all steps. The native kernels
compute the same several times faster; this is their reference and fallback.
"""

from __future__ import annotations

import torch
from torch import Tensor


class _GruSequence(torch.autograd.Function):
    """h_t for all steps; gradients by backpropagation through time."""

    @staticmethod
    def forward(ctx, from_input: Tensor, initial: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        steps, rows, width = from_input.shape
        H = width // 3
        states = from_input.new_empty(steps, rows, H)
        previous = from_input.new_empty(steps, rows, H)
        gates = from_input.new_empty(steps, rows, 2 * H)
        candidate = from_input.new_empty(steps, rows, H)
        candidate_from_state = from_input.new_empty(steps, rows, H)
        from_state = from_input.new_empty(rows, width)
        transposed = weight.t()
        state = initial
        for t in range(steps):
            torch.mul(state, keep[t], out=previous[t])
            torch.addmm(bias, previous[t], transposed, out=from_state)
            torch.add(from_input[t, :, :2 * H], from_state[:, :2 * H], out=gates[t]).sigmoid_()
            candidate_from_state[t].copy_(from_state[:, 2 * H:])
            torch.addcmul(from_input[t, :, 2 * H:], gates[t, :, :H], candidate_from_state[t], out=candidate[t]).tanh_()
            state = torch.lerp(candidate[t], previous[t], gates[t, :, H:], out=states[t])
        ctx.save_for_backward(previous, gates, candidate, candidate_from_state, keep, weight)
        return states

    @staticmethod
    def backward(ctx, grad_states: Tensor):
        previous, gates, candidate, candidate_from_state, keep, weight = ctx.saved_tensors
        steps, rows, H = previous.shape
        grad_from_input = previous.new_empty(steps, rows, 3 * H)
        grad_from_state = previous.new_empty(steps, rows, 3 * H)
        # Everything that does not depend on the gradient of the step after is done for all steps at once.
        reset, update = gates[..., :H], gates[..., H:]
        candidate_factor = (1 - update) * (1 - candidate * candidate)
        reset_factor = candidate_from_state * reset * (1 - reset)
        update_factor = (previous - candidate) * update * (1 - update)
        carried = torch.zeros_like(previous[0])
        for t in reversed(range(steps)):
            grad = carried.add_(grad_states[t])
            grad_candidate = torch.mul(grad, candidate_factor[t], out=grad_from_input[t, :, 2 * H:])
            torch.mul(grad_candidate, reset_factor[t], out=grad_from_state[t, :, :H])
            torch.mul(grad, update_factor[t], out=grad_from_state[t, :, H:2 * H])
            torch.mul(grad_candidate, reset[t], out=grad_from_state[t, :, 2 * H:])
            carried = torch.mul(grad, update[t]).addmm_(grad_from_state[t], weight).mul_(keep[t])
        grad_from_input[..., :2 * H] = grad_from_state[..., :2 * H]
        flat = grad_from_state.view(-1, 3 * H)
        return grad_from_input, carried, None, flat.t() @ previous.view(-1, H), flat.sum(0)


def gru_sequence(inputs: Tensor, initial: Tensor, episode_start: Tensor,
                 weight_ih: Tensor, weight_hh: Tensor, bias_ih: Tensor, bias_hh: Tensor) -> Tensor:
    """States after each step of a GRU (Cho et al., 2014, with the reset gate after the product, as in cuDNN).

    inputs: [L, R, I]. initial: [R, H]. episode_start: [L, R] bool; the state is zeroed before those steps.
    weight_ih: [3H, I], weight_hh: [3H, H], bias_ih and bias_hh: [3H], gates in the order reset, update, candidate.
    Returns [L, R, H].
    """
    from_input = torch.addmm(bias_ih, inputs.reshape(-1, inputs.shape[-1]), weight_ih.t())
    keep = (~episode_start).to(inputs.dtype).unsqueeze(-1)
    return _GruSequence.apply(from_input.view(*inputs.shape[:2], len(bias_ih)), initial, keep, weight_hh, bias_hh)
