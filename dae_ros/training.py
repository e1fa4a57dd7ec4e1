"""One training from its first rollout to its report: asks for rollouts, learns from them, evaluates, keeps the books.

`Training` knows neither ROS nor the simulator. Whoever collects the rollouts, the trainer node or `in_process`, calls
`request` and `consume` in turn until `finished`.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.files import write_atomically
from dae_ros.learning import reward_files
from dae_ros.learning.credit import Credit
from dae_ros.learning.distributed import make_learner
from dae_ros.learning.estimators import ExpectedRewards
from dae_ros.learning.policy import Policy
from dae_ros.report.metrics import MetricsLog
from dae_ros.run_folder import RunFolder
from dae_ros.types import RolloutRequest, Trajectory, WorldSpec
from dae_ros.weights.codec import encode_policy, tensors_sha256


def episode_returns(trajectory: Trajectory) -> np.ndarray:
    """Undiscounted returns of the episodes that ended within the rollout, [number of episodes]."""
    ended = trajectory.terminated | trajectory.truncated
    running = np.zeros(trajectory.rewards.shape[1])
    returns = []
    for reward, over in zip(trajectory.rewards.astype(np.float64), ended):
        running += reward
        returns.append(running[over])
        running[over] = 0
    return np.concatenate(returns)


def victories(trajectory: Trajectory) -> np.ndarray:
    """Which of the episodes that ended within the rollout were won, bool in the order of `episode_returns`."""
    ended = trajectory.terminated | trajectory.truncated
    won = np.zeros_like(ended) if trajectory.won is None else trajectory.won
    return won[ended]


class Training:
    """The state of a run between rollouts. Resumes from the folder's newest checkpoint if there is one."""

    def __init__(self, settings: Settings, spec: WorldSpec, folder: RunFolder, exact_rewards: ExpectedRewards | None = None):
        """`exact_rewards`: as for `Learner`."""
        self.settings = settings
        self.spec = spec
        self.run = folder.run
        self.mean_return = math.nan
        self.evaluation: np.ndarray = np.empty(0)
        self.won = np.empty(0, bool)  # which of the evaluation's episodes; of worlds that have wins
        self._folder = folder
        self._claim = folder.claim()
        self._writer = ThreadPoolExecutor(1, 'checkpoints')
        self._writing: Future | None = None
        self._learner = make_learner(spec, settings, exact_rewards)
        self._steps_per_rollout = settings.task.num_worlds * settings.run.num_steps
        self._training_rollouts = -(-settings.run.total_steps // self._steps_per_rollout)
        self._rollout = 0
        self.attempt = folder.next_attempt()  # 0 in a run that nothing has disturbed
        self._asked: int | None = None  # the rollout asked for last
        self._updates = 0
        self._seconds_before = 0.0
        resumed = folder.newest_checkpoint()
        if resumed is not None:
            self._resume(*resumed)
        elif settings.reward_network.path or settings.reward_network.freeze:
            self._learner.begin_with(reward_files.read(spec, settings.reward_network))
        self._log = MetricsLog(folder.path, None if resumed is None else self.environment_steps)
        self._began_at: float | None = None
        self._steps_at_start = self.environment_steps
        self._rollout_began_at = 0.0
        self.policy: Policy = self._learner.policy

    @property
    def policy_version(self) -> int:
        """Version of `policy`: the number of updates behind it."""
        return self._updates

    @property
    def environment_steps(self) -> int:
        """Environment steps learnt from so far, all worlds together."""
        return self._updates * self._steps_per_rollout

    @property
    def total_steps(self) -> int:
        """Environment steps at which the training ends: whole rollouts."""
        return self._training_rollouts * self._steps_per_rollout

    @property
    def evaluating(self) -> bool:
        """Whether the training is over and the trained team is being evaluated."""
        return self._updates == self._training_rollouts

    @property
    def finished(self) -> bool:
        """Whether no rollout is wanted any more."""
        return self.evaluating and len(self.evaluation) >= self.settings.run.evaluation_episodes

    @property
    def evaluation_win_rate(self) -> float | None:
        """Share of the evaluation's episodes that were won; None before there are any, and of worlds that have no wins."""
        return float(self.won.mean()) if self.spec.has_wins and len(self.won) else None

    @property
    def seconds(self) -> float:
        """Time spent since the first request, earlier runs of a resumed training included."""
        return self._seconds_before + (0.0 if self._began_at is None else time.monotonic() - self._began_at)

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second since this process asked for its first rollout."""
        elapsed = 0.0 if self._began_at is None else time.monotonic() - self._began_at
        return (self.environment_steps - self._steps_at_start) / elapsed if elapsed else 0.0

    def request(self) -> RolloutRequest:
        """The rollout wanted now. Asking again without consuming begins it anew: the next attempt."""
        if self._asked == self._rollout:
            self.attempt = self._folder.next_attempt()
        self._asked = self._rollout
        now = time.monotonic()
        self._began_at = self._began_at or now
        self._rollout_began_at = now
        return RolloutRequest(self.run, self._rollout, self.attempt, self.policy_version, self.settings.run.seed,
                              self.settings.run.num_steps, self.evaluating and self.settings.run.evaluation_greedy)

    def consume(self, trajectory: Trajectory) -> None:
        """Learn from the rollout asked for last, or count it towards the evaluation."""
        returns = episode_returns(trajectory)
        if self.evaluating:
            self.evaluation = np.concatenate([self.evaluation, returns])
            self.won = np.concatenate([self.won, victories(trajectory)])
        else:
            self.mean_return = float(returns.mean()) if len(returns) else math.nan
            self._learn(trajectory)
        self._rollout += 1

    def save(self) -> None:
        """Writes a checkpoint of the training as it stands; FileError if one could not be written."""
        self._begin_to_save()
        self._wait_until_saved()

    def watch(self, world: int) -> None:
        """From here on `credit` tells who earned what in this world."""
        self._learner.watched_world = world

    @property
    def credit(self) -> Credit | None:
        """Who earned what in the watched world, in the last rollout learnt from; None if there is none."""
        return self._learner.credit

    def expected_rewards(self, trajectory: Trajectory) -> np.ndarray:
        """As `Learner.expected_rewards`."""
        return self._learner.expected_rewards(trajectory)

    def weights_sha256(self) -> str:
        """SHA-256 of everything learnt: all networks, their optimisers' moments, the value normaliser."""
        return tensors_sha256(self._learner.state())

    def close(self) -> None:
        """Ends the threads and closes the metrics; FileError if the last checkpoint could not be written."""
        try:
            self._wait_until_saved()
        finally:
            self._writer.shutdown()
            self._learner.close()
            self._log.close()
            self._claim.close()

    def _learn(self, trajectory: Trajectory) -> None:
        began = time.monotonic()
        metrics = self._learner.update(trajectory, self._rollout)
        self.policy = self._learner.policy
        self._updates += 1
        ended = time.monotonic()
        won = victories(trajectory)
        wins = {'win_rate': float(won.mean()) if len(won) else math.nan} if self.spec.has_wins else {}
        self._log.write(self.environment_steps, {
            'mean_return': self.mean_return, **wins, **metrics, 'seconds/collecting': began - self._rollout_began_at,
            'seconds/learning': ended - began, 'steps_per_second': self.steps_per_second})
        if self.evaluating:
            self.save()
        elif self._updates % self.settings.run.checkpoint_interval == 0:
            self._begin_to_save()

    def _begin_to_save(self) -> None:
        """Has a checkpoint written while the next rollout is collected, which does not need it: a trainer killed before the
        file is whole goes on from the one before, to the same weights."""
        self._wait_until_saved()
        tensors = {name: tensor.copy() for name, tensor in self._learner.state().items()}
        facts = {'settings': config.digest(self.settings), 'updates': self._updates, 'rollout': self._rollout,
                 'seconds': self.seconds, 'mean_return': self.mean_return}
        self._writing = self._writer.submit(self._write, self._updates, tensors, facts, encode_policy(self.policy))

    def _write(self, update: int, tensors: dict[str, np.ndarray], facts: dict[str, Any], policy: bytes) -> None:
        self._folder.save_checkpoint(update, tensors, facts)
        write_atomically(self._folder.policy_file, policy)

    def _wait_until_saved(self) -> None:
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()

    def _resume(self, tensors, facts) -> None:
        self._learner.load_state(tensors)
        self._updates = facts['updates']
        self._rollout = facts['updates']
        self._seconds_before = facts['seconds']
        self.mean_return = facts['mean_return']
