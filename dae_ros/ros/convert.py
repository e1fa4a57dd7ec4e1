"""The only place where messages become arrays and arrays become messages.

Arrays go into message fields as `array.array`, which rclpy copies whole; lists and numpy arrays it copies element by
element. What comes in is checked for its sizes before it is given a shape; `Refused` says what was wrong.
"""

from __future__ import annotations

import math
from array import array

import numpy as np
from dae_ros_msgs import msg

from dae_ros.errors import Refused
from dae_ros.types import Action, JointState, Observation, PolicyWeights, RolloutRequest, SharedReward, Stamp
from dae_ros.weights.codec import check_size

MAX_VALUES = 2**40  # of an array; no message comes near it
_TYPECODES = {'f': np.float32, 'B': np.uint8, 'H': np.uint16}


def _field(typecode: str, values: np.ndarray) -> array:
    field = array(typecode)
    field.frombytes(np.ascontiguousarray(values, _TYPECODES[typecode]).tobytes())
    return field


def _array(field: array, *shape: int) -> np.ndarray:
    """The field's values in `shape`; a view, which keeps the message's memory alive."""
    size = math.prod(shape)
    if len(field) != size or math.prod(filter(None, shape)) > MAX_VALUES:  # numpy counts so, also where there are none
        raise Refused(Refused.WRONG_SHAPE, f'{len(field)} values where the message says {" x ".join(map(str, shape))}')
    if not size:
        return np.empty(shape, _TYPECODES[field.typecode])
    return np.frombuffer(field, _TYPECODES[field.typecode]).reshape(shape)


def _flags(field: array, *shape: int) -> np.ndarray:
    return _array(field, *shape) != 0


def _optional_flags(field: array, *shape: int) -> np.ndarray | None:
    """Flags of which there are none where they say nothing."""
    return _flags(field, *shape) if len(field) else None


def _optional_field(values: np.ndarray | None) -> array:
    return array('B') if values is None else _field('B', values)


def _stamp_message(stamp: Stamp) -> msg.Stamp:
    return msg.Stamp(run=stamp.run, rollout=stamp.rollout, attempt=stamp.attempt, step=stamp.step)


def _stamp(message: msg.Stamp) -> Stamp:
    return Stamp(message.run, message.rollout, message.attempt, message.step)


def observation_message(observation: Observation) -> msg.Observation:
    num_worlds, size = observation.values.shape
    return msg.Observation(stamp=_stamp_message(observation.stamp), robot=observation.robot,
                           policy_version=observation.policy_version, num_worlds=num_worlds, observation_size=size,
                           num_actions=0 if observation.available is None else observation.available.shape[1],
                           episode_start=_field('B', observation.episode_start), values=_field('f', observation.values),
                           available=_optional_field(observation.available), present=_optional_field(observation.present))


def observation(message: msg.Observation) -> Observation:
    W, O = message.num_worlds, message.observation_size
    return Observation(_stamp(message.stamp), message.robot, message.policy_version, _flags(message.episode_start, W),
                       _array(message.values, W, O), _optional_flags(message.available, W, message.num_actions),
                       _optional_flags(message.present, W))


def action_message(action: Action) -> msg.Action:
    num_worlds, num_actions = action.probabilities.shape
    return msg.Action(stamp=_stamp_message(action.stamp), robot=action.robot, policy_version=action.policy_version,
                      num_worlds=num_worlds, num_actions=num_actions, actions=_field('H', action.actions),
                      probabilities=_field('f', action.probabilities))


def action(message: msg.Action) -> Action:
    W, A = message.num_worlds, message.num_actions
    return Action(_stamp(message.stamp), message.robot, message.policy_version, _array(message.actions, W),
                  _array(message.probabilities, W, A))


def joint_state_message(joint: JointState, state_is_observations: bool) -> msg.JointState:
    W, N, O = joint.observations.shape
    state = np.empty(0) if state_is_observations else joint.state
    return msg.JointState(stamp=_stamp_message(joint.stamp), num_worlds=W, num_agents=N, observation_size=O,
                          state_size=joint.state.shape[1], num_actions=0 if joint.available is None else joint.available.shape[2],
                          episode_start=_field('B', joint.episode_start), observations=_field('f', joint.observations),
                          state=_field('f', state), available=_optional_field(joint.available),
                          present=_optional_field(joint.present))


def joint_state(message: msg.JointState) -> JointState:
    W, N, O, S = message.num_worlds, message.num_agents, message.observation_size, message.state_size
    observations = _array(message.observations, W, N, O)
    state = _array(message.state, W, S) if len(message.state) else _array(message.observations, W, S)
    return JointState(_stamp(message.stamp), _flags(message.episode_start, W), observations, state,
                      _optional_flags(message.available, W, N, message.num_actions), _optional_flags(message.present, W, N))


def shared_reward_message(shared: SharedReward) -> msg.SharedReward:
    return msg.SharedReward(stamp=_stamp_message(shared.stamp), num_worlds=len(shared.reward),
                            state_size=shared.final_states.shape[1], reward=_field('f', shared.reward),
                            terminated=_field('B', shared.terminated), truncated=_field('B', shared.truncated),
                            final_states=_field('f', shared.final_states), won=_optional_field(shared.won))


def shared_reward(message: msg.SharedReward) -> SharedReward:
    W, S = message.num_worlds, message.state_size
    truncated = _flags(message.truncated, W)
    return SharedReward(_stamp(message.stamp), _array(message.reward, W), _flags(message.terminated, W), truncated,
                        _array(message.final_states, int(truncated.sum()), S), _optional_flags(message.won, W))


def rollout_request_message(request: RolloutRequest) -> msg.RolloutRequest:
    return msg.RolloutRequest(**request._asdict())


def rollout_request(message: msg.RolloutRequest) -> RolloutRequest:
    if message.num_steps == 0:
        raise Refused(Refused.OUT_OF_RANGE, 'a rollout of 0 steps')
    return RolloutRequest(message.run, message.rollout, message.attempt, message.policy_version, message.seed,
                          message.num_steps, message.greedy)


def policy_weights_message(weights: PolicyWeights) -> msg.PolicyWeights:
    data = array('B')
    data.frombytes(weights.data)
    return msg.PolicyWeights(run=weights.run, version=weights.version, sha256=weights.sha256, data=data,
                             signature=weights.signature)


def policy_weights(message: msg.PolicyWeights) -> PolicyWeights:
    check_size(len(message.data))
    return PolicyWeights(message.run, message.version, message.sha256, bytes(message.data), message.signature)
