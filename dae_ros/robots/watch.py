"""Who sees everything of a team on robots: state and reward of each step, from the same odometry, for a trainer that streams."""

from __future__ import annotations

from typing import Union

import numpy as np

from dae_ros.errors import Refused
from dae_ros.robots.geometry import TaskFrame
from dae_ros.robots.pilot import stamp_at
from dae_ros.robots.safety import Bounds, Track
from dae_ros.robots.scene import Scene
from dae_ros.robots.task_monitor import Sight, TaskMonitor
from dae_ros.types import JointState, SharedReward, Stamp

Seen = Union[JointState, SharedReward]


class Watch:
    """Looks several times in each control period, and says once per step what there was to see."""

    def __init__(self, run: int, monitor: TaskMonitor, frame: TaskFrame, period: float, bounds: Bounds, go_on: bool = False):
        """`go_on`: who is heard of no more has left the team until the episode ends, instead of making it blind."""
        self.tracks = [Track(bounds) for _ in range(monitor.spec.num_agents)]
        self._run, self._monitor, self._frame, self._period, self._bounds = run, monitor, frame, period, bounds
        self._go_on = go_on
        self._left: set[int] = set()        # in the episode under way
        self._landmarks: np.ndarray | None = None
        self._last: Stamp | None = None     # the step whose reward is due
        self._sight: Sight | None = None    # the last one; an episode ends with it, whatever is put elsewhere for the next

    def on_landmarks(self, landmarks: np.ndarray) -> None:
        """Takes in where the landmarks are, [L, 2] in m. Raises Refused."""
        if landmarks.shape != (self._monitor.num_landmarks, 2) or not np.isfinite(landmarks).all():
            raise Refused(Refused.WRONG_SHAPE, f'{len(landmarks)} landmarks, the task has {self._monitor.num_landmarks}')
        self._landmarks = landmarks

    @property
    def radius(self) -> float:
        """Of a robot, in m."""
        return self._monitor.radius * self._frame.scale

    def blind_for(self, now: float) -> str:
        """Whose odometry is too old at `now`, or what else is missing; '' if everything is seen."""
        lost = self.lost(now)
        if self._go_on and len(lost) < len(self.tracks):
            lost = [robot for robot in lost if self.tracks[robot].pose is None]
        if lost:
            return f'the odometry of robot {", ".join(map(str, lost))}'
        return '' if self._landmarks is not None else 'the landmarks'

    def lost(self, now: float) -> list[int]:
        """Robots whose odometry is too old."""
        return [robot for robot, track in enumerate(self.tracks) if track.age(now) > self._bounds.odometry_timeout]

    def show(self, scene: Scene, now: float) -> None:
        """Has the scene show everybody as last heard of; nothing must be missing (`blind_for`)."""
        poses = [track.pose for track in self.tracks]
        self._see(now)
        scene.show(np.array([pose.position for pose in poses]), np.array([pose.heading for pose in poses]), self._landmarks,
                   self._frame.metres(self._monitor.targets))

    def look(self, now: float) -> list[Seen]:
        """What there is to say at `now` [s]; nothing while somebody's odometry is too old, which leaves a hole."""
        if self.blind_for(now):
            self._last = None
            return []
        before, self._sight = self._sight, self._see(now)
        step, last = stamp_at(now, self._period, self._monitor.episode_steps, self._run), self._last
        if step == last:
            return []
        self._last = step
        if last is None or step.rollout != last.rollout:
            self._left.clear()
        self._left.update(self.lost(now))
        seen: list[Seen] = []
        if last is not None and step == last._replace(step=last.step + 1):
            seen.append(_reward(last, self._sight, ended=False))
        elif last is not None and (last.rollout + 1, last.step + 1, 0) == (step.rollout, self._monitor.episode_steps, step.step):
            seen += [_reward(last, before, ended=True), _joint_state(last._replace(step=last.step + 1), before)]
        return [*seen, _joint_state(step, self._sight, self._present())]

    def _present(self) -> np.ndarray | None:
        """Who has not left, [1, N]; None if nobody has."""
        return ~np.isin(np.arange(len(self.tracks)), list(self._left))[None] if self._left else None

    def _see(self, now: float) -> Sight:
        return self._monitor.see(*self._frame.placed([track.held(now) for track in self.tracks], self._landmarks))


def _joint_state(stamp: Stamp, sight: Sight, present: np.ndarray | None = None) -> JointState:
    return JointState(stamp, np.array([stamp.step == 0]), sight.observations[None], sight.state[None], present=present)


def _reward(stamp: Stamp, sight: Sight, ended: bool) -> SharedReward:
    return SharedReward(stamp, np.array([sight.reward], np.float32), np.array([ended]), np.zeros(1, bool),
                        np.empty((0, len(sight.state)), np.float32))
