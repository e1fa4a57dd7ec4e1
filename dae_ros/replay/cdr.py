"""Our messages as they lie in a bag, CDR, made into arrays without ROS.

Each begins with its numbers, which lie as CDR aligns them without any gap, and ends with its arrays. Lengths are checked
before anything is given a shape; `Refused` says what was wrong. The arrays are views of the message's bytes.
"""

from __future__ import annotations

import struct
from typing import Callable, NamedTuple, Union

import numpy as np

from dae_ros.config import SETTINGS
from dae_ros.errors import Refused
from dae_ros.types import Action, JointState, RolloutRequest, SharedReward, Stamp

Data = Union[bytes, memoryview]
Datum = Union[JointState, Action, SharedReward, RolloutRequest]

_LITTLE_ENDIAN = b'\x00\x01'
_ENCAPSULATION = 4  # bytes before the message, which its alignment does not count
_LENGTH = struct.Struct('<I')
_F, _H, _B = np.dtype('<f4'), np.dtype('<u2'), np.dtype('u1')


class _Layout:
    """Numbers, then arrays."""

    def __init__(self, numbers: str, *arrays: np.dtype):
        self._numbers = struct.Struct('<' + numbers)
        self._arrays = arrays

    def read(self, data: Data) -> tuple[tuple, list[np.ndarray]]:
        """Numbers and flat arrays of a message."""
        body = memoryview(data)[_ENCAPSULATION:]
        if len(body) < self._numbers.size or data[:2] != _LITTLE_ENDIAN:
            raise Refused(Refused.CORRUPT, f'{len(data)} bytes that are no message of this type')
        arrays, offset = [], self._numbers.size
        for dtype in self._arrays:
            offset += -offset % _LENGTH.size
            if offset + _LENGTH.size > len(body):
                raise Refused(Refused.CORRUPT, f'a message that ends after {len(data)} bytes')
            (length,) = _LENGTH.unpack_from(body, offset)
            offset += _LENGTH.size
            if length * dtype.itemsize > len(body) - offset:
                raise Refused(Refused.CORRUPT, f'{length} values in a message of {len(data)} bytes')
            arrays.append(np.frombuffer(body, dtype, length, offset) if length else np.empty(0, dtype))
            offset += length * dtype.itemsize
        return self._numbers.unpack_from(body), arrays


_JOINT_STATE = _Layout('QIIIIIIII', _B, _F, _F, _B, _B)
_ACTION = _Layout('QIIIIQII', _H, _F)
_SHARED_REWARD = _Layout('QIIIII', _F, _B, _B, _F, _B)
_ROLLOUT_REQUEST = _Layout('QIIQQI?')


def _shaped(values: np.ndarray, *shape: int) -> np.ndarray:
    size = 1
    for length in shape:
        size *= length
    if len(values) != size:
        raise Refused(Refused.WRONG_SHAPE, f'{len(values)} values where the message says {" x ".join(map(str, shape))}')
    return values.reshape(shape)


def _optional_flags(values: np.ndarray, *shape: int) -> np.ndarray | None:
    return _shaped(values, *shape) != 0 if len(values) else None


def joint_state(data: Data) -> JointState:
    (*stamp, W, N, O, S, A), (episode_start, observations, state, available, present) = _JOINT_STATE.read(data)
    return JointState(Stamp(*stamp), _shaped(episode_start, W) != 0, _shaped(observations, W, N, O),
                      _shaped(state if len(state) else observations, W, S), _optional_flags(available, W, N, A),
                      _optional_flags(present, W, N))


def action(data: Data) -> Action:
    (*stamp, robot, policy_version, W, A), (actions, probabilities) = _ACTION.read(data)
    return Action(Stamp(*stamp), robot, policy_version, _shaped(actions, W), _shaped(probabilities, W, A))


def shared_reward(data: Data) -> SharedReward:
    (*stamp, W, S), (reward, terminated, truncated, final_states, won) = _SHARED_REWARD.read(data)
    truncated = _shaped(truncated, W) != 0
    return SharedReward(Stamp(*stamp), _shaped(reward, W), _shaped(terminated, W) != 0, truncated,
                        _shaped(final_states, int(truncated.sum()), S), _optional_flags(won, W))


def rollout_request(data: Data) -> RolloutRequest:
    request = RolloutRequest(*_ROLLOUT_REQUEST.read(data)[0])
    if not 0 < request.num_steps <= SETTINGS['num_steps'].maximum:
        raise Refused(Refused.OUT_OF_RANGE, f'a rollout of {request.num_steps} steps')
    return request


class MessageType(NamedTuple):
    """One type of message that rollouts are made of."""

    rihs01: str  # REP 2011's hash of the definition that `decode` reads
    decode: Callable[[Data], Datum]


MESSAGE_TYPES = {
    'dae_ros_msgs/msg/JointState': MessageType(
        'RIHS01_9be7572b564d14a11148a3cb68770b8547fc61d28cf0199c934ac00aa101ecd0', joint_state),
    'dae_ros_msgs/msg/Action': MessageType(
        'RIHS01_5f0753427771899ac703152b8fe4f4a9340f8bdbcd9a678c9af3da1f444decd9', action),
    'dae_ros_msgs/msg/SharedReward': MessageType(
        'RIHS01_03b9f6721c8344cbe63df4fa7de23e507c9ed8abf0335a70fea4ac397a7c7fbe', shared_reward),
    'dae_ros_msgs/msg/RolloutRequest': MessageType(
        'RIHS01_2d08795b1f2c544c880fd05540fbb505915d8c3ea53ff43efdf4e4655f28f52e', rollout_request),
}
