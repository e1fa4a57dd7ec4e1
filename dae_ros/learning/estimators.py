"""Advantage estimators with the networks they learn: DAE, of which GAE is a case, and COMA's counterfactual advantages.

An estimator is given a rollout as a `Trajectory` of tensors and answers with everybody's advantages and with the trainings
of its networks on that rollout. The actor's training is the same whatever the estimator.
"""

from __future__ import annotations

from functools import partial
from typing import Callable, Iterable, Mapping, NamedTuple, Sequence

import numpy as np
import torch
from torch import Tensor

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning import advantages, losses
from dae_ros.learning.chunks import ActionChunks, ValueChunks, agent_weights, first_states, to_chunks
from dae_ros.learning.networks import RewardNetwork, Table, make_action_value_network, make_critic, make_reward_network
from dae_ros.learning.optimizer import FlatAdam
from dae_ros.learning.parallel import Training
from dae_ros.learning.passes import Batch, Passes
from dae_ros.learning.reward_replay import RewardReplay
from dae_ros.learning.value_norm import ValueNormalizer
from dae_ros.types import Trajectory, WorldSpec

ExpectedRewards = Callable[[Trajectory], np.ndarray]  # E over a_i ~ pi_i of the reward in a rollout, [T, W, N]


class Estimate(NamedTuple):
    """What an estimator makes of a rollout."""

    advantages: Tensor          # [T, W, N], not normalised
    trainings: list[Training]   # of its networks
    metrics: dict[str, float]
    expected: Tensor | None     # E over a_i ~ pi_i of the reward, [T, W, N]; None without a reward network


class ActionNetwork:
    """A network f(s, a_-i, .) with a number for every action of an agent, and how it learns that of the action taken."""

    def __init__(self, name: str, network: RewardNetwork, learning_rate: float, settings: LearnerSettings, passes: Passes):
        self.name = name
        self.adam = FlatAdam(network.to(passes.device), learning_rate, settings.adam_epsilon, settings.max_gradient_norm)
        self._passes = passes

    def inputs(self, data: Trajectory) -> Tensor:
        """What it reads of a rollout, [T, W, 1, I]; the same for networks of the same architecture."""
        return self.adam.network.inputs(data.states[:-1].unsqueeze(2), data.actions, data.episode_start[:-1])

    def predict(self, inputs: Tensor, data: Trajectory) -> tuple[Tensor, Tensor]:
        """Predictions [T, W, N, A] and recurrent states [T, W, N or 1, H]."""
        network = self.adam.network
        return self._passes.forward(network, network.states_per_world(), inputs, data.episode_start[:-1], data.actions)

    def take_scale(self, targets: Tensor) -> None:
        """To be told the first numbers it is to learn, of any shape, before it learns them."""
        self.adam.network.take_scale(targets)

    def training(self, batches: Iterable[Batch], loss_name: str) -> Training:
        """Gradient steps of half the squared error on batches of `ActionChunks`."""
        network = self.adam.network

        def gradient(shard: ActionChunks, initial: Tensor, shared: Table | None = None) -> tuple[Tensor, Tensor]:
            loss = network.loss(shard.actions, shard.targets, shard.weights)
            return network.gradient(loss, shard.inputs, initial, shard.episode_start, shard.actions, shared)

        @torch.no_grad()
        def shared(chunks: ActionChunks) -> Table | None:
            return network.shared_table(chunks.actions)

        return self._passes.train(self.name, self.adam, gradient, batches, network.states_per_world(), (loss_name,), shared)


def ensemble_prediction(members: Sequence[ActionNetwork], data: Trajectory) -> tuple[Tensor, Tensor, list[Tensor]]:
    """The networks' mean prediction [T, W, N, A], what it is made from, and each member's recurrent states."""
    inputs = members[0].inputs(data)
    predictions = [member.predict(inputs, data) for member in members]
    return torch.stack([predicted for predicted, _ in predictions]).mean(0), inputs, [states for _, states in predictions]


class DifferenceEstimator:
    """DAE (section 3.3): GAE of a central critic, less what each agent's reward was to be expected without knowing its action.

    At beta = 0 it is GAE, has no reward network and is plain MAPPO. Nor has it one where `exact_rewards` tells E[r].
    """

    def __init__(self, spec: WorldSpec, settings: LearnerSettings, reward_settings: RewardNetworkSettings, seed: int,
                 passes: Passes, exact_rewards: ExpectedRewards | None = None):
        self._settings = settings
        self._num_values = spec.num_values
        self._exact_rewards = exact_rewards
        self._reward_settings = reward_settings
        self._passes = passes
        self._critic = FlatAdam(make_critic(spec, settings, seed).to(passes.device), settings.learning_rate,
                                settings.adam_epsilon, settings.max_gradient_norm)
        self._value_norm = ValueNormalizer()
        self._reward = [ActionNetwork(f'reward_network.{member}', make_reward_network(spec, reward_settings, seed, member),
                                      reward_settings.learning_rate, settings, passes)
                        for member in range(reward_settings.ensemble_size if settings.beta > 0 and not exact_rewards else 0)]
        replays = self._reward and reward_settings.replay_rollouts and not reward_settings.freeze
        self._replay = RewardReplay(reward_settings, seed) if replays else None

    def estimate(self, data: Trajectory, rollout: int) -> Estimate:
        """Advantages (algorithm 1, line 19), and the trainings of critic and reward networks on the rollout."""
        settings, trainings, metrics = self._settings, [], {}
        continues = (~(data.terminated | data.truncated)).float()

        # Line 13: values, by the critic as it is before the update, one for the team or one for each agent.
        valued = self._valued(data.states)
        normalized_values, critic_states, final_values = self._values(data, valued)
        values, final_values = map(self._value_norm.denormalize, (normalized_values, final_values))
        of_each = self._num_values > 1
        if of_each and data.present is not None:
            values, final_values = self._without_absent(values, final_values, data)
        goes_on = continues.unsqueeze(-1)
        next_values = values[1:] * goes_on
        next_values[data.truncated] = final_values
        shared = advantages.generalized_advantages(data.rewards.unsqueeze(-1), values[:-1], next_values, goes_on, settings.gamma,
                                                   settings.gae_lambda)
        expected = None
        if self._exact_rewards is not None:
            expected = torch.from_numpy(self._exact_rewards(data.map(lambda part: part.cpu().numpy()))).to(shared)
        elif self._reward:
            expected, trainings, metrics = self._learnt_expectations(data, rollout)
        estimated = shared.expand(data.actions.shape)
        if expected is not None:
            estimated = estimated - advantages.credit_baselines(expected, continues, settings.beta, settings.gamma,
                                                                settings.gae_lambda)

        # Line 20: value targets; where the critic sees one state per world, it regresses on the agents' mean.
        credited = estimated if of_each else advantages.mean_over_agents(estimated, data.present).unsqueeze(-1)
        targets = values[:-1] + (credited if settings.value_target == 'difference' else shared)
        self._value_norm.update(advantages.among(targets, data.present if of_each else None))
        cut = partial(to_chunks, length=chunk_length(data, settings))
        chunks = ValueChunks(cut(valued[:-1]), cut(data.episode_start[:-1]), cut(normalized_values[:-1]),
                             cut(self._value_norm.normalize(targets)),
                             cut(agent_weights(data) if of_each else torch.ones_like(targets)))
        first = first_states(critic_states[:-1], chunks.weights.shape[0])
        return Estimate(estimated, [self._critic_training(chunks, first, rollout), *trainings], metrics, expected)

    def expected_rewards(self, data: Trajectory) -> Tensor:
        """E over a_i ~ pi_i of the predicted reward, [T, W, N]. Raises ValueError at beta = 0, which has no reward network."""
        if not self._reward:
            raise ValueError('at beta = 0 there is no reward network')
        predicted, _, _ = ensemble_prediction(self._reward, as_remembered(data, self._reward_settings))
        return self._expected(predicted, data)

    def begin_with(self, reward_networks: list[dict[str, Tensor]]) -> None:
        """Takes over the parameters of reward networks that were trained before, one for each member."""
        for member, parameters in zip(self._reward, reward_networks):
            member.adam.load_state(member.adam.state() | parameters)

    def networks(self) -> dict[str, FlatAdam]:
        return {'critic': self._critic} | {member.name: member.adam for member in self._reward}

    def state(self) -> dict[str, Tensor]:
        """All but the networks."""
        return {'value_norm': self._value_norm.state()} | (self._replay.state() if self._replay else {})

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        self._value_norm.load_state(tensors['value_norm'])
        if self._replay:
            self._replay.load_state(tensors)

    def _learnt_expectations(self, data: Trajectory, rollout: int) -> tuple[Tensor, list[Training], dict[str, float]]:
        """What the reward networks expect [T, W, N], their trainings on the rollout that are still to be run, and metrics."""
        remembered = as_remembered(data, self._reward_settings)
        predicted, inputs, states = ensemble_prediction(self._reward, remembered)
        taken = advantages.of_actions(predicted, data.actions)
        error = advantages.among((taken - data.rewards.unsqueeze(-1)).square(), data.present).mean()
        metrics = {'reward_network/explained_variance': float(1 - error / data.rewards.var(correction=0).clamp_min(1e-12))}
        trainings = [] if self._reward_settings.freeze else self._reward_trainings(remembered, inputs, states, rollout)
        if trainings and self._reward_settings.learns_first:
            metrics |= self._passes.run(trainings)
            return self.expected_rewards(data), [], metrics
        return self._expected(predicted, data), trainings, metrics

    def _expected(self, predicted: Tensor, data: Trajectory) -> Tensor:
        """E over a_i ~ pi_i of what was predicted, [T, W, N]. Of an agent that has left, which had no choice, all that came
        was to be expected."""
        expected = advantages.expected_rewards(predicted, data.probabilities)
        return expected if data.present is None else torch.where(data.present, expected, data.rewards.unsqueeze(-1))

    def _valued(self, states: Tensor) -> Tensor:
        """[..., V, S / V] of states [..., S]: what is valued, the state of all agents together (V = 1) or of each (V = N)."""
        return states.unflatten(-1, (self._num_values, -1))

    def _values(self, data: Trajectory, valued: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Normalised values [T + 1, W, V], recurrent states [T + 1, W, V, H], values [K, V] of the final states."""
        critic = self._critic.network
        outputs, hidden = self._passes.forward(critic, self._num_values, valued, data.episode_start)
        with torch.no_grad():
            ongoing = torch.zeros(1, len(data.final_states), dtype=torch.bool, device=outputs.device)
            final_values = critic(self._valued(data.final_states)[None], hidden[:-1][data.truncated], ongoing)[0][0, ..., 0]
        return outputs.squeeze(-1), hidden, final_values

    @staticmethod
    def _without_absent(values: Tensor, final_values: Tensor, data: Trajectory) -> tuple[Tensor, Tensor]:
        """Values [T + 1, W, N] and [K, N] in which one that has left, whose own state says nothing, is worth what those are on
        average who are there."""
        there = torch.cat([data.present, data.present[-1:] | data.episode_start[-1:, :, None]])
        return tuple(torch.where(here, found, advantages.mean_over_agents(found, here).unsqueeze(-1))
                     for found, here in ((values, there), (final_values, data.present[data.truncated])))

    def _critic_training(self, chunks: ValueChunks, first: Tensor, rollout: int) -> Training:
        settings, network = self._settings, self._critic.network

        def gradient(shard: ValueChunks, initial: Tensor) -> tuple[Tensor, Tensor]:
            loss = losses.ValueLoss(shard.values, shard.targets, shard.weights, settings.clip, settings.huber_delta,
                                    settings.value_coefficient)
            return network.gradient(loss, shard.states, initial, shard.episode_start)

        batches = self._passes.epochs('critic', chunks, first, settings.epochs, settings.num_mini_batches, rollout)
        return self._passes.train('critic', self._critic, gradient, batches, self._num_values, losses.ValueLoss.sums)

    def _reward_trainings(self, data: Trajectory, inputs: Tensor, states: list[Tensor], rollout: int) -> list[Training]:
        chunks = action_chunks(data, inputs, data.rewards, self._settings)
        firsts = [first_states(own, len(chunks.weights)) for own in states]
        if self._replay:
            self._replay.add(chunks, firsts)
        trainings = []
        for member, (network, first) in enumerate(zip(self._reward, firsts)):
            network.take_scale(data.rewards)
            if self._replay:
                batches = self._replay.batches(member, rollout)
            else:
                batches = self._passes.epochs(network.name, chunks, first, self._reward_settings.epochs,
                                              self._settings.num_mini_batches, rollout)
            trainings.append(network.training(batches, 'reward_network/loss'))
        return trainings


class CounterfactualEstimator:
    """COMA on MAPPO: Q less its average over the agent's own action (eq. 3), with Q optionally expanded by n rewards (eq. 41).

    Q has the reward network's architecture and settings and regresses on lambda returns, the agents' mean of them, in the
    scale of a running normaliser. There is no critic V.
    """

    def __init__(self, spec: WorldSpec, settings: LearnerSettings, network_settings: RewardNetworkSettings, seed: int,
                 passes: Passes):
        self._settings = settings
        self._epochs = network_settings.epochs
        self._num_rewards = settings.coma_steps if settings.estimator == 'coma_nstep' else 0
        self._passes = passes
        self._action_value = ActionNetwork('action_value', make_action_value_network(spec, network_settings, seed),
                                           network_settings.learning_rate, settings, passes)
        self._value_norm = ValueNormalizer()

    def estimate(self, data: Trajectory, rollout: int) -> Estimate:
        """Counterfactual advantages, and the training of Q on the rollout."""
        settings, network = self._settings, self._action_value
        continues = (~(data.terminated | data.truncated)).float()
        # Where the next joint action is unknown, Q of the last one taken stands for all that follows.
        cut_off = data.truncated.clone()
        cut_off[-1] = ~data.terminated[-1]

        inputs = network.inputs(data)
        normalized, states = network.predict(inputs, data)
        values = self._value_norm.denormalize(normalized)
        taken = advantages.of_actions(values, data.actions)
        of_team = advantages.mean_over_agents(taken, data.present)
        if data.present is not None:  # of agents that have left it is not learnt
            taken = torch.where(data.present, taken, of_team.unsqueeze(-1))
        later = advantages.n_step_returns(data.rewards, taken, continues, cut_off, settings.gamma, self._num_rewards)
        estimated = later - advantages.expected_rewards(values, data.probabilities)

        targets = advantages.lambda_returns(data.rewards, of_team, continues, cut_off, settings.gamma, settings.gae_lambda)
        explained = 1 - (of_team - targets).square().mean() / targets.var(correction=0).clamp_min(1e-12)
        self._value_norm.update(targets)
        targets = self._value_norm.normalize(targets)
        network.take_scale(targets)
        chunks = action_chunks(data, inputs, targets, settings)
        batches = self._passes.epochs(network.name, chunks, first_states(states, len(chunks.weights)), self._epochs,
                                      settings.num_mini_batches, rollout)
        return Estimate(estimated, [network.training(batches, 'action_value/loss')],
                        {'action_value/explained_variance': float(explained)}, None)

    def networks(self) -> dict[str, FlatAdam]:
        return {self._action_value.name: self._action_value.adam}

    def state(self) -> dict[str, Tensor]:
        """All but the network."""
        return {'value_norm': self._value_norm.state()}

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        self._value_norm.load_state(tensors['value_norm'])


ESTIMATORS = {'dae': DifferenceEstimator, 'coma': CounterfactualEstimator, 'coma_nstep': CounterfactualEstimator}


def as_remembered(data: Trajectory, settings: RewardNetworkSettings) -> Trajectory:
    """The rollout as far as reward networks remember it: without memory, every step begins an episode."""
    return data if settings.recurrent else data._replace(episode_start=torch.ones_like(data.episode_start))


def chunk_length(data: Trajectory, settings: LearnerSettings) -> int:
    """Steps of a chunk: no more than the rollout has."""
    return min(settings.chunk_length, data.rewards.numel())


def action_chunks(data: Trajectory, inputs: Tensor, targets: Tensor, settings: LearnerSettings) -> ActionChunks:
    """A rollout cut up for an `ActionNetwork`."""
    cut = partial(to_chunks, length=chunk_length(data, settings))
    return ActionChunks(cut(inputs), cut(data.episode_start[:-1]), cut(data.actions), cut(targets),
                        cut(agent_weights(data)))
