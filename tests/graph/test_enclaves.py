"""The enclave policies name exactly what the nodes use, and with SROS 2 the team trains within them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ament_index_python.packages import get_package_prefix
from dae_ros_msgs.srv import GetPolicy
from harness import REPOSITORY, SMALL, Listener, bringup, finish, oracle

from dae_ros import config
from dae_ros.report.summary import Summary
from dae_ros.ros import enclaves, names
from dae_ros.ros.graph import enclave_arguments, training_graph
from dae_ros.run_folder import RunFolder

SHIPPED = REPOSITORY / 'config' / 'sros2' / 'team.policy.xml'


def allowed(policy: str) -> dict[str, dict[str, set[str]]]:
    """What the policies allow, by enclave and right."""
    rights: dict[str, dict[str, set[str]]] = {}
    for enclave in ElementTree.fromstring(policy).iter('enclave'):
        mine = rights.setdefault(enclave.get('path'), {})
        for group in [*enclave.iter('topics'), *enclave.iter('services')]:
            (right, rule), = group.attrib.items()
            assert rule == 'ALLOW'
            mine[right] = {entry.text for entry in group}
    return rights


def has_security() -> bool:
    library = Path(get_package_prefix('fastrtps')) / 'lib' / 'libfastrtps.so'
    return library.exists() and b'builtin.PKI-DH' in library.read_bytes()


def test_the_policies_that_are_shipped_are_those_of_a_team_of_three():
    assert SHIPPED.read_text() == enclaves.policies(3, 1)


def test_the_policies_name_exactly_the_topics_and_services_that_each_node_uses(make_graph, tmp_path):
    values, namespace = {**SMALL, 'num_agents': 2, 'world_groups': 2, 'total_steps': 10**7}, 'red'
    graph = make_graph(tmp_path / 'graph', values, namespace)
    rights = allowed(enclaves.policies(values['num_agents'], values['world_groups'], namespace))
    graph.start(*(name for name in graph.names if name != 'parameter_server'))  # so that all wait for it, and none ends
    with Listener(namespace) as listener:
        node = listener.node
        listener.wait_for_status(lambda status: status.detail == 'waiting for parameter server')
        graph.start('parameter_server')
        listener.call(GetPolicy, names.GET_POLICY, GetPolicy.Request())
        finders = {'publish': node.get_publisher_names_and_types_by_node,
                   'subscribe': node.get_subscriber_names_and_types_by_node,
                   'reply': node.get_service_names_and_types_by_node, 'request': node.get_client_names_and_types_by_node}
        team = [name for process in graph.processes.values() for name in process.nodes]

        def differing():
            """Nodes whose rights are not what they use, as far as discovery has told."""
            used = {(name, right): {topic for topic, _ in find(name, f'/{namespace}')}
                    for name in team for right, find in finders.items()}
            return {(name, right): uses ^ granted for (name, right), uses in used.items()
                    if uses != (granted := rights[f'/{namespace}/{name}'].get(right, set()))}

        listener.spin_until(lambda: not differing(), lambda: str(differing()))


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
    assert {'agent_0', 'agent_1', 'agent_2'} <= {process.name for process in training_graph(settings, folder)}


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
