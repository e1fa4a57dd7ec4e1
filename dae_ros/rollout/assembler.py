"""Joins one group's stamped joint states, actions and rewards into a trajectory, in whatever order they arrive."""

from __future__ import annotations

import numpy as np

from dae_ros.errors import Refused
from dae_ros.rollout.lockstep import check_action, check_available, check_stamp
from dae_ros.types import Action, JointState, RolloutRequest, SharedReward, Trajectory, WorldSpec


class Assembler:
    """Collects the rollout of one request; data of any other are refused and change nothing."""

    def __init__(self, spec: WorldSpec, num_worlds: int):
        self._spec = spec
        self._num_worlds = num_worlds
        self.request: RolloutRequest | None = None

    def begin(self, request: RolloutRequest) -> None:
        """Forget what was collected and collect the rollout of `request`."""
        T, W, (N, A, O, S, *_) = request.num_steps, self._num_worlds, self._spec
        self.request = request
        self._observations = np.empty((T, W, N, O), np.float32)
        self._states = np.empty((T + 1, W, S), np.float32)
        self._episode_start = np.empty((T + 1, W), bool)
        self._actions = np.empty((T, W, N), np.int64)
        self._probabilities = np.empty((T, W, N, A), np.float32)
        self._rewards = np.empty((T, W), np.float32)
        self._terminated = np.empty((T, W), bool)
        self._truncated = np.empty((T, W), bool)
        # What most tasks never say anything of is there from the first word about it.
        self._available: np.ndarray | None = None
        self._present: np.ndarray | None = None
        self._won: np.ndarray | None = None
        self._final_states: dict[int, np.ndarray] = {}
        self._have_state = np.zeros(T + 1, bool)
        self._have_action = np.zeros((T, N), bool)
        self.asked = np.ones((T, N), bool)  # whose action a step needs

    @property
    def complete(self) -> bool:
        """Whether nothing of the rollout is missing."""
        return (self.request is not None and bool(self._have_state.all()) and not self.lacks_actions.any()
                and len(self._final_states) == self.request.num_steps)

    @property
    def lacks_actions(self) -> np.ndarray:
        """Whose actions are missing, [T, N] bool: not those of robots that had left everywhere."""
        return self.asked & ~self._have_action

    def missing(self) -> str:
        """What has not arrived, for people."""
        if self.request is None:
            return 'nothing was requested'
        T = self.request.num_steps
        silent = [str(robot) for robot in np.flatnonzero(self.lacks_actions.any(axis=0))]
        return (f'{T + 1 - self._have_state.sum()} of {T + 1} joint states, {T - len(self._final_states)} of {T} rewards, '
                f'actions of {"robots " + ", ".join(silent) if silent else "no robot"}')

    def on_joint_state(self, joint: JointState) -> None:
        """Takes in the state of one step."""
        step, request = joint.stamp.step, self._check(joint.stamp, last=1)
        W, (N, A, O, S, *_) = self._num_worlds, self._spec
        _check_shapes((joint.observations, (W, N, O)), (joint.state, (W, S)), (joint.episode_start, (W,)),
                      (joint.available, (W, N, A)), (joint.present, (W, N)))
        _check_finite(joint.observations, joint.state)
        check_available(joint.available)
        if self._have_state[step]:
            raise Refused(Refused.DUPLICATE, f'joint state of step {step}')
        if step < request.num_steps:
            self._observations[step] = joint.observations
            self._take_flags(step, joint)
        self._states[step] = joint.state
        self._episode_start[step] = joint.episode_start
        self._have_state[step] = True

    def _take_flags(self, step: int, joint: JointState) -> None:
        T, W, (N, A, *_) = self.request.num_steps, self._num_worlds, self._spec
        if joint.available is not None:
            self._available = np.ones((T, W, N, A), bool) if self._available is None else self._available
            self._available[step] = joint.available
        if joint.present is not None:
            self._present = np.ones((T, W, N), bool) if self._present is None else self._present
            self._present[step] = joint.present
            self.asked[step] = joint.present.any(axis=0)

    def leave(self, robot: int, step: int) -> None:
        """The robot counts as having left its team in all worlds from this step on, whatever came of it."""
        if self._present is None:
            self._present = np.ones((self.request.num_steps, self._num_worlds, self._spec.num_agents), bool)
        self._present[step:, :, robot] = False
        self.asked[step:, robot] = False

    def on_action(self, action: Action) -> None:
        """Takes in one robot's action of one step."""
        step, request = action.stamp.step, self._check(action.stamp)
        check_action(action, self._spec.num_agents, self._num_worlds, self._spec.num_actions, request.policy_version)
        if self._have_action[step, action.robot]:
            raise Refused(Refused.DUPLICATE, f'action of robot {action.robot} at step {step}')
        self._actions[step, :, action.robot] = action.actions
        self._probabilities[step, :, action.robot] = action.probabilities
        self._have_action[step, action.robot] = True

    def on_reward(self, shared: SharedReward) -> None:
        """Takes in the reward of one step."""
        step, W = shared.stamp.step, self._num_worlds
        self._check(shared.stamp)
        _check_shapes((shared.reward, (W,)), (shared.terminated, (W,)), (shared.truncated, (W,)), (shared.won, (W,)))
        _check_shapes((shared.final_states, (int(shared.truncated.sum()), self._spec.state_size)))
        _check_finite(shared.reward, shared.final_states)
        if (shared.terminated & shared.truncated).any():
            raise Refused(Refused.OUT_OF_RANGE, 'an episode both ended and was cut off')
        if step in self._final_states:
            raise Refused(Refused.DUPLICATE, f'reward of step {step}')
        self._rewards[step] = shared.reward
        self._terminated[step] = shared.terminated
        self._truncated[step] = shared.truncated
        self._final_states[step] = shared.final_states
        if shared.won is not None:
            self._won = np.zeros((self.request.num_steps, W), bool) if self._won is None else self._won
            self._won[step] = shared.won

    def trajectory(self) -> Trajectory:
        """The complete rollout. Its arrays are not touched by the next one."""
        assert self.complete, self.missing()
        finals = np.concatenate([self._final_states[step] for step in range(self.request.num_steps)])
        nothing = np.eye(1, self._spec.num_actions, dtype=np.float32)[0]
        for step, robot in np.argwhere(~self.asked | ~self._have_action):
            self._actions[step, :, robot], self._probabilities[step, :, robot] = 0, nothing
        return Trajectory(self._observations, self._states, self._episode_start, self._actions, self._probabilities,
                          self._rewards, self._terminated, self._truncated, finals, self._available, self._present, self._won)

    def _check(self, stamp, last: int = 0) -> RolloutRequest:
        request = self.request
        check_stamp(stamp, request, 0 if request is None else request.run)
        if stamp.step >= request.num_steps + last:
            raise Refused(Refused.OUT_OF_RANGE, f'step {stamp.step} of a rollout of {request.num_steps}')
        return request


def _check_shapes(*pairs: tuple[np.ndarray | None, tuple[int, ...]]) -> None:
    for array, expected in pairs:
        if array is not None and array.shape != expected:
            raise Refused(Refused.WRONG_SHAPE, f'shape {array.shape}, expected {expected}')


def _check_finite(*arrays: np.ndarray) -> None:
    for array in arrays:
        if not np.isfinite(array).all():
            raise Refused(Refused.NOT_FINITE, 'not every number is finite')
