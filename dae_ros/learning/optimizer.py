"""Adam on a network whose parameters lie in one flat vector, so that a step is a handful of operations."""

from __future__ import annotations

from typing import Mapping

import torch
from torch import Tensor, nn


class FlatAdam:
    """Owns the storage of `network`'s parameters and steps all of them at once (Kingma and Ba, 2015)."""

    def __init__(self, network: nn.Module, learning_rate: float, epsilon: float, max_gradient_norm: float):
        self.network = network
        self._max_gradient_norm = max_gradient_norm
        parameters = tuple(network.parameters())
        self._flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        offset = 0
        for parameter in parameters:
            parameter.data = self._flat[offset:offset + parameter.numel()].view_as(parameter)
            offset += parameter.numel()
        self._optimizer = torch.optim.Adam([self._flat], lr=learning_rate, eps=epsilon, fused=True)
        # Adam makes its moments at the first step; they are made here so that a checkpoint always has the same tensors.
        steps = torch.zeros((), device=self._flat.device)
        self._optimizer.state[self._flat] = {'step': steps, 'exp_avg': torch.zeros_like(self._flat),
                                             'exp_avg_sq': torch.zeros_like(self._flat)}

    def step(self, gradient: Tensor) -> float:
        """One step along `gradient`, shortened to the largest allowed norm. Returns the norm before that."""
        norm = float(gradient.norm())
        if norm > self._max_gradient_norm:
            gradient = gradient * (self._max_gradient_norm / (norm + 1e-6))
        self._flat.grad = gradient
        self._optimizer.step()
        return norm

    def state(self) -> dict[str, Tensor]:
        """Parameters by name and Adam's moments, to be saved."""
        tensors = {f'parameters.{name}': parameter.detach() for name, parameter in self.network.named_parameters()}
        return tensors | {f'adam.{name}': value for name, value in self._optimizer.state[self._flat].items()}

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state` gave; KeyError or RuntimeError if a tensor is missing or of another shape."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])
