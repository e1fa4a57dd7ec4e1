"""The enclave policies name exactly what the nodes use, and with SROS 2 the team trains within them."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ament_index_python.packages import get_package_prefix
from dae_ros_nodes.robot_world import TFMessage
from diagnostic_msgs.msg import DiagnosticArray
from harness import REPOSITORY, SMALL, Listener, bringup, finish, network_file, oracle
from rclpy.node import Node, NodeNameNonExistentError
from robots import Processes
from visualization_msgs.msg import MarkerArray

from dae_ros import config
from dae_ros.report.summary import Summary
from dae_ros.ros import enclaves, names, qos
from dae_ros.ros.enclaves import Team
from dae_ros.ros.execution import execution_graph, streaming_graph
from dae_ros.ros.graph import enclave_arguments, training_graph
from dae_ros.run_folder import RunFolder
from tests.bags import Team as Played
from tests.bags import write_bag

SHIPPED = REPOSITORY / 'config' / 'sros2' / 'team.policy.xml'
NAMESPACE = 'red'
SIZE = {**SMALL, 'num_agents': 2, 'total_steps': 10**7}
APART = {'robots_per_process': 1}  # as where security is switched on: those of a process share what they hear
FINDERS = {'publish': 'publisher', 'subscribe': 'subscriber', 'reply': 'service', 'request': 'client'}


def allowed(policy: str) -> dict[str, dict[str, set[str]]]:
    """What the policies allow, by node and right."""
    rights: dict[str, dict[str, set[str]]] = {}
    for profile in ElementTree.fromstring(policy).iter('profile'):
        mine = rights.setdefault(f'{profile.get("ns")}/{profile.get("node")}', {})
        for group in [*profile.iter('topics'), *profile.iter('services')]:
            (right, rule), = group.attrib.items()
            assert rule == 'ALLOW'
            mine[right] = {entry.text for entry in group}
    return rights


def has_security() -> bool:
    library = Path(get_package_prefix('fastrtps')) / 'lib' / 'libfastrtps.so'
    return library.exists() and b'builtin.PKI-DH' in library.read_bytes()


def used(node: Node, name: str, right: str) -> set[str]:
    """What the graph shows of a node of the team; nothing before it is there."""
    find = getattr(node, f'get_{FINDERS[right]}_names_and_types_by_node')
    try:
        return {topic for topic, _ in find(name, f'/{NAMESPACE}')}
    except NodeNameNonExistentError:
        return set()


def start_by_hand(name: str, processes: Processes, folder: Path, team: Team) -> None:
    """Starts a node that `bringup` does not start."""
    into_team = '-r', f'__ns:=/{NAMESPACE}'
    if name == 'player':
        data = Played(num_worlds=2, num_agents=2).play(0)[1]
        bags = [str(write_bag(folder / group, data, namespace=f'/{NAMESPACE}', group=f'/{group}'))
                for group in ('group_0', 'group_1')]
        processes.python(name, 'dae_ros_nodes.player', *bags, '--start-paused', '--ros-args', *into_team)
        return
    given = {'recorder': {'num_agents': 2, 'world_groups': team.world_groups, 'bag': folder / 'bag', 'everything': 'true'},
             'credit': {'reward_network_file': network_file(folder / 'networks', SIZE), 'use_sim_time': bool(team.clock)},
             'task_monitor': {'num_agents': 2},
             'replay_trainer': {**SIZE, 'world_groups': team.world_groups, 'watched_world': 0, 'run_folder': folder / 'replayed'}}
    processes.node(name, name, *into_team, **given[name])


def test_the_policies_that_are_shipped_are_those_of_a_team_of_three():
    assert SHIPPED.read_text() == enclaves.policies(Team(3))


@pytest.mark.parametrize('arguments, sentence', [
    (['--simulate'], '--simulate goes with'), (['--stream', '--world-groups', '2'], 'no --world-groups'),
    (['--execute', 'navigation', '--watch'], '--watch goes with')])
def test_policies_of_a_team_that_cannot_be_are_refused(arguments, sentence, monkeypatch, capsys):
    monkeypatch.setattr(sys, 'argv', ['enclaves', *arguments])
    with pytest.raises(SystemExit) as refused:
        enclaves.main()
    assert refused.value.code == 2 and sentence in capsys.readouterr().err


@pytest.mark.parametrize('team, values, arguments, by_hand', [
    (Team(2, world_groups=2, watch=True), {'world_groups': 2}, ['--watch', '0'], ['recorder']),
    (Team(2, stream=True, simulate=True, real_time_factor=2.0), {'real_time_factor': 2.0, 'evaluation_greedy': False, **APART},
     ['--stream', '--simulate'], ['recorder', 'credit']),
    (Team(2, execute='navigation', simulate=True), {'enabled': False, **APART}, ['--execute', 'navigation', '--simulate'],
     ['task_monitor', 'credit']),
    (Team(2, world_groups=2, watch=True, replay=True), {}, [], ['player', 'replay_trainer']),
], ids=['training', 'stream', 'execution', 'replay'])
def test_the_policies_name_exactly_what_each_node_publishes_hears_serves_and_asks_for(team, values, arguments, by_hand, domain,
                                                                                   tmp_path):
    """All nodes of a graph run at once, and somebody looks at the markers; who has said something on /diagnostics has made its
    topics and services."""
    rights = {path.removeprefix(f'/{NAMESPACE}/'): mine for path, mine in allowed(enclaves.policies(team, NAMESPACE)).items()}
    if 'world' in rights and TFMessage is None:
        rights['world']['publish'] -= {names.TRANSFORMS}
    processes, started, speaking = Processes(tmp_path), None, set()
    with Listener() as listener:
        node = listener.node
        node.create_subscription(MarkerArray, f'/{NAMESPACE}/{names.MARKERS}', lambda _: None, qos.EVENTS)
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                 lambda report: speaking.update(status.name for status in report.status), qos.EVENTS)

        def differing():
            """Nodes that are missing or have no enclave, and those whose rights are not what they use."""
            running = {name for name, where in node.get_node_names_and_namespaces() if where == f'/{NAMESPACE}'}
            return {'nodes': running ^ set(rights), **{
                (name, right): uses ^ granted for name, mine in rights.items() for right in FINDERS
                if (uses := used(node, name, right)) != (granted := mine.get(right, set()))}}

        try:
            if arguments:
                started = bringup(tmp_path / 'run', {**SIZE, **values}, '--namespace', NAMESPACE, *arguments)
            for name in by_hand:
                start_by_hand(name, processes, tmp_path, team)
            everyone = {f'/{NAMESPACE}/{name}' for name in rights if name != 'bringup'}
            listener.spin_until(lambda: everyone <= speaking, lambda: str(everyone - speaking))
            listener.spin_until(lambda: not any(differing().values()), lambda: str(differing()))
        finally:
            processes.stop()
            if started:
                started.send_signal(signal.SIGINT)
                finish(started)


def test_nodes_are_told_their_enclaves_where_security_is_switched_on(monkeypatch):
    assert enclave_arguments('agent_0', 'red') == []
    monkeypatch.setenv('ROS_SECURITY_ENABLE', 'true')
    assert enclave_arguments('agent_0', '/red') == ['--enclave', '/red/agent_0']
    assert enclave_arguments('agent_0', '') == ['--enclave', '/agent_0']


def test_every_robot_has_a_process_and_so_an_enclave_of_its_own_where_security_is_switched_on(monkeypatch, tmp_path):
    settings = config.from_flat(SMALL)
    folder = RunFolder(tmp_path, settings)
    assert 'agents_0-2' in {process.name for process in training_graph(settings, folder)}
    monkeypatch.setenv('ROS_SECURITY_ENABLE', 'true')
    for team, processes in ((Team(3), training_graph(settings, folder)),
                            (Team(3, stream=True), streaming_graph(settings, {}, folder, False)),
                            (Team(3, stream=True, simulate=True), streaming_graph(settings, {}, folder, True)),
                            (Team(3, execute='navigation'), execution_graph({}, 'navigation', False)),
                            (Team(3, execute='navigation', simulate=True), execution_graph({}, 'navigation', True))):
        found = {enclave.get('path'): {profile.get('node') for profile in enclave.iter('profile')}
                 for enclave in ElementTree.fromstring(enclaves.policies(team)).iter('enclave')}
        assert all(found[f'/{process.name}'] == set(process.nodes) for process in processes)


@pytest.mark.skipif(not shutil.which('ros2') or not has_security(),
                    reason='there is no ros2 security here, or a Fast DDS without its plugin')
def test_a_team_trains_within_its_enclaves(domain, monkeypatch, tmp_path):
    keys = tmp_path / 'keys'
    for command in (['create_keystore', str(keys)], ['generate_artifacts', '-k', str(keys), '-p', str(SHIPPED)]):
        subprocess.run(['ros2', 'security', *command], check=True, timeout=120)
    for name, value in (('ENABLE', 'true'), ('STRATEGY', 'Enforce'), ('KEYSTORE', str(keys))):
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    code, output, errors = finish(bringup(tmp_path / 'run', SMALL))
    assert code == 0, output + errors
    summary = Summary.read(tmp_path / 'run' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', SMALL)
