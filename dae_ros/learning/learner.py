"""Recurrent MAPPO with Difference Advantage Estimation: one update from one rollout (algorithm 1, lines 19 to 32).

The estimator says how good each agent's actions were and what its own networks learn; the actor learns from that. Networks
never need each other's gradients, so their epochs run side by side.
"""

from __future__ import annotations

from functools import partial
from typing import Mapping

import numpy as np
import torch
from torch import Tensor

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.errors import SettingsError
from dae_ros.learning import advantages, losses
from dae_ros.learning.chunks import PolicyChunks, agent_weights, first_states, to_chunks
from dae_ros.learning.credit import Credit, credit_of_world
from dae_ros.learning.estimators import ESTIMATORS, DifferenceEstimator, ExpectedRewards, chunk_length
from dae_ros.learning.networks import make_actor
from dae_ros.learning.optimizer import FlatAdam
from dae_ros.learning.parallel import Training
from dae_ros.learning.passes import Passes
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.types import Trajectory, WorldSpec


class Learner:
    """Actor, estimator and how they learn in one run."""

    def __init__(self, spec: WorldSpec, settings: LearnerSettings, reward_settings: RewardNetworkSettings, seed: int,
                 team=None, device: torch.device = torch.device('cpu'), exact_rewards: ExpectedRewards | None = None):
        """`team`: the `distributed.Team` this process learns with, None to learn alone. `device`: where it computes.
        `exact_rewards`: tells DAE the truth about E[r], in place of reward networks; for studies in simulators."""
        self._spec = spec
        self.watched_world: int | None = None  # whose credit is kept
        self.credit: Credit | None = None      # there, in the last rollout learnt from
        self._settings = settings
        self._passes = Passes(settings.learner_threads, seed, device, team)
        self._actor = FlatAdam(make_actor(spec, settings, seed).to(device), settings.learning_rate, settings.adam_epsilon,
                               settings.max_gradient_norm)
        told = {} if exact_rewards is None else {'exact_rewards': exact_rewards}
        self._estimator = ESTIMATORS[settings.estimator](spec, settings, reward_settings, seed, self._passes, **told)

    @property
    def policy(self) -> Policy:
        """The decentralised policy as it stands, for acting."""
        settings = self._settings
        architecture = PolicyArchitecture(self._spec.observation_size, self._spec.num_actions, settings.hidden_size,
                                          settings.mlp_layers, settings.activation)
        named = dict(self._actor.network.named_parameters())
        return Policy(architecture, {name: named[name].detach().cpu().numpy() for name in architecture.shapes()})

    def update(self, trajectory: Trajectory, rollout: int) -> dict[str, float]:
        """Learn from one rollout. Returns the metrics of the update, by name."""
        data = self._tensors(trajectory)
        _, actor_states = self._passes.forward(self._actor.network, self._spec.num_agents, data.observations,
                                               data.episode_start[:-1])
        estimated, trainings, metrics, expected = self._estimator.estimate(data, rollout)
        if self.watched_world is not None:
            self.credit = credit_of_world(self.watched_world, data.rewards, expected, estimated)
        metrics['advantage/deviation'] = float(advantages.among(estimated, data.present).std(correction=0))

        # Lines 21 to 24: chunks, with the recurrent states they begin with.
        cut = partial(to_chunks, length=chunk_length(data, self._settings))
        chunks = PolicyChunks(cut(data.observations), cut(data.episode_start[:-1]), cut(data.actions),
                              cut(advantages.of_actions(data.probabilities, data.actions).log()),
                              cut(advantages.normalized(estimated, data.present)), cut(agent_weights(data)),
                              None if data.available is None else ~cut(~data.available))  # where it is filling, all are
        first = first_states(actor_states, len(chunks.weights))

        # Lines 26 to 32: epochs.
        return metrics | self._passes.run([self._actor_training(chunks, first, rollout), *trainings])

    def expected_rewards(self, trajectory: Trajectory) -> np.ndarray:
        """What the reward networks say of a rollout: E over a_i ~ pi_i of the reward, [T, W, N] float32.

        Raises ValueError if there is no reward network, at beta = 0 or with another estimator than DAE.
        """
        if not isinstance(self._estimator, DifferenceEstimator):
            raise ValueError(f'with estimator = {self._settings.estimator} there is no reward network')
        return self._estimator.expected_rewards(self._tensors(trajectory)).cpu().numpy()

    def begin_with(self, reward_networks: list[dict[str, np.ndarray]]) -> None:
        """Begins with reward networks that were trained before, as `reward_files.read` gives them.

        Raises SettingsError if there is none to be replaced.
        """
        if 'reward_network.0' not in self._networks():
            raise SettingsError('reward_network.path needs the reward network that estimator = dae has at beta above 0')
        self._estimator.begin_with([{f'parameters.{name}': torch.from_numpy(tensor) for name, tensor in parameters.items()}
                                    for parameters in reward_networks])

    def state(self) -> dict[str, np.ndarray]:
        """Everything the next update depends on, by name; views that change with the next update."""
        tensors = self._estimator.state()
        for network, adam in self._networks().items():
            tensors |= {f'{network}.{name}': tensor for name, tensor in adam.state().items()}
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}

    def load_state(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Take over what `state` gave; KeyError or RuntimeError if it is another network's."""
        tensors = {name: torch.from_numpy(tensor) for name, tensor in tensors.items()}
        self._estimator.load_state(tensors)
        for network, adam in self._networks().items():
            prefix = f'{network}.'
            adam.load_state({name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)})

    def close(self) -> None:
        """Ends the learner's threads."""
        self._passes.close()

    def _networks(self) -> dict[str, FlatAdam]:
        return {'actor': self._actor} | self._estimator.networks()

    def _tensors(self, trajectory: Trajectory) -> Trajectory:
        return trajectory.map(lambda part: torch.from_numpy(np.ascontiguousarray(part)).to(self._passes.device))

    def _actor_training(self, chunks: PolicyChunks, first: Tensor, rollout: int) -> Training:
        settings, network, N = self._settings, self._actor.network, self._spec.num_agents

        def gradient(shard: PolicyChunks, initial: Tensor) -> tuple[Tensor, Tensor]:
            loss = losses.PolicyLoss(shard.actions, shard.log_probabilities, shard.advantages, shard.weights, settings.clip,
                                     settings.entropy_coefficient, shard.available)
            return network.gradient(loss, shard.observations, initial, shard.episode_start)

        batches = self._passes.epochs('actor', chunks, first, settings.epochs, settings.num_mini_batches, rollout)
        return self._passes.train('actor', self._actor, gradient, batches, N, losses.PolicyLoss.sums)
