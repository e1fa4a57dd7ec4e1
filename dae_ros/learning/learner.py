"""Recurrent MAPPO with Difference Advantage Estimation: one update from one rollout (algorithm 1, lines 19 to 32).

`Learner.update` reads in the paper's order: values, expected rewards, advantages, targets, chunks, epochs. The three
networks never need each other's gradients, so their epochs run side by side.
"""

from __future__ import annotations

from functools import partial
from typing import Mapping, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dae_ros import draws
from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import advantages, losses
from dae_ros.learning.chunks import first_states, shard_bounds, to_chunks
from dae_ros.learning.networks import Network, make_actor, make_critic, make_reward_network
from dae_ros.learning.optimizer import FlatAdam
from dae_ros.learning.parallel import Training, Workers
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.learning.value_norm import ValueNormalizer
from dae_ros.types import Trajectory, WorldSpec


class Chunks(NamedTuple):
    """A rollout cut into C chunks of L steps; also one shard of it, with fewer chunks."""

    observations: Tensor   # [L, C, N, O]
    states: Tensor         # [L, C, 1, S]
    reward_inputs: Tensor  # [L, C, 1, I] what the reward networks read; the states at beta = 0
    episode_start: Tensor  # [L, C] bool
    actions: Tensor        # [L, C, N] int64
    log_probabilities: Tensor  # [L, C, N] of the actions taken, under the acting policy
    advantages: Tensor     # [L, C, N] normalised
    rewards: Tensor        # [L, C]
    values: Tensor         # [L, C] normalised, before the update
    targets: Tensor        # [L, C] normalised
    weights: Tensor        # [L, C] 1, and 0 for filling


class FirstStates(NamedTuple):
    """Recurrent state of every network before its first step of each chunk."""

    actor: Tensor          # [C, N, H]
    critic: Tensor         # [C, 1, H]
    reward: list[Tensor]   # per member of the ensemble [C, N or 1, H']; empty at beta = 0


class Learner:
    """Actor, critic and reward networks of one run, and how they learn."""

    def __init__(self, spec: WorldSpec, settings: LearnerSettings, reward_settings: RewardNetworkSettings, seed: int,
                 team=None, device: torch.device = torch.device('cpu')):
        """`team`: the `distributed.Team` this process learns with, None to learn alone. `device`: where it computes."""
        self._team = team
        self._device = device
        self._spec = spec
        self._settings = settings
        self._reward_settings = reward_settings
        self._seed = seed
        self._workers = Workers(settings.learner_threads)
        self._actor = self._adam(make_actor(spec, settings, seed), settings.learning_rate)
        self._critic = self._adam(make_critic(spec, settings, seed), settings.learning_rate)
        members = reward_settings.ensemble_size if settings.beta > 0 else 0
        self._reward = [self._adam(make_reward_network(spec, reward_settings, seed, member), reward_settings.learning_rate)
                        for member in range(members)]
        self._value_norm = ValueNormalizer()

    def _adam(self, network, learning_rate: float) -> FlatAdam:
        return FlatAdam(network.to(self._device), learning_rate, self._settings.adam_epsilon, self._settings.max_gradient_norm)

    @property
    def policy(self) -> Policy:
        """The decentralised policy as it stands, for acting."""
        settings = self._settings
        architecture = PolicyArchitecture(self._spec.observation_size, self._spec.num_actions, settings.hidden_size,
                                          settings.mlp_layers, settings.activation)
        named = dict(self._actor.network.named_parameters())
        return Policy(architecture, {name: named[name].detach().cpu().numpy().copy() for name in architecture.shapes()})

    def update(self, trajectory: Trajectory, rollout: int) -> dict[str, float]:
        """Learn from one rollout. Returns the metrics of the update, by name."""
        observations, states, episode_start, actions, probabilities, rewards, terminated, truncated, final_states = (
            torch.from_numpy(np.ascontiguousarray(part)).to(self._device) for part in trajectory)
        settings, L = self._settings, min(self._settings.chunk_length, rewards.numel())
        continues = (~(terminated | truncated)).float()
        metrics: dict[str, float] = {}

        # Lines 13 and 14: values and predicted rewards of the networks as they are before the update.
        normalized_values, critic_states, final_values = self._values(states, episode_start, truncated, final_states)
        values = self._value_norm.denormalize(normalized_values)
        next_values = values[1:] * continues
        next_values[truncated] = self._value_norm.denormalize(final_values)
        _, actor_states = self._forward(self._actor.network, self._spec.num_agents, observations, episode_start[:-1])

        # Line 19: advantages.
        team = advantages.generalized_advantages(rewards, values[:-1], next_values, continues, settings.gamma,
                                                 settings.gae_lambda)
        estimated = team.unsqueeze(-1).expand(actions.shape)
        reward_states: list[Tensor] = []
        seen = reward_inputs = states[:-1].unsqueeze(2)
        if settings.beta > 0:
            reward_inputs = self._reward[0].network.inputs(seen, actions, episode_start[:-1])
            predicted, reward_states = self._predicted_rewards(reward_inputs, actions, episode_start[:-1])
            expected = advantages.expected_rewards(predicted, probabilities)
            estimated = estimated - advantages.credit_baselines(expected, continues, settings.beta, settings.gamma,
                                                                settings.gae_lambda)
            taken = predicted.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
            error = (taken - rewards.unsqueeze(-1)).square().mean()
            metrics['reward_network/explained_variance'] = float(1 - error / rewards.var(correction=0).clamp_min(1e-12))

        # Line 20: value targets; the critic sees one state per world, so it regresses on the agents' mean.
        targets = values[:-1] + (estimated.mean(-1) if settings.value_target == 'difference' else team)
        self._value_norm.update(targets)
        metrics['advantage/deviation'] = float(estimated.std(correction=0))

        # Lines 21 to 24: chunks, with the recurrent states they begin with.
        chosen = probabilities.gather(-1, actions.unsqueeze(-1)).squeeze(-1).log()
        weights = torch.full_like(rewards, 1.0)
        cut = partial(to_chunks, length=L)
        chunked = cut(seen)
        chunks = Chunks(cut(observations), chunked, chunked if reward_inputs is seen else cut(reward_inputs),
                        cut(episode_start[:-1]), cut(actions), cut(chosen), cut(advantages.normalized(estimated)), cut(rewards),
                        cut(normalized_values[:-1]), cut(self._value_norm.normalize(targets)), cut(weights))
        first = FirstStates(first_states(actor_states, L), first_states(critic_states[:-1], L),
                            [first_states(member, L) for member in reward_states])

        # Lines 26 to 32: epochs.
        trainings = [self._train_actor(chunks, first, rollout), self._train_critic(chunks, first, rollout)]
        trainings += [self._train_reward(member, chunks, first, rollout) for member in range(len(self._reward))]
        run = self._workers.run if self._team is None else partial(self._workers.run_together, team=self._team)
        for result in run(trainings):
            metrics |= result
        return metrics

    def state(self) -> dict[str, np.ndarray]:
        """Everything the next update depends on, by name; views that change with the next update."""
        tensors = {'value_norm': self._value_norm.state().numpy()}
        for network, adam in self._networks().items():
            tensors |= {f'{network}.{name}': tensor.cpu().numpy() for name, tensor in adam.state().items()}
        return tensors

    def load_state(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Take over what `state` gave; KeyError or RuntimeError if it is another network's."""
        tensors = {name: torch.from_numpy(tensor) for name, tensor in tensors.items()}
        self._value_norm.load_state(tensors['value_norm'])
        for network, adam in self._networks().items():
            prefix = f'{network}.'
            adam.load_state({name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)})

    def close(self) -> None:
        """Ends the learner's threads."""
        self._workers.close()

    def _networks(self) -> dict[str, FlatAdam]:
        members = {f'reward_network.{member}': adam for member, adam in enumerate(self._reward)}
        return {'actor': self._actor, 'critic': self._critic} | members

    # Forward passes over whole sequences.

    def _forward(self, network: Network, rows: int, inputs: Tensor, episode_start: Tensor, actions: Tensor | None = None):
        """The network's outputs and recurrent states over a rollout [T, W, ...], `rows` of these in each world."""
        @torch.no_grad()
        def of_worlds(first: int, last: int) -> tuple[Tensor, Tensor]:
            initial = inputs.new_zeros(last - first, rows, network.hidden_size)
            own = None if actions is None else actions[:, first:last]
            return network(inputs[:, first:last], initial, episode_start[:, first:last], own)

        parts = self._workers.map(partial(of_worlds, *bounds) for bounds in self._bounds(inputs.shape[1], rows, 2))
        return tuple(torch.cat(part, 1) for part in zip(*parts))

    def _values(self, states: Tensor, episode_start: Tensor, truncated: Tensor, final_states: Tensor):
        """Normalised values [T + 1, W], the critic's recurrent states [T + 1, W, 1, H], values [K] of the final states."""
        critic = self._critic.network
        outputs, hidden = self._forward(critic, 1, states.unsqueeze(2), episode_start)
        with torch.no_grad():
            ongoing = torch.zeros(1, len(final_states), dtype=torch.bool, device=self._device)
            final_values = critic(final_states[None, :, None], hidden[:-1][truncated], ongoing)[0].view(-1)
        return outputs.flatten(1), hidden, final_values

    def _predicted_rewards(self, inputs: Tensor, actions: Tensor, episode_start: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The ensemble's mean prediction [T, W, N, A] and each member's recurrent states."""
        members = [adam.network for adam in self._reward]
        joined = [self._forward(member, member.states_per_world(), inputs, episode_start, actions) for member in members]
        return torch.stack([predicted for predicted, _ in joined]).mean(0), [hidden for _, hidden in joined]

    # Epochs. Each training yields the shards of one gradient step and is sent their gradients and loss terms.

    def _train_actor(self, chunks: Chunks, first: FirstStates, rollout: int) -> Training:
        settings, N = self._settings, self._spec.num_agents

        def gradient(shard: Chunks, initial: Tensor) -> tuple[Tensor, Tensor]:
            loss = losses.PolicyLoss(shard.actions, shard.log_probabilities, shard.advantages, shard.weights / N, settings.clip,
                                     settings.entropy_coefficient)
            return self._actor.network.gradient(loss, shard.observations, initial, shard.episode_start)

        return (yield from self._epochs('actor', self._actor, gradient, chunks, first.actor, N, settings.epochs, rollout,
                                        losses.PolicyLoss.sums))

    def _train_critic(self, chunks: Chunks, first: FirstStates, rollout: int) -> Training:
        settings = self._settings

        def gradient(shard: Chunks, initial: Tensor) -> tuple[Tensor, Tensor]:
            loss = losses.ValueLoss(shard.values, shard.targets, shard.weights, settings.clip, settings.huber_delta,
                                    settings.value_coefficient)
            return self._critic.network.gradient(loss, shard.states, initial, shard.episode_start)

        return (yield from self._epochs('critic', self._critic, gradient, chunks, first.critic, 1, settings.epochs, rollout,
                                        losses.ValueLoss.sums))

    def _train_reward(self, member: int, chunks: Chunks, first: FirstStates, rollout: int) -> Training:
        adam, N = self._reward[member], self._spec.num_agents

        def gradient(shard: Chunks, initial: Tensor) -> tuple[Tensor, Tensor]:
            loss = losses.RewardLoss(shard.actions, shard.rewards, shard.weights / N)
            return adam.network.gradient(loss, shard.reward_inputs, initial, shard.episode_start, shard.actions)

        return (yield from self._epochs(f'reward_network.{member}', adam, gradient, chunks, first.reward[member], N,
                                        self._reward_settings.epochs, rollout, losses.RewardLoss.sums))

    def _epochs(self, name: str, adam: FlatAdam, gradient, chunks: Chunks, initial: Tensor, rows_per_chunk: int, epochs: int,
                rollout: int, metric_names: tuple[str, ...]) -> Training:
        """Gradient steps of one network; returns its metrics, averaged over the steps."""
        count, parts = chunks.weights.shape[1], self._settings.num_mini_batches
        whole = self._shards(chunks, initial, rows_per_chunk) if parts == 1 else None
        totals, norms = torch.zeros(len(metric_names), device=self._device), 0.0
        for epoch in range(epochs):
            if whole is not None:
                batches = [whole]
            else:
                order = draws.generator(self._seed, f'mini_batches {name}', rollout, epoch).permutation(count)
                order = torch.from_numpy(order).to(self._device)
                batches = [self._shards(Chunks(*(part[:, chosen] for part in chunks)), initial[chosen], rows_per_chunk)
                           for chosen in order.chunk(parts)]
            for shards in batches:
                answers = yield [partial(gradient, *shard) for shard in shards]
                norms += adam.step(sum(flat for flat, _ in answers))
                totals += sum(terms for _, terms in answers)
        steps = epochs * (1 if whole is not None else len(batches))
        return dict(zip(metric_names, (totals / steps).tolist())) | {f'{name}/gradient_norm': norms / steps}

    def _shards(self, chunks: Chunks, initial: Tensor, rows_per_chunk: int) -> list[tuple[Chunks, Tensor]]:
        """The chunks of one gradient step in shards; their weights add up to one over the step."""
        chunks = chunks._replace(weights=chunks.weights / chunks.weights.sum())
        processes = 1 if self._team is None else self._team.size
        bounds = self._bounds(chunks.weights.shape[1], rows_per_chunk, 2 * processes)
        bounds += [(0, 0)] * (processes - len(bounds))  # for every process something, if only an empty shard
        return [(Chunks(*(part[:, a:b] for part in chunks)), initial[a:b]) for a, b in bounds]

    def _bounds(self, columns: int, rows_per_column: int, at_least: int) -> list[tuple[int, int]]:
        """Shards for the threads; a GPU, which is parallel itself, gets the whole."""
        if self._device.type == 'cuda':
            return [(0, columns)]
        return shard_bounds(columns, rows_per_column, at_least)
