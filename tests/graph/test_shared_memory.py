"""What a killed process leaves in shared memory is removed, and nothing that a living one needs."""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import pytest
from harness import SMALL, TIMEOUT, Listener
from rcl_interfaces.srv import GetParameters

from dae_ros.ros import shared_memory

UNFINISHED = {'empty': b'', 'not begun': bytes(52400), 'begun': (1).to_bytes(4, sys.byteorder) + bytes(52396)}
PORTS, FIRST_OF_USERS = 250, 7411  # by the DDSI-RTPS specification: of a domain, and of its first process; two a process


def segments(pid: int) -> set[str]:
    """Names of the shared memory segments that a process uses, its own and those of others it hears from."""
    return set(re.findall(r'/dev/shm/(fastrtps_[0-9a-f]{16})\n', Path(f'/proc/{pid}/maps').read_text()))


def test_the_segment_of_the_killed_is_removed_and_those_of_the_living_stay(make_graph, tmp_path):
    graph, long_ago = make_graph(tmp_path / 'graph', SMALL), time.time() - 2 * shared_memory.YOUNG
    graph.start('world', 'parameter_server')
    with Listener() as listener:
        for node in ('world', 'parameter_server'):
            listener.call(GetParameters, f'{node}/get_parameters', GetParameters.Request(names=['run']))
        used = segments(graph.pids['world']) | segments(graph.pids['parameter_server']) | segments(os.getpid())
        for name in used:
            os.utime(shared_memory.FOLDER / f'{name}_el', (long_ago, long_ago))
        assert not used & set(shared_memory.remove_left_behind(long_ago - 1))
        graph.kill('world')
        removed = used & set(shared_memory.remove_left_behind(long_ago - 1))
        assert len(removed) == 1
        left = {path.name for path in shared_memory.FOLDER.iterdir()}
        assert all((name in left) == (f'{name}_el' in left) == (name not in removed) for name in used)
        assert listener.call(GetParameters, 'parameter_server/get_parameters', GetParameters.Request(names=['run']))


def test_what_is_older_or_only_just_made_or_something_else_is_left_alone(tmp_path):
    now = time.time()
    for name, age in [('0' * 16, 100), ('1' * 16, 1000), ('2' * 16, 1), ('port7', 100)]:
        for end in ('', '_el'):
            path = tmp_path / f'fastrtps_{name}{end}'
            path.touch()
            os.utime(path, (now - age, now - age))
    assert shared_memory.remove_left_behind(now - 500, tmp_path) == [f'fastrtps_{"0" * 16}']
    assert len(list(tmp_path.iterdir())) == 6


@pytest.fixture(params=UNFINISHED.values(), ids=UNFINISHED)
def half_made_ports(request, domain):
    """Those that the next processes would have, as if they had been killed in the middle of making them, long ago."""
    ports = [shared_memory.FOLDER / f'fastrtps_port{FIRST_OF_USERS + PORTS * domain + 2 * process}' for process in range(4)]
    for port in ports:
        port.with_name(f'{port.name}_el').unlink(missing_ok=True)
        port.write_bytes(request.param)
        os.utime(port, (0, 0))
    yield ports
    for port in filter(is_left, ports):
        port.unlink()


def is_left(port: Path) -> bool:
    return port.exists() and port.stat().st_mtime == 0


def test_a_node_starts_where_a_process_was_killed_while_it_made_the_port_that_comes_next(half_made_ports, make_graph, tmp_path):
    graph = make_graph(tmp_path, SMALL)
    graph.start('world')
    deadline = time.monotonic() + TIMEOUT
    while any(map(is_left, half_made_ports)):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with Listener() as listener:
        listener.call(GetParameters, 'world/get_parameters', GetParameters.Request(names=['run']))


def test_ports_that_can_be_used_or_may_still_be_made_are_left_alone(tmp_path):
    now, made = time.time(), (2).to_bytes(4, sys.byteorder)
    for name, content, age in [('port1', made, 100), ('port2', b'', 1), ('port3', b'', 100), ('port3_el', b'', 100),
                               ('0' * 16, b'', 100)]:
        path = tmp_path / f'fastrtps_{name}'
        path.write_bytes(content)
        os.utime(path, (now - age, now - age))
    assert shared_memory.remove_half_made_ports(tmp_path) == ['fastrtps_port3']
