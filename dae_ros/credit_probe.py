"""How well a reward network tells each agent's credit, measured against the truth on a rollout of its own.

The credit of agent i is c_i = r - E over a_i ~ pi_i of r(s, a_-i, a_i): how much better its action was than what it does
on average. The built-in tasks tell what every action would have been rewarded with, so E[r] and c are known exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.learning.policy import Policy
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest, Trajectory
from dae_ros.worlds import BUILT_IN, make_worlds, side_by_side
from dae_ros.worlds.base import JointObservation, Transition, Worlds
from dae_ros.worlds.synchronous import SynchronousWorlds


class Probe(NamedTuple):
    """One rollout, and E over a_i ~ pi_i of its rewards."""

    trajectory: Trajectory
    expected: np.ndarray   # [T, W, N] float64, the truth
    predicted: np.ndarray  # [T, W, N]


class Accuracy(NamedTuple):
    """How near predicted expected rewards come to the truth. What there is nothing to measure on is nan."""

    error: float               # root mean square of predicted - true E[r], in units of reward
    explained: float           # share of the variance of E[r] explained
    credit_explained: float    # share of the sum of c^2 explained: 1 is all, 0 as good as no credit (predicting r itself)
    credit_correlation: float  # of r - predicted with c


def probe(worlds: SynchronousWorlds, policy: Policy, expected_rewards: Callable[[Trajectory], np.ndarray], seed: int,
          rollout: int, num_steps: int) -> Probe:
    """Plays one rollout with `policy` and holds `expected_rewards`, which gives [T, W, N] for it, against the truth.

    Draws are keyed by (seed, rollout) and apart from those of a training with that seed; the rollout leaves no trace in
    worlds that are reset before they are used again, as those of a training are.
    """
    recorder = AlternativesRecorder(worlds)
    request = RolloutRequest(run=1, rollout=rollout, attempt=0, policy_version=0, seed=draws.key(seed, 'probe'),
                             num_steps=num_steps, greedy=False)
    trajectory = InProcessCollector(recorder).collect(request, policy)
    return Probe(trajectory, recorder.expected_rewards(trajectory), expected_rewards(trajectory))


def recorded_expected_rewards(task: TaskSettings, num_worlds: int) -> Callable[[RolloutRequest, int, Trajectory], np.ndarray]:
    """A function of a recorded rollout's request, group and trajectory: the true E over a_i ~ pi_i of its rewards, [T, W, N].

    The rollout is simulated again with the recorded actions. Raises SettingsError if the task is not built in, or, from the
    function, if the simulator pays other rewards than were recorded.
    """
    if task.task not in BUILT_IN:
        raise SettingsError(f'the truth about E[r] is known of {", ".join(BUILT_IN)}, not of {task.task}')
    recorder = AlternativesRecorder(make_worlds(side_by_side(task, num_worlds)))

    def expected_rewards(request: RolloutRequest, group: int, trajectory: Trajectory) -> np.ndarray:
        fits = recorder.reset(draws.group_seed(request.seed, group), request.rollout).state.shape == trajectory.states[0].shape
        if not fits or any(not np.array_equal(recorder.step(actions).reward, rewards)
                           for actions, rewards in zip(trajectory.actions, trajectory.rewards)):
            raise SettingsError(f'rollout {request.rollout} was not played in this task: the simulator pays other rewards than '
                                'were recorded')
        return recorder.expected_rewards(trajectory)

    return expected_rewards


def accuracy(rewards: np.ndarray, expected: np.ndarray, predicted: np.ndarray) -> Accuracy:
    """Holds the predicted E[r] [T, W, N] against the true one, for the rewards [T, W] that were paid."""
    error = predicted - expected
    credit = rewards[..., None] - expected
    return Accuracy(
        error=float(np.sqrt(np.mean(error**2))),
        explained=_share_explained(expected - expected.mean(), error),
        credit_explained=_share_explained(credit, error),
        credit_correlation=_correlation(credit, rewards[..., None] - predicted),
    )


class AlternativesRecorder(Worlds):
    """Worlds that keep what every action would have been rewarded with, since they were reset."""

    def __init__(self, worlds: SynchronousWorlds):
        self.spec, self.num_worlds = worlds.spec, worlds.num_worlds
        self._alternatives: list[np.ndarray] = []  # [W, N, A] for each step
        self._worlds = worlds

    def reset(self, seed: int, rollout: int) -> JointObservation:
        self._alternatives.clear()
        return self._worlds.reset(seed, rollout)

    def step(self, actions: np.ndarray) -> Transition:
        self._alternatives.append(self._worlds.alternative_rewards(actions))
        return self._worlds.step(actions)

    def expected_rewards(self, trajectory: Trajectory) -> np.ndarray:
        """The true E over a_i ~ pi_i of the reward, [T, W, N] float64, of the rollout that was just simulated here."""
        return (trajectory.probabilities * np.array(self._alternatives)).sum(axis=-1)


def _share_explained(target: np.ndarray, error: np.ndarray) -> float:
    total = np.sum(target**2)
    return float(1.0 - np.sum(error**2) / total) if total else float('nan')


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    one, other = one - one.mean(), other - other.mean()
    scale = np.sqrt(np.sum(one**2) * np.sum(other**2))
    return float(np.sum(one * other) / scale) if scale else float('nan')
