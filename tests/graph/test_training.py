"""What a training on the graph promises, shown on real processes."""

from __future__ import annotations

import random

import pytest
from harness import SMALL, Listener, bringup, finish, oracle, processes_naming

from dae_ros.report.summary import Summary

GROUPS = {**SMALL, 'num_agents': 2, 'world_groups': 2, 'robots_per_process': 1}
MATRIX_GAME = {**SMALL, 'task': 'matrix_game', 'num_agents': 4, 'num_steps': 4, 'total_steps': 5 * 8 * 4, 'beta': 1.0,
               'robots_per_process': 3}


@pytest.mark.parametrize('values', [SMALL, MATRIX_GAME, GROUPS], ids=['navigation', 'matrix_game', 'two groups'])
def test_a_graph_run_ends_with_the_weights_of_the_in_process_run_bit_for_bit(values, domain, tmp_path):
    code, output, errors = finish(bringup(tmp_path / 'graph', values))
    assert code == 0, errors
    summary = Summary.read(tmp_path / 'graph' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', values)
    assert summary.weights_sha256 in output
    policies = [(tmp_path / name / 'policy.safetensors').read_bytes() for name in ('graph', 'alone')]
    assert policies[0] == policies[1]
    assert not processes_naming(str(tmp_path))


def test_bringup_in_process_is_the_same_run_and_leaves_the_same_files(tmp_path):
    code, output, errors = finish(bringup(tmp_path / 'run', SMALL, '--in-process'))
    assert code == 0, errors
    summary = Summary.read(tmp_path / 'run' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', SMALL)
    assert set(summary.yardsticks) == {'no-op', 'random', 'greedy'}
    for name in ('settings.yaml', 'metrics.csv', 'learning_curve.png', 'episode.png', 'episode.gif', 'policy.safetensors'):
        assert (tmp_path / 'run' / name).stat().st_size > 0
    assert list((tmp_path / 'run' / 'tensorboard').iterdir()) and list((tmp_path / 'run' / 'checkpoints').iterdir())


def test_the_same_seed_ends_with_the_same_weights_and_another_seed_with_others(tmp_path):
    first, again, other = (oracle(tmp_path / name, {**SMALL, 'seed': seed}) for name, seed in (('a', 1), ('b', 1), ('c', 2)))
    assert first == again
    assert first[0] != other[0]


@pytest.mark.parametrize('shuffle', range(3))
def test_nodes_find_each_other_whatever_the_order_they_are_started_in(shuffle, make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    names = graph.names
    random.Random(shuffle).shuffle(names)
    graph.start(*names)
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', SMALL)


def test_a_group_that_starts_late_is_waited_for_by_its_name_and_changes_no_weight(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', GROUPS)
    late = ['agent_1_0', 'agent_1_1', 'world_1']
    graph.start(*(name for name in graph.names if name not in late))
    missing = [f'{name} in group 1' for name in ('agent of robot 0', 'agent of robot 1', 'world')]
    with Listener() as listener:
        for started, node in enumerate(late):
            listener.wait_for_status(lambda status: status.detail == f'waiting for {", ".join(missing[started:])}')
            graph.start(node)
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', GROUPS)
    assert not graph.refused()


def test_two_teams_in_two_namespaces_do_not_disturb_each_other(make_graph, tmp_path):
    runs = {'red': {**SMALL, 'seed': 1}, 'blue': {**SMALL, 'seed': 2, 'num_agents': 2}}
    graphs = {name: make_graph(tmp_path / name, values, namespace=name) for name, values in runs.items()}
    for graph in graphs.values():
        graph.start(*graph.names)
    for name, graph in graphs.items():
        assert graph.wait() == 0, graph.log('trainer')
        assert graph.result() == oracle(tmp_path / f'{name}_alone', runs[name])
        assert not graph.refused()


def test_a_node_that_knows_no_run_joins_the_first_it_hears_of(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    for process in graph.processes.values():
        process.parameters.pop('run', None)
    graph.start(*graph.names)
    assert graph.wait() == 0, graph.log('trainer')
