"""What a killed process leaves in shared memory is removed, and nothing that a living one needs."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

from harness import SMALL, Listener
from rcl_interfaces.srv import GetParameters

from dae_ros.ros import shared_memory


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
