"""A team with a key takes its own trainer's weights and nobody else's; one without is told where that is dangerous."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from dae_ros_msgs.msg import PolicyWeights
from dae_ros_msgs.srv import GetPolicy
from harness import SMALL, Listener, Refusals, oracle
from test_parameters import start

from dae_ros.learning.policy import Policy
from dae_ros.ros import convert, names, qos
from dae_ros.ros.trust import UNSIGNED, reaches_beyond_this_host
from dae_ros.weights.codec import decode_policy, encode_policy, open_weights, seal

VALUES = {**SMALL, 'total_steps': 12 * 8 * 25, 'robots_per_process': 1}
KEY, OTHER_KEY = os.urandom(32), os.urandom(32)


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / 'team.key'
    path.touch(0o600)
    path.write_bytes(KEY)
    return str(path)


def strangers_weights(genuine: PolicyWeights) -> list[PolicyWeights]:
    """Weights that are whole and of the right run and would lead the team astray: unsigned, or signed in every wrong way."""
    policy = decode_policy(bytes(genuine.data))
    zero = encode_policy(Policy(policy.architecture, {name: np.zeros_like(value) for name, value in policy.tensors.items()}))
    taken = convert.policy_weights(genuine)
    later = [seal(taken.run, version, zero, key) for version in (taken.version, taken.version + 1, 2**63)
             for key in (None, OTHER_KEY)]
    moved = [taken._replace(version=taken.version + 1), taken._replace(version=2**63),
             later[0]._replace(signature=taken.signature), seal(taken.run + 1, 2**62, zero, KEY)._replace(run=taken.run)]
    return [convert.policy_weights_message(weights) for weights in later + moved]


def test_weights_that_the_team_s_trainer_did_not_sign_are_refused_by_all_and_a_server_that_comes_back_serves_signed_ones(
        make_graph, key_file, tmp_path):
    graph = make_graph(tmp_path / 'graph', VALUES, key_file=key_file)
    with Listener() as listener:
        heard: list[PolicyWeights] = []
        listener.node.create_subscription(PolicyWeights, names.POLICY, heard.append, qos.LATCHED_INPUT)
        strangers = [listener.node.create_publisher(PolicyWeights, topic, qos.LATCHED_INPUT)
                     for topic in (names.POLICY, names.POLICY_UPDATE)]
        refusals = Refusals(listener)
        graph.start(*graph.names)
        listener.spin_until(lambda: heard and all(stranger.get_subscription_count() for stranger in strangers))
        for message in strangers_weights(heard[-1]):
            for stranger in strangers:
                stranger.publish(message)
        wanted = {('/parameter_server', 'policy_update', 'forged'), *((f'/agent_{i}', 'policy', 'forged') for i in range(3))}
        listener.spin_until(lambda: wanted <= refusals.counted.keys(), lambda: f'not counted: {wanted - refusals.counted.keys()}')
        listener.spin_until(lambda: heard[-1].version >= 3)
        strangers[1].publish(heard[0])  # genuine, but old: it takes the newest one's place for who comes now
        graph.kill('parameter_server', 'agent_1')
        graph.start('agent_1', 'parameter_server')
        assert graph.wait() == 0, graph.log('trainer')
        newest = listener.call(GetPolicy, names.GET_POLICY, GetPolicy.Request(version=2**64 - 1)).policy
        assert newest.version == 12
        open_weights(convert.policy_weights(newest), KEY)
    assert graph.result() == oracle(tmp_path / 'alone', VALUES)
    assert not any('Traceback' in graph.log(name) for name in graph.names)


@pytest.mark.parametrize('discovery, beyond', [
    ({}, True), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, True), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, False),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT'}, True),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT', 'FASTRTPS_DEFAULT_PROFILES_FILE': '/x/fastdds_this_host.xml'}, False),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, False), ({'ROS_LOCALHOST_ONLY': '1'}, False), ({'ROS_LOCALHOST_ONLY': '0'}, True),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_STATIC_PEERS': '192.0.2.1'}, True),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DISCOVERY_SERVER': '192.0.2.1:11811'}, True)], ids=str)
def test_it_is_known_whether_strangers_can_reach_a_node(discovery, beyond):
    assert reaches_beyond_this_host(discovery) == beyond


@pytest.mark.parametrize('reach, key, warned', [('SUBNET', False, True), ('SUBNET', True, False), ('LOCALHOST', False, False)])
def test_a_node_without_a_key_warns_where_strangers_can_reach_it(reach, key, warned, domain, key_file, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', reach)
    process = start('agent', *(['-p', f'key_file:={key_file}'] if key else []))
    with Listener() as listener:
        listener.spin_until(lambda: '/policy' in dict(listener.node.get_topic_names_and_types()))
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert (UNSIGNED in errors) == warned and 'Traceback' not in errors
