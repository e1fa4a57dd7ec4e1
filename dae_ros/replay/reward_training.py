"""Trains reward networks from bags: minibatches of chunks, early stopping on episodes that were held out.

Every pass streams the bags from disk. What is drawn is keyed by what it is for, so the same bags and settings give the same
weights, bit for bit, on processors of the same kind.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Callable, Iterator, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dae_ros import draws
from dae_ros.config import RewardTrainingSettings, Settings
from dae_ros.errors import BagError
from dae_ros.learning import advantages, reward_files
from dae_ros.learning.chunks import ActionChunks, agent_weights, chosen_chunks, first_states, to_chunks
from dae_ros.learning.device import chosen_device
from dae_ros.learning.estimators import ActionNetwork, action_chunks, as_remembered, chunk_length, ensemble_prediction
from dae_ros.learning.networks import make_reward_network
from dae_ros.learning.passes import Passes
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.joiner import Rollout
from dae_ros.types import RolloutRequest, Trajectory

SHOWN = 4000  # held-out predictions kept for the report


class Epoch(NamedTuple):
    """What one pass over the bags came to."""

    number: int             # from 1
    loss: float             # half the first network's squared error on the minibatches, as they were learnt
    held_out_error: float   # mean squared error on the held-out episodes after the pass
    best: bool


class Baseline(NamedTuple):
    """What there is to learn from, and how well the mean reward of the episodes learnt from predicts the held-out ones."""

    episodes: int
    held_out_episodes: int
    held_out_error: float  # mean squared


class HeldOut(NamedTuple):
    """Predictions on held-out episodes. E[r] is over a_i ~ pi_i; a credit is r - E[r]."""

    rewards: np.ndarray    # [steps] that were paid
    predicted: np.ndarray  # [steps, N]
    expected: np.ndarray   # [steps, N] predicted E[r]
    credit: np.ndarray     # [steps of one episode, N] with the predicted E[r]
    true_expected: np.ndarray | None  # [steps, N], where the truth is known
    true_credit: np.ndarray | None    # [steps of that episode, N]


Truth = Callable[[RolloutRequest, int, Trajectory], np.ndarray]
"""The true E[r] [T, W, N] of a recorded rollout, given its request, group and trajectory."""


class RewardTraining:
    """Reward networks and their training. `run` trains; then they are those of the best epoch."""

    def __init__(self, dataset: Dataset, settings: Settings, training: RewardTrainingSettings,
                 on_rollout: Callable[[int, int], None] = lambda done, total: None):
        """Reads the bags once. `on_rollout` is told how many rollouts of a pass are done. BagError if there is nothing to learn.
        """
        self._dataset = dataset
        self._training = training
        self._on_rollout = on_rollout
        self._total = 0
        self._seed = settings.run.seed
        self._reward = settings.reward_network
        self.baseline = self._measure_baseline()
        if settings.learner.device == 'auto':  # the choice would depend on how busy the machine is
            settings = dataclasses.replace(settings, learner=dataclasses.replace(settings.learner, device='cpu'))
        self._learner = settings.learner
        self._passes = Passes(self._learner.learner_threads, self._seed, chosen_device(dataset.spec, settings))
        self._members = [ActionNetwork(f'reward_network.{member}',
                                       make_reward_network(dataset.spec, self._reward, self._seed, member),
                                       self._reward.learning_rate, self._learner, self._passes)
                         for member in range(self._reward.ensemble_size)]

    def run(self) -> Iterator[Epoch]:
        """Trains; gives each epoch as it ends."""
        best, best_error, since = self._weights(), math.inf, 0
        for number in range(1, self._training.max_epochs + 1):
            loss = self._learn(number)
            error = self._held_out_error()
            since = 0 if error < best_error else since + 1
            if not since:
                best, best_error = self._weights(), error
            yield Epoch(number, loss, error, not since)
            if since == self._training.patience:
                break
        for member, tensors in zip(self._members, best):
            member.adam.load_state(tensors)

    def file(self) -> bytes:
        """The networks as a safetensors file, with what they are in its schema."""
        networks = [member.adam.network for member in self._members]
        return reward_files.encode(networks, self._dataset.spec, self._reward)

    def held_out(self, truth: Truth | None = None) -> HeldOut:
        """Predictions on the first held-out episodes."""
        parts: list[list[np.ndarray]] = []
        credits: list[np.ndarray] = []
        for rollout, held in self._rollouts():
            worlds = held.any(axis=0)
            data, mask = self._of_worlds(rollout.trajectory, held)
            if not mask.numel():
                continue
            predicted = self._predict(data)
            found = [data.rewards, advantages.of_actions(predicted, data.actions),
                     advantages.expected_rewards(predicted, data.probabilities)]
            found = [part.cpu().numpy() for part in found]
            if truth is not None:
                found.append(truth(rollout.request, rollout.group, rollout.trajectory)[:, worlds])
            held = mask.cpu().numpy()
            parts.append([part[held] for part in found])
            if not credits:
                episode = _first_episode(held[:, 0], (data.terminated | data.truncated)[:, 0].cpu().numpy())
                credits = [found[0][episode, 0, None] - expected[episode, 0] for expected in found[2:]]
            if sum(len(rewards) for rewards, *_ in parts) >= SHOWN:
                break
        rewards, predicted, *expected = (np.concatenate(part)[:SHOWN] for part in zip(*parts))
        told = (expected[1], credits[1]) if truth is not None else (None, None)
        return HeldOut(rewards, predicted, expected[0], credits[0], *told)

    def close(self) -> None:
        """Ends the threads."""
        self._passes.close()

    def _rollouts(self) -> Iterator[tuple[Rollout, np.ndarray]]:
        """The rollouts in the bags, each with which of its steps [T, W] belong to held-out episodes."""
        for done, rollout in enumerate(self._dataset.read(), 1):
            request, starts = rollout.request, rollout.trajectory.episode_start[:-1]
            number = np.cumsum(starts, axis=0)
            draw = draws.generator(self._seed, f'held out {rollout.team}', rollout.group, request.run, request.rollout)
            chances = draw.random((len(starts) + 1, starts.shape[1]))
            held = np.take_along_axis(chances, number, axis=0) < self._training.held_out
            yield rollout, held
            self._on_rollout(done, self._total)
        self._total = self._dataset.rollouts

    def _measure_baseline(self) -> Baseline:
        episodes, steps, sums, squares = (np.zeros(2) for _ in range(4))  # of those learnt from, and of those held out
        for rollout, held in self._rollouts():
            rewards = rollout.trajectory.rewards.astype(np.float64)
            for which, mask in enumerate((~held, held)):
                episodes[which] += (rollout.trajectory.episode_start[:-1] & mask).sum()
                steps[which] += mask.sum()
                sums[which] += rewards[mask].sum()
                squares[which] += np.square(rewards[mask]).sum()
        if not steps.all():
            raise BagError(f'{int(episodes.sum())} episodes are too few to hold out a share of {self._training.held_out:g} of '
                           'them and learn from the others: record more, or change held_out')
        mean = sums[0] / steps[0]
        error = squares[1] / steps[1] - 2 * mean * sums[1] / steps[1] + mean**2
        return Baseline(int(episodes.sum()), int(episodes[1]), float(error))

    def _learn(self, epoch: int) -> float:
        """One pass over the bags."""
        losses, batches = 0.0, 0
        for number, pool in enumerate(self._pools()):
            chunks = ActionChunks(*(torch.cat(parts, 1) for parts in zip(*(chunks for chunks, _ in pool))))
            firsts = [torch.cat(parts) for parts in zip(*(firsts for _, firsts in pool))]
            steps = -(-len(firsts[0]) // self._training.batch_chunks)
            trainings = []
            for member, first in zip(self._members, firsts):
                mixed = self._passes.epochs(f'{member.name} pool {number}', chunks, first, 1, steps, epoch)
                trainings.append(member.training(mixed, f'{member.name}/loss'))
            losses += self._passes.run(trainings)[f'{self._members[0].name}/loss'] * steps
            batches += steps
        return losses / batches

    def _pools(self) -> Iterator[list[tuple[ActionChunks, list[Tensor]]]]:
        """The chunks to learn from with each member's recurrent states before them, about `pool_chunks` at a time."""
        pool, size, length = [], 0, 0
        for rollout, held in self._rollouts():
            data, learnt = self._of_worlds(rollout.trajectory, ~held)
            if not learnt.numel():
                continue
            if pool and (size >= self._training.pool_chunks or chunk_length(data, self._learner) != length):
                yield pool
                pool, size = [], 0
            length = chunk_length(data, self._learner)
            data = as_remembered(data, self._reward)
            inputs = self._members[0].inputs(data)
            for member in self._members:
                member.take_scale(data.rewards[learnt])
            chunks = action_chunks(data, inputs, data.rewards, self._learner)
            chunks = chunks._replace(weights=chunks.weights * to_chunks(learnt.float(), length).unsqueeze(-1))
            useful = (chunks.weights.sum((0, 2)) > 0).nonzero().flatten()
            firsts = [first_states(member.predict(inputs, data)[1], len(chunks.weights))[useful] for member in self._members]
            pool.append((chosen_chunks(chunks, useful), firsts))
            size += len(useful)
        if pool:
            yield pool

    def _held_out_error(self) -> float:
        """Mean squared error on the held-out episodes, each agent's prediction of the reward that was paid."""
        total = count = 0
        for rollout, held in self._rollouts():
            data, held = self._of_worlds(rollout.trajectory, held)
            if not held.numel():
                continue
            taken = advantages.of_actions(self._predict(data), data.actions)
            error = (taken - data.rewards.unsqueeze(-1))[held.unsqueeze(-1) & (agent_weights(data) > 0)]
            total += float(error.double().square().sum())
            count += error.numel()
        return total / count

    def _predict(self, data: Trajectory) -> Tensor:
        """The ensemble's mean prediction [T, W, N, A]."""
        return ensemble_prediction(self._members, as_remembered(data, self._reward))[0]

    def _of_worlds(self, trajectory: Trajectory, wanted: np.ndarray) -> tuple[Trajectory, Tensor]:
        """The rollout in the worlds in which any step is wanted, and `wanted` [T, W] there, as tensors."""
        worlds = wanted.any(axis=0)

        def of_worlds(part: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(part[:, worlds])).to(self._passes.device)

        final_states = torch.from_numpy(trajectory.final_states)
        return trajectory._replace(final_states=None).map(of_worlds)._replace(final_states=final_states), of_worlds(wanted)

    def _weights(self) -> list[dict[str, Tensor]]:
        return [{name: tensor.clone() for name, tensor in member.adam.state().items()} for member in self._members]


def _first_episode(held: np.ndarray, ended: np.ndarray) -> np.ndarray:
    """Steps of the first episode of one world that was held out, given which steps [T] were and which end an episode."""
    steps = held.nonzero()[0]
    ends = ended[steps].nonzero()[0]
    return steps[:ends[0] + 1] if len(ends) else steps
