"""The trainer's end of streaming collection: robots act at their own rate, with whatever policy they hold, and steps get lost.

Episodes are joined on the stamps, which the clock gave. One that is whole counts; so many of them side by side make a
trajectory. One with a hole is dropped, for its recurrent states and its returns cannot be told, and so is one that was acted
with too old a policy. Who falls silent for the rest of an episode, or begins anew in its middle, has left the team until its end.
"""

from __future__ import annotations

import numpy as np

from dae_ros.errors import Refused
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.groups import join
from dae_ros.rollout.lockstep import check_run
from dae_ros.types import Action, JointState, Observation, RolloutRequest, SharedReward, Stamp, Trajectory, WorldSpec

OPEN_EPISODES = 3  # an older one that is not whole will never be


class _Episode:
    """One episode on its way: a rollout of one world, of which each robot says itself what it saw."""

    def __init__(self, spec: WorldSpec, request: RolloutRequest):
        self.assembler = Assembler(spec, 1)
        self.assembler.begin(request)
        self.versions: set[int] = set()  # of the policies that acted
        T, N = request.num_steps, spec.num_agents
        self._values = np.zeros((T, N, spec.observation_size), np.float32)
        self._seen = np.zeros((T, N), bool)
        self._begun = np.zeros((T, N), bool)  # who remembered nothing at a step

    def on_observation(self, observation: Observation) -> None:
        """Takes in what a robot of the team saw at a step of the episode."""
        step, robot = observation.stamp.step, observation.robot
        self._values[step, robot] = observation.values[0]
        self._seen[step, robot], self._begun[step, robot] = True, observation.episode_start[0]

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self.assembler.complete and not self._lacks.any()

    @property
    def _lacks(self) -> np.ndarray:
        """Of whom something is missing, [T, N] bool."""
        return self.assembler.lacks_actions | (self.assembler.asked & ~self._seen)

    def settle(self) -> None:
        """Has robots leave where they fell silent to the end, or began anew in the middle. Any other gap stays a hole."""
        lacks, in_the_middle = self._lacks, np.arange(len(self._seen)) > 0
        broken = lacks | (self.assembler.asked & self._begun & in_the_middle[:, None])
        for robot in np.flatnonzero(broken.any(axis=0)):
            first = int(np.argmax(broken[:, robot]))
            back = np.flatnonzero(self._seen[first + 1:, robot])
            if not lacks[first, robot] or not back.size or self._begun[first + 1 + back[0], robot]:
                self.assembler.leave(int(robot), first)

    def trajectory(self) -> Trajectory | None:
        """The episode, if nothing is missing and somebody was always there."""
        if not self.complete or not self.assembler.asked.any(axis=1).all():
            return None
        trajectory = self.assembler.trajectory()
        np.copyto(trajectory.observations, self._values[:, None], where=self._seen[:, None, :, None])
        return trajectory


class StreamAssembler:
    """Collects episodes of `num_steps` until there are `num_episodes` whole ones.

    What a robot saw is taken from the robot, since its probabilities belong to that; the state from whoever sees everything.
    """

    def __init__(self, spec: WorldSpec, num_episodes: int, num_steps: int, run: int, max_staleness: int):
        self.holed = 0  # episodes dropped for a hole
        self.stale = 0  # whole episodes dropped for too old a policy
        self.left = 0   # whole episodes which somebody left
        self._spec, self._num_episodes, self._num_steps = spec, num_episodes, num_steps
        self._run, self._max_staleness = run, max_staleness
        self._open: dict[int, _Episode] = {}
        self._closed: int | None = None  # no episode up to this one is taken any more
        self._whole: list[tuple[int, Trajectory]] = []  # with the oldest version that acted
        self._oldest_version = 0  # that is taken

    @property
    def complete(self) -> bool:
        return len(self._whole) >= self._num_episodes

    def missing(self) -> str:
        """What has not arrived, for people."""
        return f'{self._num_episodes - len(self._whole)} of {self._num_episodes} episodes'

    def trajectory(self) -> Trajectory:
        """The oldest whole episodes side by side, [num_steps, num_episodes, ...]; they are taken out."""
        taken, self._whole = self._whole[:self._num_episodes], self._whole[self._num_episodes:]
        return join(_with_members([trajectory for _, trajectory in taken]))

    def begin(self, policy_version: int) -> None:
        """From here on the newest policy has this version; what lies waiting and is too stale by now is dropped."""
        self._oldest_version = policy_version - self._max_staleness
        fresh = [episode for episode in self._whole if episode[0] >= self._oldest_version]
        self.stale += len(self._whole) - len(fresh)
        self._whole = fresh

    def on_action(self, action: Action) -> None:
        """Takes in a robot's action. Raises Refused, as all that follow."""
        if action.policy_version < self._oldest_version:
            raise Refused(Refused.STALE, f'policy version {action.policy_version}, at least {self._oldest_version} is needed')
        episode = self._episode(action.stamp)
        episode.assembler.on_action(action._replace(policy_version=0))
        episode.versions.add(action.policy_version)
        self._close_if_whole(action.stamp.rollout)

    def on_observation(self, observation: Observation) -> None:
        """Takes in what a robot saw."""
        stamp, size = observation.stamp, self._spec.observation_size
        if observation.robot >= self._spec.num_agents:
            raise Refused(Refused.WRONG_ROBOT, f'robot {observation.robot} of a team of {self._spec.num_agents}')
        if observation.values.shape != (1, size):
            raise Refused(Refused.WRONG_SHAPE, f'observations {observation.values.shape}, expected {(1, size)}')
        if stamp.step >= self._num_steps:
            raise Refused(Refused.OUT_OF_RANGE, f'step {stamp.step} of an episode of {self._num_steps}')
        if not np.isfinite(observation.values).all():
            raise Refused(Refused.NOT_FINITE, 'an observation is not finite')
        self._episode(stamp).on_observation(observation)
        self._close_if_whole(stamp.rollout)

    def on_joint_state(self, joint: JointState) -> None:
        """Takes in the state of a step; step `num_steps` is what the episode ended with."""
        self._episode(joint.stamp).assembler.on_joint_state(joint)
        self._close_if_whole(joint.stamp.rollout)

    def on_reward(self, shared: SharedReward) -> None:
        """Takes in the reward of a step."""
        self._episode(shared.stamp).assembler.on_reward(shared)
        self._close_if_whole(shared.stamp.rollout)

    def _episode(self, stamp: Stamp) -> _Episode:
        check_run(stamp.run, self._run)
        rollout = stamp.rollout
        if self._closed is not None and rollout <= self._closed:
            raise Refused(Refused.STALE, f'episode {rollout} is closed')
        if rollout not in self._open:
            request = RolloutRequest(self._run, rollout, stamp.attempt, 0, 0, self._num_steps, False)
            self._open[rollout] = _Episode(self._spec, request)
            while len(self._open) > OPEN_EPISODES:
                self._close(min(self._open))
            if rollout not in self._open:
                raise Refused(Refused.STALE, f'episode {rollout} is older than those under way')
        return self._open[rollout]

    def _close_if_whole(self, rollout: int) -> None:
        episode = self._open.get(rollout)
        if episode is not None and episode.complete:
            self._close(rollout)

    def _close(self, rollout: int) -> None:
        """Takes what is whole of the episodes up to this one; nothing more of them is waited for."""
        for older in sorted(other for other in self._open if other <= rollout):
            episode = self._open.pop(older)
            episode.settle()
            trajectory = episode.trajectory()
            if trajectory is None:
                self.holed += 1
                continue
            self.left += trajectory.present is not None
            self._whole.append((min(episode.versions), trajectory))
        self._closed = rollout


def _with_members(episodes: list[Trajectory]) -> list[Trajectory]:
    """The same; where somebody left one of them, all say who was present."""
    if all(episode.present is None for episode in episodes):
        return episodes
    return [episode if episode.present is not None else episode._replace(present=np.ones(episode.actions.shape, bool))
            for episode in episodes]
