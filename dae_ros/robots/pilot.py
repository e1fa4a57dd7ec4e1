"""What a robot's bridge does, without ROS: from odometry to the observation its agent needs, from the action to a command.

Steps are counted by the clock: step k begins k control periods after the clock's zero, for every robot of the team and for
whoever watches it. So their data carry the same stamps though nobody tells them when to act, and episodes begin together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dae_ros.errors import Refused
from dae_ros.robots.geometry import Pose, TaskFrame
from dae_ros.robots.motion import Command, Motion
from dae_ros.robots.safety import Safety, Stop
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.rollout.lockstep import check_action
from dae_ros.types import Action, Observation, Stamp

LARGEST_ROLLOUT = 2**32  # what a stamp can hold
LOOKS = 5  # in each control period


class Turn(NamedTuple):
    """What a bridge has to send."""

    command: Command | None = None
    observation: Observation | None = None


def stamp_at(now: float, period: float, episode_steps: int, run: int) -> Stamp:
    """The stamp of the step under way at `now` [s], with steps of `period` [s]."""
    episode, step = divmod(int(now / period + 1e-6), episode_steps)
    return Stamp(run, episode % LARGEST_ROLLOUT, 0, step)


def without(robots: list[int]) -> str:
    """Who is missed, for people: the end of a sentence."""
    return f' without robot {", ".join(map(str, robots))}' if robots else ''


class Pilot:
    """Drives one robot as its agent says, or lets it stand and knows why."""

    def __init__(self, robot: int, run: int, monitor: TaskMonitor, motion: Motion, frame: TaskFrame, period: float,
                 safety: Safety):
        self.stop: Stop | None = None
        self._robot, self._run, self._monitor, self._motion, self._frame = robot, run, monitor, motion, frame
        self._period, self._safety = period, safety
        self._landmarks: np.ndarray | None = None
        self._seen: Stamp | None = None   # of the last observation
        self._asked: dict[Stamp, float] = {}  # when the observations that wait for their action were made; s
        self._moving = False              # whether the episode goes on

    @property
    def enabled(self) -> bool:
        return self._safety.enabled

    def lost(self, now: float) -> list[int]:
        """Team mates that are heard of no more."""
        return self._safety.lost(now)

    def enable(self, enabled: bool) -> None:
        """Lets the robot move, or not."""
        self._safety.enabled = enabled

    def on_odometry(self, robot: int, pose: Pose, now: float) -> None:
        """Takes in where a robot of the team is. Raises Refused."""
        self._safety.tracks[robot].take(pose, now)

    def on_landmarks(self, landmarks: np.ndarray) -> None:
        """Takes in where the landmarks are, [L, 2] in m. Raises Refused. Other landmarks than before begin an episode."""
        if landmarks.shape != (self._monitor.num_landmarks, 2):
            raise Refused(Refused.WRONG_SHAPE, f'{len(landmarks)} landmarks, the task has {self._monitor.num_landmarks}')
        if not np.isfinite(landmarks).all():
            raise Refused(Refused.NOT_FINITE, 'a landmark is not finite')
        if self._landmarks is None or (landmarks != self._landmarks).any():
            self._moving = False
        self._landmarks = landmarks
        self._safety.has_landmarks = True

    def look(self, now: float) -> Turn:
        """What is to be sent at `now` [s]; called several times in each control period, it stops the robot at once."""
        step = stamp_at(now, self._period, self._monitor.episode_steps, self._run)
        is_new = step != self._seen
        before, self.stop = self.stop, self._safety.stop(now)
        if self.stop is None:
            return Turn(observation=self._observe(step, now)) if is_new else Turn()
        reason = self.stop.reason
        is_told = before is None or before.reason != reason
        command = self._motion.halt()
        self._moving = False
        if reason == Stop.AGENT:  # it may come back
            return Turn(command, self._observe(step, now)) if is_new else Turn(command if is_told else None)
        self._seen = step
        self._asked.clear()
        # A robot that is not enabled may be driven by somebody else: it is told to stand once.
        return Turn(command if is_told or (is_new and reason != Stop.DISABLED) else None)

    def on_action(self, action: Action) -> Command:
        """The command for the agent's answer. Raises Refused if it answers no observation, or one before what is answered."""
        if action.robot != self._robot:
            raise Refused(Refused.WRONG_ROBOT, f'action of robot {action.robot}, this is robot {self._robot}')
        if action.stamp not in self._asked:
            raise Refused(Refused.STALE, f'an answer to {action.stamp}, the last observation was {self._seen}')
        spec = self._monitor.spec
        check_action(action, spec.num_agents, 1, spec.num_actions, action.policy_version)
        asked = list(self._asked)
        for stamp in asked[:asked.index(action.stamp) + 1]:
            del self._asked[stamp]
        self._safety.answered(next(iter(self._asked.values()), None))
        return self._motion.act(int(action.actions[0]), self._safety.tracks[self._robot].pose.heading)

    def _observe(self, step: Stamp, now: float) -> Observation:
        poses = [track.held(now) for track in self._safety.tracks]
        observations, _ = self._monitor.observe(*self._frame.placed(poses, self._landmarks))
        start = not self._moving or step.rollout != self._seen.rollout
        self._seen, self._moving = step, True
        self._asked = {stamp: asked for stamp, asked in self._asked.items() if self._safety.waits(asked, now)}
        self._asked[step] = now
        self._safety.asked(now)
        return Observation(step, self._robot, 0, np.array([start]), observations[self._robot:self._robot + 1])
