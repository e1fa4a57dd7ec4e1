"""Adam on a network whose parameters lie in one flat vector, so that a step is a handful of operations."""

from __future__ import annotations

import math
from typing import Mapping

import torch
from torch import Tensor, nn

BETAS = (0.9, 0.999)  # decay of the gradient's mean and mean square


class FlatAdam:
    """Owns the storage of `network`'s parameters and steps all of them at once (Kingma and Ba, 2015)."""

    def __init__(self, network: nn.Module, learning_rate: float, epsilon: float, max_gradient_norm: float):
        self.network = network
        self._learning_rate = learning_rate
        self._epsilon = epsilon
        self._max_gradient_norm = max_gradient_norm
        parameters = tuple(network.parameters())
        self._flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        offset = 0
        for parameter in parameters:
            parameter.data = self._flat[offset:offset + parameter.numel()].view_as(parameter)
            offset += parameter.numel()
        self._steps = torch.zeros((), device=self._flat.device)
        self._mean, self._square = torch.zeros_like(self._flat), torch.zeros_like(self._flat)

    def step(self, gradient: Tensor) -> float:
        """One step along `gradient`, shortened to the largest allowed norm. Returns the norm before that."""
        norm = float(gradient.norm())
        if norm > self._max_gradient_norm:
            gradient = gradient * (self._max_gradient_norm / (norm + 1e-6))
        self._steps += 1
        count = float(self._steps)
        self._mean.lerp_(gradient, 1 - BETAS[0])
        self._square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
        deviation = self._square.sqrt().div_(math.sqrt(1 - BETAS[1]**count)).add_(self._epsilon)
        self._flat.addcdiv_(self._mean, deviation, value=-self._learning_rate / (1 - BETAS[0]**count))
        return norm

    def state(self) -> dict[str, Tensor]:
        """Parameters by name and Adam's moments, to be saved."""
        tensors = {f'parameters.{name}': parameter.detach() for name, parameter in self.network.named_parameters()}
        return tensors | {'adam.steps': self._steps, 'adam.mean': self._mean, 'adam.square': self._square}

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state` gave; KeyError or RuntimeError if a tensor is missing or of another shape."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])
