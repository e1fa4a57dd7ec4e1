"""Parameters of the nodes: typed, described, range-checked; an unknown or mistyped key is an error that names it."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from harness import TIMEOUT, Listener, end
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters

NODES = ('world', 'agent', 'parameter_server', 'trainer', 'robot_bridge')


def start(node: str, *arguments: str, cwd=None) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, '-m', f'dae_ros_nodes.{node}', '--ros-args', *arguments], cwd=cwd,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def failure(node: str, *arguments: str) -> str:
    process = start(node, *arguments)
    _, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 2, errors
    assert 'Traceback' not in errors
    return errors


@pytest.mark.parametrize('node', NODES)
def test_an_unknown_key_is_an_error_that_names_it_and_the_nearest(node, domain):
    assert "unknown setting 'num_agnets'; did you mean 'num_agents'?" in failure(node, '-p', 'num_agnets:=4')


def test_an_unknown_key_in_a_parameter_file_is_an_error_too(domain, tmp_path):
    file = tmp_path / 'task.yaml'
    file.write_text('/**:\n  ros__parameters:\n    reward_network:\n      hiden_size: 16\n')
    assert "'reward_network.hiden_size'" in failure('world', '--params-file', str(file))


@pytest.mark.parametrize('node, override, sentence', [
    ('trainer', 'beta:=1.5', 'beta must lie in 0.0 .. 1.0, not 1.5'),
    ('trainer', 'epochs:=many', "epochs must be an integer, not 'many'"),
    ('world', 'num_agents:=0', 'num_agents must lie in 1 .. 1000, not 0'),
    ('world', 'beta:=true', 'beta must be a number, not True'),
    ('agent', 'robot:=first', "robot must be an integer, not 'first'"),
    ('agent', 'policy_file:=nowhere.safetensors', 'cannot read policy_file nowhere.safetensors: No such file'),
    ('agent', 'policy_file:=README.md', 'policy_file README.md is no policy'),
    ('robot_bridge', 'landmarks:="1 2, 3 4"', 'landmarks: 2 landmarks, the task has 3'),
    ('robot', 'num_agnets:=4', "unknown setting 'num_agnets'; did you mean 'num_agents'?"),
    ('robot', 'robot:=3', 'robot must lie in 0 .. 2 where num_agents is 3, not 3'),
    ('world', 'task:=soccer', "unknown task 'soccer'"),
    ('world', 'group:=1', 'group must lie in 0 .. 0 where world_groups is 1, not 1'),
    ('agent', 'group:=2', 'group must lie in 0 .. 0 where world_groups is 1, not 2'),
    ('agent', 'key_file:=missing.key', 'cannot read key_file missing.key: No such file or directory'),
    ('parameter_server', 'key_file:=/dev/null', 'key_file /dev/null must be a file of 32 to 4096 bytes that nobody can guess'),
    ('trainer', 'key_file:=/dev/null', 'key_file /dev/null must be a file of 32 to 4096 bytes that nobody can guess'),
    ('trainer', 'watched_world:=128', 'watched_world must be -1 or lie in 0 .. 127, not 128'),
    ('credit', 'world:=1', 'set reward_network_file to a file of train_reward'),
    ('trainer', 'world_groups:=3', 'num_worlds = 128 worlds cannot be split into world_groups = 3 groups of equal size'),
])
def test_a_wrong_value_is_one_sentence(node, override, sentence, domain):
    assert sentence in failure(node, '-p', override)


def test_the_agents_of_one_process_need_names_of_their_own(domain):
    assert 'the agents of 2 robots cannot all be named scout' in failure('agent', '-p', 'robots:=2', '-r', '__node:=scout')
    assert '2 nodes cannot all be named scout' in failure('robot', '-r', '__node:=scout')


def test_the_agents_of_one_process_are_nodes_with_parameters_of_their_own(domain):
    process = start('agent', '-p', 'robot:=3', '-p', 'robots:=2', '-p', 'world_groups:=2', '-p', 'group:=1')
    try:
        with Listener() as listener:
            for robot in (3, 4):
                request = GetParameters.Request(names=['robot'])
                value, = listener.call(GetParameters, f'agent_1_{robot}/get_parameters', request).values
                assert value.integer_value == robot
    finally:
        (_, errors), = end(process)
    assert process.returncode == 0 and 'Traceback' not in errors, errors


def test_parameters_are_described_ranged_and_read_only_and_an_integer_beta_is_fine(domain, tmp_path):
    process = start('trainer', '-p', 'beta:=1', '-p', f'run_folder:={tmp_path / "run"}', '-p', 'learner_threads:=1')
    try:
        with Listener() as listener:
            value, = listener.call(GetParameters, 'trainer/get_parameters', GetParameters.Request(names=['beta'])).values
            assert value.double_value == 1.0
            descriptor, = listener.call(DescribeParameters, 'trainer/describe_parameters',
                                        DescribeParameters.Request(names=['beta'])).descriptors
            assert 'credit against bias' in descriptor.description and descriptor.read_only
            assert (descriptor.floating_point_range[0].from_value, descriptor.floating_point_range[0].to_value) == (0.0, 1.0)
            change = Parameter(name='beta', value=ParameterValue(type=3, double_value=0.5))
            result, = listener.call(SetParameters, 'trainer/set_parameters', SetParameters.Request(parameters=[change])).results
            assert not result.successful
    finally:
        (_, errors), = end(process)
    assert process.returncode == 0 and 'Traceback' not in errors, errors


@pytest.mark.parametrize('node', NODES)
def test_every_node_starts_alone_with_its_defaults_in_any_namespace_and_ends_on_request(node, domain, tmp_path):
    process = start(node, '-r', '__ns:=/somewhere/deep', cwd=tmp_path)
    try:
        with Listener() as listener:
            parameter = {'agent': 'robot', 'parameter_server': 'keep_policies'}.get(node, 'num_agents')
            response = listener.call(GetParameters, f'/somewhere/deep/{node}/get_parameters',
                                     GetParameters.Request(names=[parameter]))
            assert response.values[0].type == 2
    finally:
        (_, errors), = end(process)
    assert process.returncode == 0 and 'Traceback' not in errors, errors


def test_a_node_that_is_interrupted_twice_at_once_still_ends_cleanly(domain, tmp_path):
    process = start('world', cwd=tmp_path)
    try:
        with Listener() as listener:
            listener.call(GetParameters, 'world/get_parameters', GetParameters.Request(names=['num_agents']))
        for _ in range(2):
            process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    assert process.returncode == 0 and 'Traceback' not in errors, errors
