"""Two trainings that get in each other's way: each ends by itself, says so, or ends with its own weights."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from harness import LASTING, SMALL, Graph, Listener, bringup, finish, oracle, processes_naming
from std_srvs.srv import Trigger

from dae_ros.ros import names, qos


def test_a_second_trainer_or_server_says_whose_the_team_is_and_ends_and_the_first_run_has_its_weights(
        make_graph, tmp_path):
    first = make_graph(tmp_path / 'first', SMALL)
    second = make_graph(tmp_path / 'second', {**SMALL, 'seed': 2})
    with Listener() as listener:
        first.start_paused(listener)
        second.start('trainer')
        assert second.wait() == 2
        second.processes['parameter_server'] = first.processes['parameter_server']
        second.start('parameter_server')
        assert second.wait('parameter_server') == 2
        listener.call(Trigger, names.RESUME, Trigger.Request())
    assert f'error: another trainer is at work here: its run {first.folder.run:x} has ' in second.log('trainer')
    assert f'error: another parameter server is at work in {first.folder.policies}' in second.log('parameter_server')
    assert 'Traceback' not in second.log('trainer') + second.log('parameter_server')
    assert first.wait() == 0, first.log('trainer')
    assert first.result() == oracle(tmp_path / 'alone', SMALL)


def test_a_second_run_in_the_same_folder_says_so_and_ends_and_the_first_has_its_weights(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'run', SMALL)
    with Listener() as listener:
        graph.start_paused(listener)
        code, output, errors = finish(bringup(tmp_path / 'run', SMALL, '--namespace', 'other'))
        assert code == 2 and re.search(rf'error: another (trainer|parameter server) is at work in {tmp_path}/run', errors), errors
        assert 'Traceback' not in output + errors
        assert not any('__ns:=/other' in line for line in processes_naming(str(tmp_path)))
        listener.call(Trigger, names.RESUME, Trigger.Request())
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', SMALL)


@pytest.fixture
def two_trainings(make_graph, tmp_path):
    """Two graphs in one namespace whose nodes join the run they hear of first, as those started by hand do. Both last, or one
    could be over before the other begins."""
    graphs = [make_graph(tmp_path / name, {**LASTING, 'seed': seed}) for seed, name in enumerate(('first', 'second'))]
    for graph in graphs:
        for process in graph.processes.values():
            process.parameters.pop('run', None)
    return graphs


def assert_one_wins(winner: Graph, loser: Graph, said: list[DiagnosticStatus], listener: Listener, folder: Path) -> None:
    """One training ended with its weights, all of them, and the other said on stderr and /diagnostics why it ended."""
    sentence = f'another trainer is at work here: its run {winner.folder.run:x} has '
    assert f'error: {sentence}' in loser.log('trainer')
    listener.spin_until(lambda: any(status.level == DiagnosticStatus.ERROR and status.message.startswith(sentence)
                                    for status in said), lambda: str({status.message for status in said}))
    served = list(folder.rglob(f'policies/{winner.folder.run:016x}/policy_{5:08d}.safetensors'))
    assert served and all(path.read_bytes() == winner.folder.policy_file.read_bytes() for path in served)
    assert winner.result() == oracle(folder / 'alone', {**LASTING, 'seed': winner.settings.run.seed})
    assert not any('Traceback' in log.read_text() for log in folder.rglob('*.log'))


@pytest.fixture
def listener(domain):
    with Listener() as listener:
        yield listener


@pytest.fixture
def said(listener) -> list[DiagnosticStatus]:
    """What is said on /diagnostics."""
    heard: list[DiagnosticStatus] = []
    listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, lambda report: heard.extend(report.status),
                                      qos.RECORDED)
    return heard


def test_of_two_trainers_and_servers_started_at_once_one_has_its_own_weights_and_the_other_says_why_it_ends(
        two_trainings, listener, said, tmp_path):
    for node in ('trainer', 'parameter_server'):
        for graph in two_trainings:
            graph.start(node)
    two_trainings[0].start('world', 'agents_0-2')
    codes = {graph: graph.wait() for graph in two_trainings}
    assert sorted(codes.values()) == [0, 2], ''.join(graph.log('trainer') for graph in two_trainings)
    assert_one_wins(*sorted(codes, key=codes.__getitem__), said, listener, tmp_path)


def test_a_team_of_which_each_of_two_trainers_has_a_part_becomes_that_of_one_and_acts_with_no_policy_of_the_other(
        two_trainings, listener, said, tmp_path):
    first, second = two_trainings
    second.start('trainer', 'parameter_server')
    listener.spin_until(lambda: any(status.message == 'serving policy version 0' for status in said))
    os.kill(second.pids['trainer'], signal.SIGSTOP)
    first.start('trainer', 'world', 'agents_0-2')
    listener.spin_until(lambda: any(status.message == 'waiting for actions of robots [0, 1, 2]' for status in said))
    os.kill(second.pids['trainer'], signal.SIGCONT)
    assert (first.wait(), second.wait()) == (0, 2), first.log('trainer') + second.log('trainer')
    assert_one_wins(first, second, said, listener, tmp_path)
