"""Actor, critic and reward network in torch, with the paper's layers and initialisation.

Every network reads sequences: the leading axis is time, and the recurrent state is zeroed where an episode starts. The
rows of a sequence are worlds, or worlds times agents.
"""

from __future__ import annotations

import functools
import math
from typing import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from dae_ros import draws
from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import kernels
from dae_ros.learning.gru import gru_sequence
from dae_ros.learning.kernels import Step
from dae_ros.types import WorldSpec

_ACTIVATIONS = {'identity': lambda x: x, 'relu': torch.relu, 'tanh': torch.tanh}
_GAINS = {'relu': math.sqrt(2), 'tanh': 5 / 3}
_LOOK_UP_BELOW = 0.5  # largest table of everything the others can do, relative to the batch


def layer(linear: nn.Linear | None = None, activation: str = 'identity', norm: nn.LayerNorm | None = None) -> Step:
    """norm(activation(linear(x))); what is None is left out."""
    parameters = (None, None) if linear is None else (linear.weight, linear.bias)
    return Step(activation, parameters + ((None, None) if norm is None else (norm.weight, norm.bias)))


def run(steps: Sequence[Step], x: Tensor, initial: Tensor | None = None,
        episode_start: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
    """`kernels.chain` by the fastest means there are; arguments and result as there."""
    if kernels.usable(x, *(part for step in steps for part in step.parameters if part is not None)):
        return kernels.chain(steps, x, initial, episode_start)
    states = None
    for kind, (first, second, third, fourth) in steps:
        if kind == 'gru':
            x = states = gru_sequence(x, initial, episode_start, first, second, third, fourth)
        else:
            x = _ACTIVATIONS[kind](x if first is None else functional.linear(x, first, second))
            x = x if third is None else functional.layer_norm(x, third.shape, third, fourth)
    return x, states


class Gru(nn.Module):
    """One recurrent layer; its parameters and nothing else."""

    def __init__(self, input_size: int, hidden_size: int):
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden_size, input_size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden_size, hidden_size))
        self.bias_ih = nn.Parameter(torch.empty(3 * hidden_size))
        self.bias_hh = nn.Parameter(torch.empty(3 * hidden_size))

    def step(self) -> Step:
        return Step('gru', (self.weight_ih, self.weight_hh, self.bias_ih, self.bias_hh))


class RecurrentNetwork(nn.Module):
    """LayerNorm, MLP, GRU, LayerNorm, linear head: actor (A outputs) and critic (one output)."""

    def __init__(self, input_size: int, output_size: int, hidden_size: int, mlp_layers: int, activation: str):
        super().__init__()
        self._activation = activation
        self.input_norm = nn.LayerNorm(input_size)
        sizes = [input_size] + [hidden_size] * mlp_layers
        self.mlp = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.mlp_norm = nn.ModuleList(nn.LayerNorm(hidden_size) for _ in range(mlp_layers))
        self.gru = Gru(hidden_size, hidden_size)
        self.gru_norm = nn.LayerNorm(hidden_size)
        self.head = nn.Linear(hidden_size, output_size)

    def forward(self, inputs: Tensor, initial: Tensor, episode_start: Tensor) -> tuple[Tensor, Tensor]:
        """inputs [L, R, I], initial [R, H], episode_start [L, R] bool -> outputs [L, R, K], states [L, R, H]."""
        layers = [layer(linear, self._activation, norm) for linear, norm in zip(self.mlp, self.mlp_norm)]
        steps = [layer(norm=self.input_norm), *layers, self.gru.step(), layer(norm=self.gru_norm), layer(self.head)]
        return run(steps, inputs, initial, episode_start)


@functools.lru_cache(maxsize=8)
def _joint_actions_of_others(num_agents: int, num_actions: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Everything each agent's others can do, as one-hot blocks [N A^(N-1), N A] with the agent's own block zero.

    Agent i's row at the joint action a is sum_j a_j place[i, j] + first[i]; place [N, N], first [N].
    """
    N, A = num_agents, num_actions
    weights = A ** torch.arange(N - 2, -1, -1, device=device)
    digits = torch.arange(A ** (N - 1), device=device).unsqueeze(1) // weights % A
    hot, zero = functional.one_hot(digits, A).float(), torch.zeros(len(digits), 1, A, device=device)
    blocks = [torch.cat([hot[:, :i], zero, hot[:, i:]], 1).flatten(1) for i in range(N)]
    place = [torch.cat([weights[:i], weights.new_zeros(1), weights[i:]]) for i in range(N)]
    return torch.cat(blocks), torch.stack(place), torch.arange(N, device=device) * len(digits)


class PerAgentRewardNetwork(nn.Module):
    """The paper's reward network (section 3.3): r_psi(s, a_-i, .) for every action of agent i, recurrent over a_-i.

    The zeroed block of agent i's own action is the only thing that tells the agents apart, so what depends on the state
    alone is computed once per world, and what depends on the others' actions alone once for all they can do, where that
    is less than the batch (75 rows for three agents with five actions).
    """

    def __init__(self, spec: WorldSpec, hidden_size: int):
        super().__init__()
        self.num_agents, self.num_actions = spec.num_agents, spec.num_actions
        self.action_embedding = nn.Parameter(torch.empty(spec.num_agents * spec.num_actions, hidden_size))
        self.action_bias = nn.Parameter(torch.empty(hidden_size))
        self.state = nn.Linear(spec.state_size, hidden_size)
        self.state_norm = nn.LayerNorm(hidden_size)
        self.joint_action = nn.Linear(hidden_size, hidden_size)
        self.joint_state = nn.Linear(hidden_size, hidden_size, bias=False)
        self.joint_norm = nn.LayerNorm(hidden_size)
        self.gru = Gru(hidden_size, hidden_size)
        self.gru_norm = nn.LayerNorm(hidden_size)
        self.head = nn.Linear(hidden_size, spec.num_actions)

    def forward(self, state: Tensor, actions: Tensor, initial: Tensor, episode_start: Tensor) -> tuple[Tensor, Tensor]:
        """state [L, C, S], actions [L, C, N] int64, initial [C * N, H], episode_start [L, C] bool
        -> predicted rewards [L, C, N, A] for every own action, states [L, C * N, H]."""
        L, C, N = actions.shape
        seen, _ = run([layer(self.state, 'relu', self.state_norm), layer(self.joint_state)], state)
        others, codes = self._others(actions.flatten(0, 1))
        joint = self._joint(run([layer(self.joint_action)], others)[0], codes, seen.flatten(0, 1))
        steps = [self.gru.step(), layer(norm=self.gru_norm), layer(self.head)]
        starts = episode_start.repeat_interleave(N, dim=1)
        predicted, states = run(steps, joint.view(L, C * N, joint.shape[-1]), initial, starts)
        return predicted.view(L, C, N, self.num_actions), states

    def _others(self, actions: Tensor) -> tuple[Tensor, Tensor | None]:
        """First layer over the others' actions [M, N]: rows [K, H], and which of them each agent has [M, N]; None if
        each has a row of its own, in order (K = M N)."""
        N, A = self.num_agents, self.num_actions
        if N * A ** (N - 1) <= _LOOK_UP_BELOW * actions.numel():
            hot, place, first = _joint_actions_of_others(N, A, actions.device)
            weights = self.action_embedding.t()
            rows, _ = run([Step('relu', (weights, self.action_bias, None, None))], hot.to(weights.dtype))
            return rows, (actions.unsqueeze(1) * place).sum(-1) + first
        embedded = functional.embedding(actions + torch.arange(N, device=actions.device) * A, self.action_embedding)
        return torch.relu(embedded.sum(1, keepdim=True) - embedded + self.action_bias).flatten(0, 1), None

    def _joint(self, table: Tensor, codes: Tensor | None, seen: Tensor) -> Tensor:
        """norm(relu(table[codes] + seen)): [M, N, H] for seen [M, H]."""
        norm = self.joint_norm
        if kernels.usable(table, seen, norm.weight):
            return kernels.looked_up(table, codes, seen, norm.weight, norm.bias)
        own = codes is None
        chosen = table.view(len(seen), self.num_agents, table.shape[-1]) if own else functional.embedding(codes, table)
        return norm(torch.relu(chosen + seen.unsqueeze(1)))


def make_actor(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The policy network shared by all agents (algorithm 1, line 11)."""
    actor = RecurrentNetwork(spec.observation_size, spec.num_actions, settings.hidden_size, settings.mlp_layers,
                             settings.activation)
    return _initialise(actor, _GAINS[settings.activation], 0.01, seed, 'actor')


def make_critic(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The central value network on the global state (algorithm 1, line 13)."""
    critic = RecurrentNetwork(spec.state_size, 1, settings.hidden_size, settings.mlp_layers, settings.activation)
    return _initialise(critic, _GAINS[settings.activation], 1.0, seed, 'critic')


def make_reward_network(spec: WorldSpec, settings: RewardNetworkSettings, seed: int,
                        member: int) -> PerAgentRewardNetwork:
    """Member `member` of the reward ensemble (algorithm 1, line 14)."""
    network = PerAgentRewardNetwork(spec, settings.hidden_size)
    return _initialise(network, _GAINS['relu'], 1.0, seed, f'reward_network.{member}')


def _initialise(network: nn.Module, hidden_gain: float, head_gain: float, seed: int, name: str):
    """Orthogonal weights, zero biases, LayerNorms at the identity; drawn by a key of the network's own."""
    generator = torch.Generator().manual_seed(draws.key(seed, f'initialise {name}') % 2**63)
    with torch.no_grad():
        for path, parameter in network.named_parameters():
            if parameter.dim() == 2:
                gain = head_gain if path.startswith('head') else 1.0 if path.startswith('gru') else hidden_gain
                # An embedding is the transpose of a linear layer's weight.
                target = parameter.t() if path == 'action_embedding' else parameter
                target.copy_(nn.init.orthogonal_(torch.empty(target.shape), gain, generator=generator))
            elif 'norm.' not in path or path.endswith('bias'):
                parameter.zero_()
    return network
