"""Potential-based difference rewards over k steps and over beta, and their discounted returns, as the paper defines them.

The theory behind `advantages`, for finite episodes: training needs none of it. Everywhere, rewards are [T, ...], what
one episode or many side by side were paid; expected_rewards [T, ..., N] are E over a_i ~ pi_i of the reward, for each
agent, at the states and the other agents' actions that were met; the result is [T, ..., N]. After step T, both are 0.
"""

from __future__ import annotations

import torch
from torch import Tensor


def k_step_rewards(rewards: Tensor, expected_rewards: Tensor, k: int, gamma: float) -> Tensor:
    """Eq. (14): r_t + gamma^k E[r_{t+k}] - E[r_t]. k = 0 is the reward itself, k >= T the difference reward."""
    later = torch.zeros_like(expected_rewards)
    later[:max(len(later) - k, 0)] = expected_rewards[k:]
    return rewards.unsqueeze(-1) + gamma**k * later - expected_rewards


def k_step_returns(rewards: Tensor, expected_rewards: Tensor, k: int, gamma: float) -> Tensor:
    """Eq. (15): the discounted return less the discounted sum of the next k expected rewards."""
    credited = _discounts(len(rewards), gamma).tril(k - 1)
    return _sums(_discounts(len(rewards), gamma), rewards).unsqueeze(-1) - _sums(credited, expected_rewards)


def beta_rewards(rewards: Tensor, expected_rewards: Tensor, beta: float, gamma: float) -> Tensor:
    """Eq. (16), its first line: (1 - beta) times the sum over k >= 0 of beta^k r^(k), which eq. (17) is the return of.

    That is r_t - E[r_t] + (1 - beta) sum_{l>=0} (gamma beta)^l E[r_{t+l}]. The paper's second line sums from l = 1 and
    with one beta less: it is the average of r^(1), r^(2), ..., and beta = 0 makes it r^(1) rather than the reward.
    """
    later = _sums(_discounts(len(rewards), gamma * beta), expected_rewards)
    return rewards.unsqueeze(-1) - expected_rewards + (1 - beta) * later


def beta_returns(rewards: Tensor, expected_rewards: Tensor, beta: float, gamma: float) -> Tensor:
    """Eq. (17): the sum over l of gamma^l (r_{t+l} - beta^(l+1) E[r_{t+l}])."""
    team = _sums(_discounts(len(rewards), gamma), rewards).unsqueeze(-1)
    return team - beta * _sums(_discounts(len(rewards), gamma * beta), expected_rewards)


def _discounts(steps: int, gamma: float) -> Tensor:
    """[T, T], float64: gamma^(u-t) from step t to a later step u, and 0 to an earlier one."""
    later = torch.arange(steps) - torch.arange(steps).unsqueeze(-1)
    return (gamma ** later.clamp(min=0).double()).triu()


def _sums(weights: Tensor, terms: Tensor) -> Tensor:
    return torch.einsum('tu,u...->t...', weights, terms.double())
