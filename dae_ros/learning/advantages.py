"""Advantage estimators as pure functions on tensors: GAE and the credit baseline that makes it DAE.

A step's `continues` is 1 where its episode goes on to the next step of the rollout and 0 where it ended with this step,
for good or by being cut off. `next_values` is the value of what came after the step: V of the next state, V of the
final state where the episode was cut off, 0 where it ended for good.
"""

from __future__ import annotations

import torch
from torch import Tensor


def generalized_advantages(rewards: Tensor, values: Tensor, next_values: Tensor, continues: Tensor,
                           gamma: float, gae_lambda: float) -> Tensor:
    """GAE (eq. 5): G_t = delta_t + gamma lambda c_t G_{t+1}. All tensors [T, W], or of as many dimensions."""
    deltas = rewards + gamma * next_values - values
    return _discounted_sum(deltas, gamma * gae_lambda * continues)


def credit_baselines(expected_rewards: Tensor, continues: Tensor, beta: float, gamma: float, gae_lambda: float) -> Tensor:
    """What DAE subtracts from the team's GAE for each agent: B_t = beta e_t + gamma lambda beta c_t B_{t+1}.

    expected_rewards: e [T, W, N], the reward averaged over the agent's own action. continues: [T, W]. Returns [T, W, N].
    This is eq. (18)'s sum over -beta^{l+1} E[r_{t+l}] (l counts from t, hence the extra beta in the recursion).
    """
    return _discounted_sum(beta * expected_rewards, (gamma * gae_lambda * beta * continues).unsqueeze(-1))


def expected_rewards(predicted: Tensor, probabilities: Tensor) -> Tensor:
    """E over a_i ~ pi_i of the predicted reward: both [..., A], the acting policy's whole distribution. Returns [...]."""
    return (predicted * probabilities).sum(-1)


def of_actions(numbers: Tensor, actions: Tensor) -> Tensor:
    """Of numbers [..., A] for every action those of the actions taken [...]."""
    return numbers.gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def lambda_returns(rewards: Tensor, values: Tensor, continues: Tensor, cut_off: Tensor, gamma: float,
                   gae_lambda: float) -> Tensor:
    """TD(lambda) targets of the value Q of the actions taken: y_t = r_t + gamma c_t ((1 - lambda) Q_{t+1} + lambda y_{t+1}).

    All tensors [T, W]. Where `cut_off` says that the next joint action is unknown, y_t = Q_t.
    """
    later = torch.cat([values[1:], torch.zeros_like(values[:1])])
    terms = torch.where(cut_off, values, rewards + gamma * (1 - gae_lambda) * continues * later)
    return _discounted_sum(terms, gamma * gae_lambda * continues * ~cut_off)


def n_step_returns(rewards: Tensor, values: Tensor, continues: Tensor, cut_off: Tensor, gamma: float, n: int) -> Tensor:
    """The value of the actions taken with n rewards in place of what it says of them (the first terms of eq. 41):
    r_t + gamma r_{t+1} + ... + gamma^n Q_{t+n}.

    values: Q [T, W, N], each agent's estimate. The others [T, W], as in `lambda_returns`. Returns [T, W, N]; n = 0 gives Q.
    """
    rewards, continues, cut_off = rewards.unsqueeze(-1), continues.unsqueeze(-1), cut_off.unsqueeze(-1)
    returns = values
    for _ in range(n):
        later = torch.cat([returns[1:], torch.zeros_like(returns[:1])])
        returns = torch.where(cut_off, values, rewards + gamma * continues * later)
    return returns


def normalized(advantages: Tensor, present: Tensor | None) -> Tensor:
    """Mean 0 and deviation 1 over everything, or over those `present`, bool of the same shape."""
    counted = among(advantages, present)
    return (advantages - counted.mean()) / (counted.std(correction=0) + 1e-5)


def among(numbers: Tensor, present: Tensor | None) -> Tensor:
    """Those of numbers [T, W, N] that belong to agents `present` [T, W, N] bool; all if that is None."""
    return numbers if present is None else numbers[present]


def mean_over_agents(numbers: Tensor, present: Tensor | None) -> Tensor:
    """[T, W] from numbers [T, W, N], over the agents `present` [T, W, N] bool; 0 where there are none."""
    if present is None:
        return numbers.mean(-1)
    return torch.where(present, numbers, 0).sum(-1) / present.sum(-1).clamp_min(1)


def _discounted_sum(terms: Tensor, factors: Tensor) -> Tensor:
    """x_t = terms_t + factors_t x_{t+1}, from the last step backwards."""
    result = torch.empty_like(terms)
    carried = torch.zeros_like(terms[0])
    for t in reversed(range(len(terms))):
        carried = terms[t] + factors[t] * carried
        result[t] = carried
    return result
