"""The three losses as sums over weighted rows, so that shards of a batch add up to the batch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def policy_loss(log_ratio: Tensor, advantages: Tensor, weights: Tensor, clip: float) -> Tensor:
    """Clipped surrogate (eq. 4), negated: all tensors of one shape, log_ratio = log pi - log pi_old."""
    ratio = log_ratio.exp()
    surrogate = torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)
    return -(surrogate * weights).sum()


def entropy_bonus(log_probabilities: Tensor, weights: Tensor) -> Tensor:
    """Entropy of pi over the last axis, summed with `weights` of the leading axes."""
    entropy = -(log_probabilities.exp() * log_probabilities).sum(-1)
    return (entropy * weights).sum()


def value_loss(values: Tensor, old_values: Tensor, targets: Tensor, weights: Tensor, clip: float, delta: float) -> Tensor:
    """Clipped value loss (eq. 40) with Huber errors, on normalised values: the worse of moving freely and within `clip`."""
    clipped = old_values + (values - old_values).clamp(-clip, clip)
    errors = torch.maximum(functional.huber_loss(values, targets, reduction='none', delta=delta),
                           functional.huber_loss(clipped, targets, reduction='none', delta=delta))
    return (errors * weights).sum()


def reward_loss(predicted: Tensor, actions: Tensor, rewards: Tensor, weights: Tensor) -> Tensor:
    """Half the squared error of the predicted reward of the action taken (eq. 19).

    predicted: [..., A]. actions: [...] int64. rewards, weights: broadcast to [...].
    """
    taken = predicted.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
    return ((taken - rewards).square() * weights).sum() / 2
