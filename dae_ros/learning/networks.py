"""Actor, critic and reward network in torch, with the paper's layers and initialisation.

Every network reads sequences: the leading axis is time, and the recurrent state is zeroed where an episode starts. The
rows of a sequence are worlds, or worlds times agents.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from dae_ros import draws
from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import kernels
from dae_ros.learning.gru import gru_sequence
from dae_ros.types import WorldSpec

_ACTIVATIONS = {'identity': lambda x: x, 'relu': torch.relu, 'tanh': torch.tanh}
_GAINS = {'relu': math.sqrt(2), 'tanh': 5 / 3}


def _layer(x: Tensor, linear: nn.Linear | None = None, activation: str = 'identity', norm: nn.LayerNorm | None = None) -> Tensor:
    """norm(activation(linear(x))); what is None is left out."""
    weight, bias = (None, None) if linear is None else (linear.weight, linear.bias)
    scale, shift = (None, None) if norm is None else (norm.weight, norm.bias)
    if kernels.usable(*(part for part in (x, weight, bias, scale, shift) if part is not None)):
        return kernels.layer(x, weight, bias, activation, scale, shift)
    x = _ACTIVATIONS[activation](x if linear is None else linear(x))
    return x if norm is None else norm(x)


class Gru(nn.Module):
    """One recurrent layer; its parameters and nothing else."""

    def __init__(self, input_size: int, hidden_size: int):
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden_size, input_size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden_size, hidden_size))
        self.bias_ih = nn.Parameter(torch.empty(3 * hidden_size))
        self.bias_hh = nn.Parameter(torch.empty(3 * hidden_size))

    def forward(self, inputs: Tensor, initial: Tensor, episode_start: Tensor) -> Tensor:
        return gru_sequence(inputs, initial, episode_start, self.weight_ih, self.weight_hh, self.bias_ih, self.bias_hh)


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
        x = _layer(inputs, norm=self.input_norm)
        for linear, norm in zip(self.mlp, self.mlp_norm):
            x = _layer(x, linear, self._activation, norm)
        states = self.gru(x, initial, episode_start)
        return _layer(_layer(states, norm=self.gru_norm), self.head), states


class PerAgentRewardNetwork(nn.Module):
    """The paper's reward network (section 3.3): r_psi(s, a_-i, .) for every action of agent i, recurrent over a_-i.

    The zeroed block of agent i's own action is the only thing that tells the agents apart, so what depends on the state
    alone is computed once per world.
    """

    def __init__(self, spec: WorldSpec, hidden_size: int):
        super().__init__()
        self.num_actions = spec.num_actions
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
        blocks = torch.arange(N, device=actions.device) * self.num_actions
        embedded = functional.embedding(actions + blocks, self.action_embedding)
        others = torch.relu(embedded.sum(2, keepdim=True) - embedded + self.action_bias)
        seen = _layer(state, self.state, 'relu', self.state_norm)
        joint = _layer(_layer(others, self.joint_action) + self.joint_state(seen).unsqueeze(2), None, 'relu', self.joint_norm)
        states = self.gru(joint.view(L, C * N, -1), initial, episode_start.repeat_interleave(N, dim=1))
        return _layer(_layer(states, norm=self.gru_norm), self.head).view(L, C, N, -1), states


def make_actor(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The policy network shared by all agents (algorithm 1, line 11)."""
    actor = RecurrentNetwork(spec.observation_size, spec.num_actions, settings.hidden_size, settings.mlp_layers,
                             settings.activation)
    return _initialise(actor, _GAINS[settings.activation], 0.01, seed, 'actor')


def make_critic(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The central value network on the global state (algorithm 1, line 13)."""
    critic = RecurrentNetwork(spec.state_size, 1, settings.hidden_size, settings.mlp_layers, settings.activation)
    return _initialise(critic, _GAINS[settings.activation], 1.0, seed, 'critic')


def make_reward_network(spec: WorldSpec, settings: RewardNetworkSettings, seed: int, member: int) -> PerAgentRewardNetwork:
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
