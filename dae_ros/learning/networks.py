"""Actor, critic and reward networks, with the paper's layers and initialisation.

A network is a row of steps (`kernels.Step`), which the compiled kernels and torch both know how to take; torch is the
reference and the fallback. Batches are sequences of L steps: C columns, which are worlds or pieces of their history, of N
agents each. Recurrent states are zeroed where an episode starts.
"""

from __future__ import annotations

import functools
import math
from typing import Callable, Iterable, NamedTuple, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from dae_ros import draws
from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import joint_reward, kernels, losses
from dae_ros.learning.gru import gru_sequence
from dae_ros.learning.kernels import Batch, Step
from dae_ros.types import WorldSpec

_ACTIVATIONS = {'identity': lambda x: x, 'relu': torch.relu, 'tanh': torch.tanh}
_GAINS = {'relu': math.sqrt(2), 'tanh': 5 / 3}
_LOOK_UP_BELOW = 0.5  # largest table of everything the others can do, relative to the batch


class Gru(nn.Module):
    """One recurrent layer; its parameters and nothing else."""

    def __init__(self, input_size: int, hidden_size: int):
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * hidden_size, input_size))
        self.weight_hh = nn.Parameter(torch.empty(3 * hidden_size, hidden_size))
        self.bias_ih = nn.Parameter(torch.empty(3 * hidden_size))
        self.bias_hh = nn.Parameter(torch.empty(3 * hidden_size))


def layer(linear: nn.Linear | None = None, activation: str = 'identity', norm: nn.LayerNorm | None = None) -> Step:
    """norm(activation(linear(x))); what is None is left out."""
    inputs, outputs = norm.normalized_shape * 2 if linear is None else (linear.in_features, linear.out_features)
    parameters = (None, None) if linear is None else (linear.weight, linear.bias)
    return Step('layer', activation, inputs, outputs, parameters + ((None, None) if norm is None else (norm.weight, norm.bias)))


def gru(module: Gru) -> Step:
    """The states of a GRU."""
    return Step('gru', 'identity', module.weight_ih.shape[1], module.weight_hh.shape[1],
                (module.weight_ih, module.weight_hh, module.bias_ih, module.bias_hh))


def fan_out(norm: nn.LayerNorm) -> Step:
    """norm(relu(table[code] + x)): what every agent sees of its column and of the others' actions."""
    width, = norm.normalized_shape
    return Step('fan_out', 'relu', width, width, (None, None, norm.weight, norm.bias))


def run_in_torch(steps: Iterable[Step], batch: Batch) -> tuple[Tensor, Tensor | None]:
    """What `kernels.forward` computes, by torch's own differentiable operations."""
    x, states = batch.inputs, None
    for step in steps:
        first, second, third, fourth = step.parameters
        if step.kind == 'gru':
            L, C, rows, _ = x.shape
            starts = batch.episode_start.repeat_interleave(rows, dim=1)
            x = gru_sequence(x.flatten(1, 2), batch.initial.flatten(0, 1), starts, first, second, third, fourth)
            x = states = x.view(L, C, rows, step.outputs)
            continue
        if step.kind == 'fan_out':
            table = batch.table
            own = batch.codes is None
            chosen = table.view(*x.shape[:2], batch.num_agents, step.outputs) if own else functional.embedding(batch.codes, table)
            x = chosen + x
        x = _ACTIVATIONS[step.activation](x if first is None else functional.linear(x, first, second))
        x = x if third is None else functional.layer_norm(x, third.shape, third, fourth)
    return x, states


class Table(NamedTuple):
    """What a fan-out adds: `Batch.table` and `Batch.codes`, and the way back to the parameters they depend on."""

    rows: Tensor
    codes: Tensor | None
    # From the gradient of `rows`, those of the network's first parameters, by hand: autograd takes three times as long.
    gradient: Callable[[Tensor], Sequence[Tensor]]

    @torch.no_grad()
    def to_parameters(self, flat: Tensor) -> Tensor:
        """The gradient of all parameters, from those of the steps' parameters and, behind them, of `rows`."""
        behind = len(flat) - self.rows.numel()
        parts = [part.reshape(-1) for part in self.gradient(flat[behind:].view_as(self.rows))]
        flat = flat[:behind]
        torch.cat(parts, out=flat[:sum(map(len, parts))])
        return flat


class Network(nn.Module):
    """What all networks share: outputs, and the gradient of a loss of them."""

    hidden_size: int  # of the recurrent state

    def steps(self) -> list[Step]:
        """The network."""
        raise NotImplementedError

    @functools.cached_property
    def _own(self) -> tuple[tuple[Tensor, ...], list[Step]]:
        """Parameters and steps, collected once: a thousand gradients a second need them."""
        return tuple(self.parameters()), self.steps()

    def _table(self, actions: Tensor | None, shared: Table | None) -> Table | None:
        """What a fan-out adds, None if there is none; `shared`: as far as it has been computed."""
        return None

    def forward(self, inputs: Tensor, initial: Tensor, episode_start: Tensor,
                actions: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Outputs [L, C, rows, K] and recurrent states [L, C, rows at the GRU, H] after each step.

        inputs: [L, C, N or 1, I]. initial: [C, rows at the GRU, H]. episode_start: [L, C] bool. actions: [L, C, N] int64,
        for networks that see them. With gradients enabled this is torch; see `gradient`.
        """
        _, steps = self._own
        batch = _batch(inputs, initial, episode_start, actions, self._table(actions, None))
        if kernels.usable(inputs) and not torch.is_grad_enabled():
            return kernels.forward(steps, batch)
        return run_in_torch(steps, batch)

    def gradient(self, loss: losses.Loss, inputs: Tensor, initial: Tensor, episode_start: Tensor,
                 actions: Tensor | None = None, shared: Table | None = None) -> tuple[Tensor, Tensor]:
        """d loss / d parameters as one flat vector, and the sums of the loss; the rest as for `forward`.

        With the table of a larger batch, which is `shared` by its parts, the vector ends with the gradient of its rows;
        those of the parts are added up before `Table.to_parameters`. Leaves no trace on the parameters, so that threads
        may share the network.
        """
        parameters, steps = self._own
        with torch.no_grad():
            table = self._table(actions, shared)
            batch = _batch(inputs, initial, episode_start, actions, table)
            if kernels.usable(inputs):
                flat, sums = kernels.gradient(steps, parameters, batch, loss.terms)
            else:
                flat, sums = _gradient_in_torch(steps, parameters, batch, loss)
            if table is not None and shared is None:
                flat = table.to_parameters(flat)
        return flat, sums[:len(loss.sums)]


def _gradient_in_torch(steps: Iterable[Step], parameters: Sequence[Tensor], batch: Batch,
                       loss: losses.Loss) -> tuple[Tensor, Tensor]:
    """What `kernels.gradient` computes."""
    leaves = list(parameters)
    with torch.enable_grad():
        if batch.table is not None:
            leaves.append(batch.table.detach().requires_grad_())
            batch = batch._replace(table=leaves[-1])
        objective, sums = loss(run_in_torch(steps, batch)[0])
    parts = torch.autograd.grad(objective, leaves, allow_unused=True, materialize_grads=True)
    return torch.cat([part.reshape(-1) for part in parts]), sums


def _batch(inputs: Tensor, initial: Tensor, episode_start: Tensor, actions: Tensor | None, table: Table | None) -> Batch:
    rows, codes = (None, None) if table is None else table[:2]
    return Batch(inputs, initial, episode_start, (inputs if actions is None else actions).shape[2], rows, codes)


class RecurrentNetwork(Network):
    """LayerNorm, MLP, GRU, LayerNorm, linear head: actor (A outputs) and critic (one output)."""

    def __init__(self, input_size: int, output_size: int, hidden_size: int, mlp_layers: int, activation: str):
        super().__init__()
        self.hidden_size = hidden_size
        self._activation = activation
        self.input_norm = nn.LayerNorm(input_size)
        sizes = [input_size] + [hidden_size] * mlp_layers
        self.mlp = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.mlp_norm = nn.ModuleList(nn.LayerNorm(hidden_size) for _ in range(mlp_layers))
        self.gru = Gru(hidden_size, hidden_size)
        self.gru_norm = nn.LayerNorm(hidden_size)
        self.head = nn.Linear(hidden_size, output_size)

    def steps(self) -> list[Step]:
        layers = [layer(linear, self._activation, norm) for linear, norm in zip(self.mlp, self.mlp_norm)]
        return [layer(norm=self.input_norm), *layers, gru(self.gru), layer(norm=self.gru_norm), layer(self.head)]


@functools.lru_cache(maxsize=8)
def _joint_actions_of_others(num_agents: int, num_actions: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Everything each agent's others can do, as one-hot blocks [N A^(N-1), N A] with the agent's own block zero.

    Agent i's row at the joint action a is sum_j a_j place[j, i] + first[i]; place [N, N] float, first [N].
    """
    N, A = num_agents, num_actions
    weights = A ** torch.arange(N - 2, -1, -1, device=device)
    digits = torch.arange(A ** (N - 1), device=device).unsqueeze(1) // weights % A
    hot, zero = functional.one_hot(digits, A).float(), torch.zeros(len(digits), 1, A, device=device)
    blocks = [torch.cat([hot[:, :i], zero, hot[:, i:]], 1).flatten(1) for i in range(N)]
    place = [torch.cat([weights[:i], weights.new_zeros(1), weights[i:]]) for i in range(N)]
    return torch.cat(blocks), torch.stack(place, 1).float(), torch.arange(N, device=device) * len(digits)


def _of_others(x: Tensor) -> Tensor:
    """Sums over the other agents [L C N, H], for x [L, C, N, H]."""
    return (x.sum(-2, keepdim=True) - x).flatten(0, 2)


class RewardNetwork(Network):
    """r_psi(s, a_-i, .): for every agent the shared reward for each action of its own (paper, section 3.3)."""

    head_gain = 1.0

    def __init__(self, spec: WorldSpec):
        super().__init__()
        self.num_agents, self.num_actions = spec.num_agents, spec.num_actions

    def inputs(self, states: Tensor, actions: Tensor, episode_start: Tensor) -> Tensor:
        """What the network reads of a rollout [T, W, 1, I]: states [T, W, 1, S], actions [T, W, N], episode_start [T, W]."""
        raise NotImplementedError

    def states_per_world(self) -> int:
        """Recurrent states per world: N or 1."""
        raise NotImplementedError

    def loss(self, actions: Tensor, rewards: Tensor, weights: Tensor) -> losses.Loss:
        """Of the outputs `gradient` differentiates: actions [L, C, N], rewards [L, C], weights [L, C, N]."""
        raise NotImplementedError

    def begin(self) -> None:
        """Changes what is to begin otherwise than all networks do."""

    def take_scale(self, rewards: Tensor) -> None:
        """Lets a network that learns in units of its own take them from the first rewards it learns from, of any shape."""

    def shared_table(self, actions: Tensor) -> Table | None:
        """What the parts of a batch with actions [L, C, N] can share; None if there is nothing."""
        return None


class PerAgentRewardNetwork(RewardNetwork):
    """The paper's: recurrent over the state and a_-i, one sequence per agent.

    The zeroed block of agent i's own action is the only thing that tells the agents apart, so what depends on the others'
    actions alone is computed once a gradient step for all they can do, where that is less than half of what they did (75
    rows for three agents with five actions).
    """

    def __init__(self, spec: WorldSpec, settings: RewardNetworkSettings):
        super().__init__(spec)
        hidden_size = self.hidden_size = settings.hidden_size
        self.action_embedding = nn.Parameter(torch.empty(spec.num_agents * spec.num_actions, hidden_size))
        self.action_bias = nn.Parameter(torch.empty(hidden_size))
        self.joint_action = nn.Linear(hidden_size, hidden_size)
        self.state = nn.Linear(spec.state_size, hidden_size)
        self.state_norm = nn.LayerNorm(hidden_size)
        self.joint_state = nn.Linear(hidden_size, hidden_size, bias=False)
        self.joint_norm = nn.LayerNorm(hidden_size)
        self.gru = Gru(hidden_size, hidden_size)
        self.gru_norm = nn.LayerNorm(hidden_size)
        self.head = nn.Linear(hidden_size, spec.num_actions)

    def inputs(self, states: Tensor, actions: Tensor, episode_start: Tensor) -> Tensor:
        return states

    def states_per_world(self) -> int:
        return self.num_agents

    def loss(self, actions: Tensor, rewards: Tensor, weights: Tensor) -> losses.Loss:
        return losses.RewardLoss(actions, rewards, weights)

    def steps(self) -> list[Step]:
        return [layer(self.state, 'relu', self.state_norm), layer(self.joint_state), fan_out(self.joint_norm),
                gru(self.gru), layer(norm=self.gru_norm), layer(self.head)]

    def shared_table(self, actions: Tensor) -> Table | None:
        """joint_action(relu(embedding)) of everything the others can do. None if that is more than half of what they did."""
        N, A = self.num_agents, self.num_actions
        if N * A ** (N - 1) > _LOOK_UP_BELOW * actions.numel():
            return None
        hot = _joint_actions_of_others(N, A, actions.device)[0].to(self.action_bias.dtype)
        return self._table_of(torch.addmm(self.action_bias, hot, self.action_embedding), lambda grad: hot.t() @ grad)

    def _table(self, actions: Tensor, shared: Table | None) -> Table:
        N, A = self.num_agents, self.num_actions
        table = shared or self.shared_table(actions)
        if table is not None:
            _, place, first = _joint_actions_of_others(N, A, actions.device)
            return table._replace(codes=(actions.float() @ place).long() + first)
        taken = actions + torch.arange(N, device=actions.device) * A

        def to_embedding(grad: Tensor) -> Tensor:
            to_each = _of_others(grad.view(*taken.shape, grad.shape[-1]))
            return torch.zeros_like(self.action_embedding).index_add_(0, taken.flatten(), to_each)

        others = _of_others(functional.embedding(taken, self.action_embedding))
        return self._table_of(others + self.action_bias, to_embedding)

    def _table_of(self, others: Tensor, to_embedding: Callable[[Tensor], Tensor]) -> Table:
        """joint_action(relu(others)), the others' embedding and the bias; `to_embedding` takes the gradient of `others` back."""
        hidden = torch.relu(others)

        def gradient(grad: Tensor) -> Sequence[Tensor]:
            to_hidden = torch.ops.aten.threshold_backward(grad @ self.joint_action.weight, hidden, 0)  # relu's
            return to_embedding(to_hidden), to_hidden.sum(0), grad.t() @ hidden, grad.sum(0)

        return Table(self.joint_action(hidden), None, gradient)


class SharedTrunkRewardNetwork(RewardNetwork):
    """One recurrent pass per world over states and all agents' earlier actions, which tells what each action of each agent
    adds to the reward there, by itself and together with each other agent's (see `joint_reward`).

    It sees more than the paper's, which never shows an agent its own earlier actions: where one of these is paid late, it knows,
    and leaves it no credit. It learns what one action does whatever the others do, which the paper's has to find out for every
    a_-i. It learns in units of the deviation of the first rewards from their mean; until it has seen any it predicts 0. Earlier
    actions count for nothing at first: where a reward does not depend on them, they are so many numbers to be misled by.
    """

    head_gain = 0.1

    def __init__(self, spec: WorldSpec, settings: RewardNetworkSettings):
        super().__init__(spec)
        trunk_size = self.hidden_size = settings.trunk_size
        self.trunk = nn.Linear(spec.state_size + spec.num_agents * spec.num_actions, trunk_size)
        self.trunk_norm = nn.LayerNorm(trunk_size)
        self.gru = Gru(trunk_size, trunk_size)
        self.gru_norm = nn.LayerNorm(trunk_size)
        self.hidden = nn.Linear(trunk_size, settings.hidden_size)
        self.hidden_norm = nn.LayerNorm(settings.hidden_size)
        self.head = nn.Linear(settings.hidden_size, joint_reward.size(spec.num_agents, spec.num_actions))
        self.scale = nn.Parameter(torch.empty(2))  # mean and deviation; no loss changes them

    def forward(self, inputs: Tensor, initial: Tensor, episode_start: Tensor,
                actions: Tensor | None = None) -> tuple[Tensor, Tensor]:
        outputs, states = super().forward(inputs, initial, episode_start, actions)
        mean, deviation = self.scale
        return mean + deviation * joint_reward.of_own_actions(outputs.squeeze(-2), actions), states

    def inputs(self, states: Tensor, actions: Tensor, episode_start: Tensor) -> Tensor:
        taken = functional.one_hot(actions, self.num_actions).flatten(2).to(states.dtype)
        before = torch.cat([torch.zeros_like(taken[:1]), taken[:-1]]) * ~episode_start.unsqueeze(-1)
        return torch.cat([states, before.unsqueeze(2)], -1)

    def states_per_world(self) -> int:
        return 1

    def loss(self, actions: Tensor, rewards: Tensor, weights: Tensor) -> losses.Loss:
        return losses.JointRewardLoss(actions, rewards, weights, *self.scale.tolist())

    @torch.no_grad()
    def take_scale(self, rewards: Tensor) -> None:
        if not self.scale[1]:
            deviation = rewards.std(correction=0)
            self.scale.copy_(torch.stack([rewards.mean(), torch.where(deviation > 0, deviation, 1)]))

    @torch.no_grad()
    def begin(self) -> None:
        self.trunk.weight[:, -self.num_agents * self.num_actions:] = 0

    def steps(self) -> list[Step]:
        return [layer(self.trunk, 'relu', self.trunk_norm), gru(self.gru), layer(norm=self.gru_norm),
                layer(self.hidden, 'relu', self.hidden_norm), layer(self.head)]


REWARD_NETWORKS = {'per_agent': PerAgentRewardNetwork, 'shared_trunk': SharedTrunkRewardNetwork}


def make_actor(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The policy network shared by all agents (algorithm 1, line 11)."""
    actor = RecurrentNetwork(spec.observation_size, spec.num_actions, settings.hidden_size, settings.mlp_layers,
                             settings.activation)
    return _initialise(actor, _GAINS[settings.activation], 0.01, seed, 'actor')


def make_critic(spec: WorldSpec, settings: LearnerSettings, seed: int) -> RecurrentNetwork:
    """The central value network on the global state (algorithm 1, line 13), or on each agent's own."""
    critic = RecurrentNetwork(spec.state_size // spec.num_values, 1, settings.hidden_size, settings.mlp_layers,
                              settings.activation)
    return _initialise(critic, _GAINS[settings.activation], 1.0, seed, 'critic')


def make_reward_network(spec: WorldSpec, settings: RewardNetworkSettings, seed: int, member: int) -> RewardNetwork:
    """Member `member` of the reward ensemble (algorithm 1, line 14)."""
    return _make_action_network(spec, settings, seed, f'reward_network.{member}')


def make_action_value_network(spec: WorldSpec, settings: RewardNetworkSettings, seed: int) -> RewardNetwork:
    """Q(s, a_-i, .) of COMA, built like the reward network."""
    return _make_action_network(spec, settings, seed, 'action_value')


def _make_action_network(spec: WorldSpec, settings: RewardNetworkSettings, seed: int, name: str) -> RewardNetwork:
    network = REWARD_NETWORKS[settings.architecture](spec, settings)
    _initialise(network, _GAINS['relu'], network.head_gain, seed, name)
    network.begin()
    return network


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
