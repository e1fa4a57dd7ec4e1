"""Bags of robots as data: their odometry, sampled at the control period, becomes what the task's monitor sees and rewards.

The actions are those that fit the velocity commands best. Who chose them, and with what probabilities, such a bag does not say.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, Iterable, Iterator, Mapping, NamedTuple

import numpy as np

from dae_ros.errors import BagError, Refused
from dae_ros.replay.bag import find_bags
from dae_ros.replay.dataset import describe
from dae_ros.replay.joiner import Rollout
from dae_ros.replay.robot_log import RobotLog, Told, topics
from dae_ros.replay.stretches import READ_AT, Limits, Stretch, stretches
from dae_ros.robots.motion import STOP, Command, Motion
from dae_ros.robots.setup import RUN, landmarks_in, limits_in, task_frame, task_settings
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.types import RolloutRequest, Trajectory

MOST_WORLDS = 128  # episodes side by side in a rollout


class Episode(NamedTuple):
    """K steps of one team."""

    observations: np.ndarray  # [K, N, O] float32
    states: np.ndarray        # [K + 1, S] float32
    actions: np.ndarray       # [K, N] int64
    rewards: np.ndarray       # [K] float32


class RobotDataset:
    """As `Dataset`, of bags that robots left. Each is read once, and its episodes are kept in memory.

    A stretch ends where odometry or commands pause, positions jump or landmarks move; `skipped` counts these cuts, and refused
    messages, by reason. An episode is as long as the task's, or shorter where its stretch ends. A rollout has as many of equal
    length as there are, at most 128.
    """

    def __init__(self, *paths: str | Path, settings: Mapping[str, Any]):
        """`settings`: the team's, by name. BagError if a path names nothing, SettingsError where settings do not fit."""
        self._bags = find_bags(*paths)
        self._topics, self._world_frame = topics(settings), settings['world_frame']
        self._monitor, self._frame = TaskMonitor(task_settings(settings)), task_frame(settings)
        self._differential, self._limits = settings['drive'] == 'differential', limits_in(settings)
        self._places = landmarks_in(settings['landmarks']) if settings['landmarks'] else None
        self._bounds = Limits(1.0 / settings['control_rate'], *(settings[name] for name in Limits._fields[1:]))
        self.spec = self._monitor.spec
        self.skipped: Counter[str] = Counter()
        self._refusal = ''  # the first one in words
        self._rollouts: list[Rollout] | None = None

    @property
    def rollouts(self) -> int:
        """How many there are, once they were read."""
        return len(self._rollouts or ())

    @property
    def environment_steps(self) -> int:
        """In all rollouts."""
        return sum(rollout.trajectory.rewards.size for rollout in self._rollouts or ())

    def __iter__(self) -> Iterator[Trajectory]:
        """The trajectories alone."""
        return (rollout.trajectory for rollout in self.read())

    def read(self) -> Iterator[Rollout]:
        """The rollouts. BagError, saying why, if there is not one step in all the bags."""
        if self._rollouts is None:
            episodes = (episode for path in self._bags for episode in self._episodes(path))
            self._rollouts = list(_side_by_side(episodes, self.spec.num_actions))
        if not self._rollouts:
            raise BagError(f'no step can be read: {self.describe_skipped() or "no stretch is as long as one"}'
                           f'{self._refusal and f"; {self._refusal}"}')
        return iter(self._rollouts)

    def describe_skipped(self) -> str:
        """What was skipped and why, for people."""
        return describe(self.skipped)

    def _episodes(self, path: Path) -> Iterator[Episode]:
        """Those in a bag, one after the other."""
        try:
            log = RobotLog(path, self._topics, self._world_frame, self.skipped)
        except BagError as error:
            self.skipped[f'{path}: {error}'] += 1
            return
        self._refusal = self._refusal or log.refusal
        for stretch in stretches(log, self._moves_of_landmarks(path, log), self._bounds, self.skipped):
            first, last = stretch.steps(self._bounds.period)
            motions = self._motions_under_way(log, first) if first < last else []
            for begin in range(first, last, self._monitor.episode_steps):
                steps = np.arange(begin, min(begin + self._monitor.episode_steps, last) + 1)
                episode = self._episode(log, stretch, steps * self._bounds.period, motions)
                if all(np.isfinite(part).all() for part in episode):
                    yield episode
                else:
                    self.skipped[Refused.OUT_OF_RANGE] += 1

    def _moves_of_landmarks(self, path: Path, log: RobotLog) -> list[tuple[float, np.ndarray]]:
        """When the landmarks are somewhere else than before, and where [L, 2] in m."""
        moves: list[tuple[float, np.ndarray]] = []
        for time, places in log.landmarks if self._places is None else [(-np.inf, self._places)]:
            if len(places) != self._monitor.num_landmarks:
                self.skipped[Refused.WRONG_SHAPE] += 1
                self._refusal = self._refusal or f'{len(places)} landmarks, the task has {self._monitor.num_landmarks}'
            elif not moves or (places != moves[-1][1]).any():
                moves.append((time, places))
        if not moves:
            self.skipped[f'{path}: where the landmarks are is not said on {self._topics.landmarks}'] += 1
        return moves

    def _motions_under_way(self, log: RobotLog, step: int) -> list[Motion]:
        """How the robots were told to move when a stretch begins with this step."""
        time, motions = step * self._bounds.period, []
        for track, told in zip(log.tracks, log.told):
            motion = Motion(self._differential, self._limits, self._frame)
            motion.begin(self._command(told, time - (1.0 - READ_AT) * self._bounds.period),
                         float(np.interp(time, track.times, track.headings)))
            motions.append(motion)
        return motions

    def _command(self, told: Told, time: float) -> Command:
        """What a robot was told last at `time` [s]; to stand, if that was long ago."""
        last = int(np.searchsorted(told.times, time, side='right')) - 1
        return told.commands[last] if last >= 0 and time - told.times[last] <= self._bounds.told_for else STOP

    def _episode(self, log: RobotLog, stretch: Stretch, times: np.ndarray, motions: list[Motion]) -> Episode:
        """The steps that begin at all but the last of `times` [K + 1]; `motions` go on with them."""
        landmarks = self._frame.positions(stretch.landmarks)
        sights = [self._monitor.see(self._frame.positions(robots[:, :2]), self._frame.velocities(robots[:, 2:]), landmarks)
                  for robots in self._moved(log, np.clip(times, *stretch.span))]
        actions = np.empty((len(times) - 1, len(motions)), np.int64)
        for robot, (motion, told, track) in enumerate(zip(motions, log.told, log.tracks)):
            headings = np.interp(times[:-1], track.times, track.headings).tolist()
            for step, (time, heading) in enumerate(zip(times, headings)):
                actions[step, robot] = motion.likely_action(self._command(told, time + READ_AT * self._bounds.period), heading)
        return Episode(np.stack([sight.observations for sight in sights[:-1]]), np.stack([sight.state for sight in sights]),
                       actions, np.array([sight.reward for sight in sights[1:]], np.float32))

    @staticmethod
    def _moved(log: RobotLog, times: np.ndarray) -> np.ndarray:
        """Positions and velocities at `times` [K], between measurements in proportion, [K, N, 4]."""
        return np.stack([np.stack([np.interp(times, track.times, column) for column in track.moved.T], axis=1)
                         for track in log.tracks], axis=1)


def _side_by_side(episodes: Iterable[Episode], num_actions: int) -> Iterator[Rollout]:
    """Rollouts of episodes with the same number of steps."""
    number, waiting = 0, {}
    for episode in episodes:
        alike = waiting.setdefault(len(episode.rewards), [])
        alike.append(episode)
        if len(alike) == MOST_WORLDS:
            yield _rollout(number, alike, num_actions)
            number += 1
            alike.clear()
    for _, alike in sorted(waiting.items()):
        if alike:
            yield _rollout(number, alike, num_actions)
            number += 1


def _rollout(number: int, episodes: list[Episode], num_actions: int) -> Rollout:
    observations, states, actions, rewards = (np.stack(parts, axis=1) for parts in zip(*episodes))
    T, W = rewards.shape
    episode_start, terminated = np.zeros((T + 1, W), bool), np.zeros((T, W), bool)
    episode_start[0] = terminated[-1] = True
    probabilities = np.eye(num_actions, dtype=np.float32)[actions]
    trajectory = Trajectory(observations, states, episode_start, actions, probabilities, rewards, terminated,
                            np.zeros((T, W), bool), np.empty((0, states.shape[2]), np.float32))
    return Rollout('', 0, RolloutRequest(RUN, number, 0, 0, 0, T, False), trajectory)
