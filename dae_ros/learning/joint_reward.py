"""The reward of a joint action, from a number and a vector for each action of each agent: a factorisation machine (Rendle, 2010).

    r(a) = sum_i u_i(a_i) + 1 / N^2 sum_{i < j} v_i(a_i) . v_j(a_j)

A network gives u and v as functions of state and history, once per world; what every other action of one agent would have
been rewarded with follows without another pass. N^2 keeps what the pairs say from growing with their number: in large teams
they would drown the single actions for as long as little is learnt. All tensors begin with the same dimensions [...].
"""

from __future__ import annotations

from torch import Tensor

RANK = 4  # R, of the vectors


def size(num_agents: int, num_actions: int) -> int:
    """How many outputs a network needs: N A (1 + R)."""
    return num_agents * num_actions * (1 + RANK)


def of_joint_action(outputs: Tensor, actions: Tensor) -> Tensor:
    """Rewards [...] of joint actions [..., N] int64, from a network's outputs [..., N A (1 + R)]."""
    _, _, alone, vectors = _parts(outputs, actions)
    return alone.sum(-1) + _pairs(vectors.sum(-2), vectors.square().sum((-2, -1))) / actions.shape[-1] ** 2


def of_own_actions(outputs: Tensor, actions: Tensor) -> Tensor:
    """Rewards [..., N, A] of all actions of each agent, where the others act as in the joint actions [..., N] int64."""
    all_alone, all_vectors, alone, vectors = _parts(outputs, actions)
    squares = vectors.square().sum(-1)
    of_others = vectors.sum(-2, keepdim=True) - vectors
    pairs_of_others = _pairs(of_others, squares.sum(-1, keepdim=True) - squares)
    pairs = pairs_of_others.unsqueeze(-1) + (all_vectors * of_others.unsqueeze(-2)).sum(-1)
    return all_alone + (alone.sum(-1, keepdim=True) - alone).unsqueeze(-1) + pairs / actions.shape[-1] ** 2


def _parts(outputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """u [..., N, A] and v [..., N, A, R] of all actions, and of those taken, [..., N] and [..., N, R]."""
    every = outputs.unflatten(-1, (actions.shape[-1], -1, 1 + RANK))
    taken = every.gather(-2, actions[..., None, None].expand(*actions.shape, 1, 1 + RANK)).squeeze(-2)
    return every[..., 0], every[..., 1:], taken[..., 0], taken[..., 1:]


def _pairs(total: Tensor, squares: Tensor) -> Tensor:
    """The sum over all pairs of v_i . v_j, from the sum of v [..., R] and that of their squared lengths [...]."""
    return (total.square().sum(-1) - squares) / 2
