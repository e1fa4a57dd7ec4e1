"""Large teams: every node is found, and the weights are those of one process."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from harness import SMALL, Listener, oracle
from std_msgs.msg import UInt32

from dae_ros.ros import names, qos
from dae_ros.ros.graph import node_environment

MANY = 40  # processes; more than the 32 that the middleware's own LOCALHOST would let find each other


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


def test_32_agents_in_three_processes_are_all_found_and_end_with_the_weights_of_one_process(make_graph, tmp_path):
    values = {**SMALL, 'task': 'matrix_game', 'num_agents': 32, 'num_worlds': 2, 'num_steps': 32, 'total_steps': 2 * 2 * 32,
              'epochs': 1, 'reward_network.epochs': 1, 'evaluation_episodes': 2, 'robots_per_process': 12,
              'rollout_timeout': 60.0}
    graph = make_graph(tmp_path / 'graph', values)
    assert {'agents_0-11', 'agents_12-23', 'agents_24-31'} < set(graph.names)
    alive = set()
    with Listener() as listener:
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                          lambda report: alive.update(status.name for status in report.status), qos.RECORDED)
        graph.start(*graph.names)
        listener.spin_until(lambda: {f'/agent_{robot}' for robot in range(32)} <= alive, lambda: str(sorted(alive)))
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', values)
    assert 'refused' not in ''.join(graph.log(name) for name in graph.names)


def test_whoever_sets_how_far_discovery_reaches_or_a_profile_is_obeyed(monkeypatch):
    reach, profiles = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'FASTRTPS_DEFAULT_PROFILES_FILE'
    for given, expected in [({}, ('SYSTEM_DEFAULT', 'fastdds_this_host.xml')), ({reach: 'SUBNET'}, ('SUBNET', 'fastdds.xml')),
                            ({profiles: 'own.xml'}, ('LOCALHOST', 'own.xml')),
                            ({reach: 'SUBNET', profiles: 'own.xml'}, ('SUBNET', 'own.xml'))]:
        for name in (reach, profiles):
            monkeypatch.delenv(name, raising=False)
        for name, value in given.items():
            monkeypatch.setenv(name, value)
        found = node_environment()
        assert (found[reach], found[profiles].rsplit('/')[-1]) == expected
