"""The trainer's end of streaming collection: robots act at their own rate, with whatever policy they hold, and steps get lost.

Episodes are joined on the stamps, which the clock gave. One that is whole counts; so many of them side by side make a
trajectory. One with a hole is dropped, for its recurrent states and its returns cannot be told, and so is one that was acted
with too old a policy.
"""

from __future__ import annotations

from typing import NamedTuple

from dae_ros.errors import Refused
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.groups import join
from dae_ros.rollout.lockstep import check_run
from dae_ros.types import Action, JointState, Observation, RolloutRequest, SharedReward, Stamp, Trajectory, WorldSpec

OPEN_EPISODES = 3  # an older one that is not whole will never be


class _Episode(NamedTuple):
    """One episode on its way: a rollout of one world."""

    assembler: Assembler
    joint_states: dict[int, JointState]                # by step, those whose observations are not all there
    observations: dict[tuple[int, int], Observation]   # by step and robot
    versions: set[int]                                 # of the policies that acted


class StreamAssembler:
    """Collects episodes of `num_steps` until there are `num_episodes` whole ones.

    What a robot saw is taken from the robot, since its probabilities belong to that; the state from whoever sees everything.
    """

    def __init__(self, spec: WorldSpec, num_episodes: int, num_steps: int, run: int, max_staleness: int):
        self.holed = 0  # episodes dropped for a hole
        self.stale = 0  # whole episodes dropped for too old a policy
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
        return join([trajectory for _, trajectory in taken])

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
        episode = self._episode(stamp)
        episode.observations[stamp.step, observation.robot] = observation
        self._take_joint_state(episode, stamp)

    def on_joint_state(self, joint: JointState) -> None:
        """Takes in the state of a step; step `num_steps` is what the episode ended with."""
        episode = self._episode(joint.stamp)
        if joint.stamp.step == self._num_steps:
            episode.assembler.on_joint_state(joint)
        else:
            episode.joint_states[joint.stamp.step] = joint
            self._take_joint_state(episode, joint.stamp)
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
            assembler = Assembler(self._spec, 1)
            assembler.begin(RolloutRequest(self._run, rollout, stamp.attempt, 0, 0, self._num_steps, False))
            self._open[rollout] = _Episode(assembler, {}, {}, set())
            while len(self._open) > OPEN_EPISODES:
                self._close(min(self._open))
                self.holed += 1
            if rollout not in self._open:
                raise Refused(Refused.STALE, f'episode {rollout} is older than those under way')
        return self._open[rollout]

    def _take_joint_state(self, episode: _Episode, stamp: Stamp) -> None:
        """Joins the state of a step with what each robot saw, once all of it is there."""
        joint, robots = episode.joint_states.get(stamp.step), range(self._spec.num_agents)
        if joint is None or any((stamp.step, robot) not in episode.observations for robot in robots):
            return
        del episode.joint_states[stamp.step]
        seen = joint.observations.copy()
        for robot in robots:
            seen[0, robot] = episode.observations[stamp.step, robot].values[0]
        episode.assembler.on_joint_state(joint._replace(observations=seen))
        self._close_if_whole(stamp.rollout)

    def _close_if_whole(self, rollout: int) -> None:
        episode = self._open.get(rollout)
        if episode is not None and episode.assembler.complete:
            self._whole.append((min(episode.versions), episode.assembler.trajectory()))
            self._close(rollout)

    def _close(self, rollout: int) -> None:
        del self._open[rollout]
        for older in [other for other in self._open if other < rollout]:
            del self._open[older]
            self.holed += 1
        self._closed = rollout


