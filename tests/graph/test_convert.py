"""Messages and arrays: what goes in comes out, and a message whose sizes do not add up is refused."""

from __future__ import annotations

import math
from array import array

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from dae_ros_msgs import msg
from hypothesis import example, given, settings, strategies
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message

from dae_ros.errors import Refused
from dae_ros.robots import standard_messages
from dae_ros.robots.geometry import Pose, turned
from dae_ros.ros import convert
from dae_ros.types import Action, JointState, Observation, PolicyWeights, RolloutRequest, SharedReward, Stamp
from dae_ros.weights.codec import MAX_POLICY_BYTES

STAMP = Stamp(run=7, rollout=3, attempt=1, step=24)
RNG = np.random.default_rng(0)
W, N, O, A, S = 4, 3, 6, 5, 7


def same(first, second) -> None:
    assert type(first) is type(second)
    for one, other in zip(first, second):
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and one.shape == other.shape
            np.testing.assert_array_equal(one, other)
        else:
            assert one == other


def rows(*shape: int) -> np.ndarray:
    return RNG.standard_normal(shape).astype(np.float32)


def flags(*values: int) -> np.ndarray:
    return np.array(values, bool)


def test_every_kind_of_datum_survives_the_trip_through_its_message():
    observation = Observation(STAMP, 2, 5, flags(1, 0, 1, 0), rows(W, O))
    same(convert.observation(convert.observation_message(observation)), observation)
    action = Action(STAMP, 2, 5, np.array([0, 4, 3, 1], np.uint16), rows(W, A))
    same(convert.action(convert.action_message(action)), action)
    joint = JointState(STAMP, flags(0, 0, 0, 1), rows(W, N, O), rows(W, S))
    same(convert.joint_state(convert.joint_state_message(joint, False)), joint)
    reward = SharedReward(STAMP, rows(W), flags(0, 1, 0, 0), flags(1, 0, 0, 1), rows(2, S))
    same(convert.shared_reward(convert.shared_reward_message(reward)), reward)
    request = RolloutRequest(7, 3, 1, 5, 2**63, 25, True)
    same(convert.rollout_request(convert.rollout_request_message(request)), request)
    weights = PolicyWeights(7, 5, 'ab', b'\x00\xff1', 'cd')
    same(convert.policy_weights(convert.policy_weights_message(weights)), weights)


def test_a_state_that_is_the_observations_is_not_sent_twice():
    observations = rows(W, N, O)
    joint = JointState(STAMP, flags(1, 1, 1, 1), observations, observations.reshape(W, N * O))
    message = convert.joint_state_message(joint, True)
    assert len(message.state) == 0
    same(convert.joint_state(message), joint)


@pytest.mark.parametrize('changes', [
    {'num_worlds': W + 1}, {'num_worlds': 0}, {'observation_size': 2**32 - 1}, {'values': array('f')},
    {'episode_start': array('B', [1])},
])
def test_sizes_that_do_not_add_up_are_refused_before_anything_is_allocated(changes):
    message = convert.observation_message(Observation(STAMP, 2, 5, flags(1, 0, 1, 0), rows(W, O)))
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(Refused) as refusal:
        convert.observation(message)
    assert refusal.value.reason == Refused.WRONG_SHAPE


def test_an_empty_message_of_any_kind_is_refused_or_empty_but_never_a_crash():
    for name in ('Observation', 'Action', 'JointState', 'SharedReward', 'RolloutRequest', 'PolicyWeights'):
        lower = ''.join(f'_{letter.lower()}' if letter.isupper() else letter for letter in name).lstrip('_')
        try:
            getattr(convert, lower)(getattr(msg, name)())
        except Refused:
            pass


KINDS = {'observation': msg.Observation, 'action': msg.Action, 'joint_state': msg.JointState, 'shared_reward': msg.SharedReward,
         'rollout_request': msg.RolloutRequest, 'policy_weights': msg.PolicyWeights}
SIZES = strategies.sampled_from([0, 1, 2, 3, 255, 2**16, 2**31, 2**32 - 1])


@strategies.composite
def any_messages(draw):
    """A kind of message and one of that kind, with any sizes and any values, often such that some of them fit."""
    name = draw(strategies.sampled_from(list(KINDS)))
    message = KINDS[name]()
    small = draw(strategies.lists(strategies.integers(0, 3), min_size=4, max_size=4))
    for number, (field, kind) in enumerate(message.get_fields_and_field_types().items()):
        value = getattr(message, field)
        if isinstance(value, array):
            length = draw(strategies.sampled_from([0, *small, small[0] * small[1], small[0] * small[1] * small[2]]))
            setattr(message, field, array(value.typecode, draw(strategies.binary(min_size=length * value.itemsize,
                                                                                 max_size=length * value.itemsize))))
        elif kind == 'uint32':
            setattr(message, field, draw(strategies.sampled_from(small) | SIZES))
        elif kind == 'string':
            setattr(message, field, draw(strategies.text(max_size=70)))
    return name, message


@settings(max_examples=200, deadline=None, derandomize=True)
@given(any_messages())
@example(('joint_state', msg.JointState(num_agents=2**32 - 1, observation_size=2**32 - 1)))
def test_any_message_becomes_arrays_of_the_sizes_it_says_or_is_refused(named):
    name, message = named
    try:
        datum = getattr(convert, name)(message)
    except Refused as refusal:
        assert refusal.reason in (Refused.WRONG_SHAPE, Refused.OUT_OF_RANGE)
    else:
        assert all(part.size <= 81 for part in datum if isinstance(part, np.ndarray))


def test_weights_larger_than_any_policy_are_refused_before_they_are_copied(monkeypatch):
    message = msg.PolicyWeights(data=array('B', bytes(MAX_POLICY_BYTES + 1)))
    monkeypatch.setattr(convert, 'bytes', lambda _: pytest.fail('copied'), raising=False)
    with pytest.raises(Refused) as refusal:
        convert.policy_weights(message)
    assert refusal.value.reason == Refused.OVERSIZED


POSE = Pose((1.5, -2.5), 0.5, (0.3, 0.4), 12.25)


@pytest.mark.parametrize('world_frame', ['map', 'm', 'ma', 'odom', 'a/longer/one'])
@pytest.mark.parametrize('child_frame', ['', 'b', 'base', 'robot_1/base_link', None])
def test_odometry_is_read_from_its_bytes_as_from_the_message(world_frame, child_frame):
    child_frame = world_frame if child_frame is None else child_frame
    message = deserialize_message(standard_messages.odometry_data(POSE, 0.7, world_frame, child_frame), Odometry)
    message.pose.covariance[:], message.twist.covariance[:] = 3.0, 4.0
    message.pose.pose.position.z = message.twist.twist.linear.z = 9.0
    data = serialize_message(message)
    assert standard_messages.odometry_in(data, world_frame) == (standard_messages.odometry(message, world_frame), child_frame)


@pytest.mark.parametrize('world_frame, child_frame', [('map', 'robot_1/base_link'), ('m', ''), ('odom', 'abc')])
def test_odometry_is_written_as_ros_serialises_it(world_frame, child_frame):
    message = Odometry(child_frame_id=child_frame)
    message.header.frame_id, message.header.stamp = world_frame, Time(sec=12, nanosec=250_000_000)
    place, body, turn = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist
    (place.x, place.y), (body.z, body.w) = POSE.position, (math.sin(0.25), math.cos(0.25))
    turn.linear.x, turn.linear.y = turned(POSE.velocity, -POSE.heading)
    turn.angular.z = 0.7
    assert standard_messages.odometry_data(POSE, 0.7, world_frame, child_frame) == serialize_message(message)


def test_bytes_that_are_no_odometry_are_refused():
    data, world_frame = standard_messages.odometry_data(POSE, 0.7, 'map', 'base'), 'map'
    for wrong in [data[:length] for length in range(len(data))] + [b'\0\0' + data[2:], data[:12] + b'\xff' * (len(data) - 12)]:
        with pytest.raises(Refused) as refused:
            standard_messages.odometry_in(wrong, world_frame)
        assert refused.value.reason in (Refused.CORRUPT, Refused.WRONG_FRAME)
