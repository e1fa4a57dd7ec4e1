"""Teams that lose members, on the graph: the weights of the in-process run, bit for bit, also when nodes are killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from harness import SMALL, TIMEOUT, bringup, finish, oracle, pid_of, processes_naming

from dae_ros import config
from dae_ros.learning.learner import Learner
from dae_ros.report.metrics import read_metrics
from dae_ros.report.summary import Summary
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest
from dae_ros.worlds import make_worlds

SKIRMISH = {**SMALL, 'task': 'pettingzoo:skirmish', 'num_agents': 5, 'beta': 0.6}
SMAX = {**SMALL, 'task': 'smax:2s3z', 'num_agents': 5, 'num_steps': 60, 'total_steps': 3 * 8 * 60, 'beta': 0.6,
        'rollout_timeout': float(TIMEOUT)}


@pytest.fixture(autouse=True)
def findable(monkeypatch):
    """Nodes find the environment beside this file."""
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(Path(__file__).parent), os.environ.get('PYTHONPATH', '')]))


def test_the_skirmishes_of_these_tests_lose_members_and_forbid_actions():
    settings = config.from_flat(SKIRMISH)
    worlds = make_worlds(settings.task)
    learner = Learner(worlds.spec, settings.learner, settings.reward_network, 1)
    played = InProcessCollector(worlds).collect(RolloutRequest(1, 0, 0, 0, 1, 25, False), learner.policy)
    learner.close()
    assert not played.present.all() and not played.available[played.present].all()
    assert played.terminated.any() and played.truncated.any()


@pytest.mark.parametrize('values', [SKIRMISH, pytest.param(SMAX, marks=pytest.mark.slow)], ids=['skirmish', 'smax'])
def test_battles_on_the_graph_end_with_the_weights_of_the_in_process_run_bit_for_bit(values, domain, tmp_path):
    if values is SMAX:
        pytest.importorskip('jaxmarl', reason='`make smax` installs JaxMARL')
    expected = oracle(tmp_path / 'alone', values)
    code, output, errors = finish(bringup(tmp_path / 'graph', values), 4 * TIMEOUT)  # JAX compiles in two processes
    assert code == 0, errors
    summary = Summary.read(tmp_path / 'graph' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == expected
    assert not processes_naming(str(tmp_path))


@pytest.mark.parametrize('nodes', [['world'], ['agents_0-4', 'trainer']], ids=' and '.join)
def test_a_battle_whose_nodes_are_killed_is_begun_anew_and_changes_no_weight(nodes, domain, tmp_path):
    values = {**SKIRMISH, 'total_steps': 40 * 8 * 25}
    expected, folder = oracle(tmp_path / 'alone', values), tmp_path / 'graph'
    process = bringup(folder, values)
    deadline = time.monotonic() + TIMEOUT
    while not (folder / 'metrics.csv').exists() or len(read_metrics(folder / 'metrics.csv')['environment_steps']) < 3:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    for node in nodes:
        os.kill(pid_of(node, folder), signal.SIGKILL)
    code, output, errors = finish(process)
    assert code == 0, errors
    assert output.count('and is started again') == len(nodes)
    summary = Summary.read(folder / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == expected
    assert 'Traceback' not in errors + ''.join(path.read_text() for path in (folder / 'logs').iterdir())
