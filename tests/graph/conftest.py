"""Every graph test has a DDS domain of its own, on this host only, and leaves no process behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from domain_coordinator import domain_id
from harness import REPOSITORY, Graph


def pytest_collection_modifyitems(items) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.graph)


@pytest.fixture
def domain(monkeypatch):
    """A DDS domain nobody else on this host uses; also for nodes made in the test process."""
    with domain_id() as number:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SYSTEM_DEFAULT')
        monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(REPOSITORY / 'config' / 'fastdds_this_host.xml'))
        yield number


@pytest.fixture
def make_graph(domain):
    """Makes `Graph`s and stops whatever is left of them."""
    graphs: list[Graph] = []

    def make(path: Path, values: dict, namespace: str = '', key_file: str = '') -> Graph:
        graphs.append(Graph(path, values, namespace, key_file))
        return graphs[-1]

    yield make
    for graph in graphs:
        graph.stop()
