"""The losses as sums over weighted rows, so that shards of a batch add up to the batch.

Each is a function of a network's outputs [L, C, rows, K] that gives what is to be differentiated and sums worth showing,
and knows its terms for the compiled kernels, which compute the same.
"""

from __future__ import annotations

from typing import NamedTuple, Union

import torch
from torch import Tensor
from torch.nn import functional

from dae_ros.learning import joint_reward
from dae_ros.learning.kernels import LossTerms

_UNAVAILABLE = -1e10  # a logit whose probability is exactly 0, and that times its logarithm, too


class PolicyLoss(NamedTuple):
    """The clipped surrogate (eq. 4), negated, less the entropy bonus; on logits [L, C, N, A]."""

    actions: Tensor                # [L, C, N] int64
    old_log_probabilities: Tensor  # [L, C, N] of the actions under the acting policy
    advantages: Tensor             # [L, C, N]
    weights: Tensor                # [L, C, N]
    clip: float
    entropy_coefficient: float
    available: Tensor | None = None  # [L, C, N, A] bool actions that may be chosen; None: all

    sums = ('policy/loss', 'policy/entropy', 'policy/clipped_fraction', 'policy/kl')

    def __call__(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        if self.available is not None:
            logits = logits.masked_fill(~self.available, _UNAVAILABLE)
        log_probabilities = torch.log_softmax(logits, -1)
        log_ratio = log_probabilities.gather(-1, self.actions.unsqueeze(-1)).squeeze(-1) - self.old_log_probabilities
        ratio = log_ratio.exp()
        surrogate = torch.minimum(ratio * self.advantages, ratio.clamp(1 - self.clip, 1 + self.clip) * self.advantages)
        entropy = -(log_probabilities.exp() * log_probabilities).sum(-1)
        clipped = ((ratio - 1).abs() > self.clip).to(ratio.dtype)
        parts = torch.stack([-surrogate, entropy, clipped, -log_ratio])
        sums = (parts * self.weights).sum((1, 2, 3))
        return sums[0] - self.entropy_coefficient * sums[1], sums.detach()

    @property
    def terms(self) -> LossTerms:
        return LossTerms('policy', (self.clip, self.entropy_coefficient), self.actions,
                         (self.old_log_probabilities, self.advantages), self.weights, self.available)


class ValueLoss(NamedTuple):
    """The clipped value loss (eq. 40) with Huber errors, on normalised values [L, C, V, 1]: the worse of moving freely
    and within `clip`. Differentiated times `coefficient`."""

    old_values: Tensor  # [L, C, V]
    targets: Tensor     # [L, C, V]
    weights: Tensor     # [L, C, V]
    clip: float
    delta: float
    coefficient: float

    sums = ('value/loss',)

    def __call__(self, values: Tensor) -> tuple[Tensor, Tensor]:
        values = values.view_as(self.old_values)
        held = self.old_values + (values - self.old_values).clamp(-self.clip, self.clip)
        errors = torch.maximum(functional.huber_loss(values, self.targets, reduction='none', delta=self.delta),
                               functional.huber_loss(held, self.targets, reduction='none', delta=self.delta))
        loss = (errors * self.weights).sum()
        return self.coefficient * loss, loss.detach().view(1)

    @property
    def terms(self) -> LossTerms:
        return LossTerms('value', (self.clip, self.delta, self.coefficient), None, (self.old_values, self.targets),
                         self.weights)


class RewardLoss(NamedTuple):
    """Half the squared error of the predicted reward of the action taken (eq. 19), on predictions [L, C, N, A]."""

    actions: Tensor  # [L, C, N] int64
    rewards: Tensor  # [L, C]
    weights: Tensor  # [L, C, N]

    sums = ('reward_network/loss',)

    def __call__(self, predicted: Tensor) -> tuple[Tensor, Tensor]:
        taken = predicted.gather(-1, self.actions.unsqueeze(-1)).squeeze(-1)
        loss = ((taken - self.rewards.unsqueeze(-1)).square() * self.weights).sum() / 2
        return loss, loss.detach().view(1)

    @property
    def terms(self) -> LossTerms:
        return LossTerms('reward', (), self.actions, (self.rewards,), self.weights)


class JointRewardLoss(NamedTuple):
    """The same of a reward predicted once for the team, on the outputs [L, C, 1, N A (1 + R)] of a network (`joint_reward`),
    which say how far it lies from `mean`, in units of `deviation`. What is differentiated is in these units too."""

    actions: Tensor  # [L, C, N] int64
    rewards: Tensor  # [L, C]
    weights: Tensor  # [L, C, N]
    mean: float
    deviation: float

    sums = RewardLoss.sums

    def __call__(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        predicted = joint_reward.of_joint_action(outputs.squeeze(-2), self.actions)
        errors = predicted - (self.rewards - self.mean) / self.deviation
        loss = (errors.square() * self.weights.sum(-1)).sum() / 2
        return loss, loss.detach().view(1) * self.deviation ** 2

    @property
    def terms(self) -> LossTerms:
        return LossTerms('joint_reward', (joint_reward.RANK, self.mean, self.deviation), self.actions, (self.rewards,),
                         self.weights)


Loss = Union[PolicyLoss, ValueLoss, RewardLoss, JointRewardLoss]
