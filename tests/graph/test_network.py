"""Worlds and agents on one host, trainer and parameter server on another: whatever the cable does, no weight changes."""

from __future__ import annotations

import shutil
import subprocess
import time
from typing import Callable

import pytest
from harness import REPOSITORY, SMALL, TIMEOUT, Graph, oracle
from link import CLEAR, CUT, Link, Weather

pytestmark = pytest.mark.slow
UPDATES = 8
VALUES = {**SMALL, 'total_steps': UPDATES * 8 * 25, 'rollout_timeout': 10.0}
STORM = Weather(loss=0.05, delay=0.05, reorder=0.25)
THIN = Weather(rate=1e6)
NO_MULTICAST = Weather(multicast=False)
SERVER = '10.77.0.2:11811'


@pytest.fixture
def link(domain, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(REPOSITORY / 'config' / 'fastdds.xml'))
    try:
        made = Link().__enter__()
    except OSError as error:
        pytest.skip(f'{error}; it takes root, or the right to make namespaces')
    yield made
    made.__exit__()


@pytest.fixture(scope='module')
def expected(tmp_path_factory):
    return oracle(tmp_path_factory.mktemp('alone') / 'run', VALUES)


@pytest.fixture
def graph(link, make_graph, tmp_path):
    """The graph on two hosts."""
    graph = make_graph(tmp_path / 'run', VALUES)
    learning, simulating = link.hosts
    graph.prefixes = {name: (learning if name in ('trainer', 'parameter_server') else simulating).prefix for name in graph.names}
    return graph


def learnt(graph: Graph) -> int:
    """Updates so far; the test lies on neither host and cannot hear of them."""
    return len(graph.folder.metrics_file.read_text().splitlines()) - 1 if graph.folder.metrics_file.exists() else 0


def wait_until(condition: Callable[[], bool], graph: Graph) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline, '\n'.join(graph.log(name) for name in graph.names)
        time.sleep(0.1)


def assert_ends_with(expected: tuple[str, float], graph: Graph) -> None:
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == expected
    assert not any('Traceback' in graph.log(name) for name in graph.names)


def attempts(graph: Graph) -> int:
    """Rollouts begun anew."""
    return int((graph.folder.path / 'attempts').read_text()) - 1


def test_loss_delay_reordering_and_a_thin_line_slow_a_training_and_change_no_weight(graph, link, expected):
    graph.start(*graph.names)
    wait_until(lambda: learnt(graph) >= 2, graph)
    link.change(STORM)
    wait_until(lambda: learnt(graph) >= 4, graph)
    link.change(THIN)
    before = attempts(graph)
    assert_ends_with(expected, graph)
    assert attempts(graph) == before, 'rollouts were begun anew on a line that is slow but whole'


def test_a_cable_that_is_cut_for_twenty_seconds_heals(graph, link, expected):
    graph.start(*graph.names)
    wait_until(lambda: learnt(graph) >= 2, graph)
    link.change(CUT)
    time.sleep(20)
    assert learnt(graph) < UPDATES
    link.change(CLEAR)
    assert_ends_with(expected, graph)


@pytest.fixture
def discovery_server(link):
    """Where hosts do not hear each other's multicast: one process that tells all of all."""
    if not shutil.which('fast-discovery-server'):
        pytest.skip('there is no fast-discovery-server here; it comes with Fast DDS')
    address, port = SERVER.split(':')
    with subprocess.Popen([*link.hosts[1].prefix, 'fast-discovery-server', '-i', '0', '-l', address, '-p', port],
                          stdout=subprocess.DEVNULL) as server:
        yield
        server.kill()


@pytest.mark.parametrize('variable, value', [('ROS_STATIC_PEERS', '10.77.0.1;10.77.0.2'), ('ROS_DISCOVERY_SERVER', SERVER)])
def test_hosts_that_hear_no_multicast_find_each_other_as_the_readme_says(variable, value, graph, link, discovery_server, expected,
                                                                        monkeypatch):
    link.change(NO_MULTICAST)
    monkeypatch.setenv(variable, value)
    graph.start(*graph.names)
    assert_ends_with(expected, graph)
