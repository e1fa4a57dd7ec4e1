"""A running mean and deviation of the value targets, so that the critic learns numbers of size one."""

from __future__ import annotations

import math

import torch
from torch import Tensor

DECAY = 0.99999


class ValueNormalizer:
    """Exponential mean and mean square, debiased for having started at zero; kept in float64."""

    def __init__(self):
        self.mean = 0.0
        self.mean_square = 0.0
        self.weight = 0.0

    def update(self, targets: Tensor) -> None:
        """Take in one rollout's value targets, of any shape."""
        targets = targets.double()
        self.mean = DECAY * self.mean + (1 - DECAY) * float(targets.mean())
        self.mean_square = DECAY * self.mean_square + (1 - DECAY) * float(targets.square().mean())
        self.weight = DECAY * self.weight + (1 - DECAY)

    def normalize(self, targets: Tensor) -> Tensor:
        """Targets in the critic's scale."""
        mean, deviation = self._statistics()
        return (targets - mean) / deviation

    def denormalize(self, values: Tensor) -> Tensor:
        """Critic outputs in the reward's scale."""
        mean, deviation = self._statistics()
        return values * deviation + mean

    def state(self) -> Tensor:
        """All there is to save: [3] float64."""
        return torch.tensor([self.mean, self.mean_square, self.weight], dtype=torch.float64)

    def load_state(self, state: Tensor) -> None:
        self.mean, self.mean_square, self.weight = state.tolist()

    def _statistics(self) -> tuple[float, float]:
        if self.weight == 0:
            return 0.0, 1.0
        mean = self.mean / self.weight
        variance = self.mean_square / self.weight - mean * mean
        return mean, math.sqrt(max(variance, 1e-2))
