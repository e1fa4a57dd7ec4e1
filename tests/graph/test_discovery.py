"""Large teams: every node is found, and the weights are those of one process."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import SMALL, Listener, bringup, end, finish, oracle, pid_of
from std_msgs.msg import UInt32
from test_parameters import start

from dae_ros.report.summary import Summary
from dae_ros.ros import names, qos, transport
from dae_ros.ros.graph import node_environment

MANY = 40  # processes; more than the 32 that the middleware's own LOCALHOST would let find each other
TEAM = {**SMALL, 'task': 'matrix_game', 'num_agents': 32, 'num_worlds': 2, 'num_steps': 32, 'total_steps': 2 * 2 * 32,
        'epochs': 1, 'reward_network.epochs': 1, 'evaluation_episodes': 2, 'rollout_timeout': 60.0}
LONG = 600  # s, for so many processes on whatever cores there are


@pytest.fixture(scope='module')
def alone(tmp_path_factory):
    """What the team ends with in one process."""
    return oracle(tmp_path_factory.mktemp('alone') / 'run', TEAM)


def test_as_many_processes_as_there_are_hear_each_other_on_a_host(domain):
    team = [Listener() for _ in range(MANY)]  # to DDS each is a process of its own
    heard = [set() for _ in team]
    try:
        for number, (listener, said) in enumerate(zip(team, heard)):
            listener.node.create_subscription(UInt32, 'everyone', lambda message, said=said: said.add(message.data),
                                              qos.RECORDED_LATCHED)
            listener.node.create_publisher(UInt32, 'everyone', qos.LATCHED).publish(UInt32(data=number))
        for listener, said in zip(team, heard):
            listener.spin_until(lambda: len(said) == MANY, lambda: f'has not heard of {set(range(MANY)) - said}')
    finally:
        for listener in team:
            listener.__exit__()


def test_32_agents_in_three_processes_are_all_found_and_end_with_the_weights_of_one_process(make_graph, alone, tmp_path):
    graph = make_graph(tmp_path / 'graph', {**TEAM, 'robots_per_process': 12})
    assert {'agents_0-11', 'agents_12-23', 'agents_24-31'} < set(graph.names)
    alive = set()
    with Listener() as listener:
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                          lambda report: alive.update(status.name for status in report.status), qos.RECORDED)
        graph.start(*graph.names)
        listener.spin_until(lambda: {f'/agent_{robot}' for robot in range(32)} <= alive, lambda: str(sorted(alive)))
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == alone
    assert not graph.refused()


def test_32_agents_in_processes_of_their_own_end_with_the_same_weights_though_some_are_killed_as_they_start(
        domain, alone, tmp_path):
    folder, draw, heard = tmp_path / 'run', random.Random(1), set()
    process = bringup(folder, {**TEAM, 'robots_per_process': 1, 'silence_timeout': 120.0})
    try:
        with Listener() as listener:
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                              lambda report: heard.update(status.name for status in report.status), qos.RECORDED)
            for count in (1, 5, 10, 15, 20, 25):
                listener.spin_until(lambda: len(heard) >= count, lambda: str(sorted(heard)))
                agents = (pid_of(f'agent_{robot}', folder) for robot in draw.sample(range(32), 32))
                os.kill(next(pid for pid in agents if pid is not None), signal.SIGKILL)
        code, output, errors = finish(process, LONG)
    finally:
        process.kill()
    assert code == 0, output + errors
    summary = Summary.read(folder / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == alone
    assert output.count('was killed by SIGKILL and is started again') >= 6
    assert 'Traceback' not in output + errors + ''.join(log.read_text() for log in folder.glob('logs/*'))


@pytest.mark.parametrize('environment, shares', [({}, False), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, False),
                                                 ({transport.VARIABLE: 'DEFAULT'}, True)], ids=str)
def test_a_node_started_by_hand_shares_no_memory_unless_it_is_told_to(environment, shares, domain, monkeypatch, tmp_path):
    for name in ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'FASTRTPS_DEFAULT_PROFILES_FILE'):
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    process = start('world', cwd=tmp_path)
    heard = []
    try:
        with Listener() as listener:
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, heard.append, qos.EVENTS)
            listener.spin_until(lambda: bool(heard))
        assert ('/dev/shm/fastrtps' in Path(f'/proc/{process.pid}/maps').read_text()) == shares
    finally:
        end(process)


def test_whoever_sets_how_far_discovery_reaches_or_a_profile_is_obeyed(monkeypatch):
    reach, profiles = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'FASTRTPS_DEFAULT_PROFILES_FILE'
    for given, expected in [({}, ('SYSTEM_DEFAULT', 'fastdds_this_host.xml')), ({reach: 'SUBNET'}, ('SUBNET', 'fastdds.xml')),
                            ({reach: 'LOCALHOST'}, ('SYSTEM_DEFAULT', 'fastdds_this_host.xml')),
                            ({reach: 'LOCALHOST', profiles: 'own.xml'}, ('LOCALHOST', 'own.xml')),
                            ({profiles: 'own.xml'}, ('LOCALHOST', 'own.xml')),
                            ({reach: 'SUBNET', profiles: 'own.xml'}, ('SUBNET', 'own.xml'))]:
        for name in (reach, profiles):
            monkeypatch.delenv(name, raising=False)
        for name, value in given.items():
            monkeypatch.setenv(name, value)
        found = node_environment()
        assert (found[reach], found[profiles].rsplit('/')[-1]) == expected
