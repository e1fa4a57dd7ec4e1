"""Processes that hang."""

from __future__ import annotations

import os
import queue
import signal
import sys
import time

import pytest

from dae_ros.ros.supervisor import Supervisor

TIMEOUT = 60.0  # s
ENDLESS = """
import os
def task_of_a_user():
    while True:
        pass
if os.fork() == 0:
    task_of_a_user()
print('begun', flush=True)
task_of_a_user()
"""


def wait_until(condition):
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def hanging(tmp_path):
    """A process, with a child, that does nothing but run in a circle: supervisor, exits, process id."""
    exits: queue.Queue = queue.Queue()
    supervisor = Supervisor(tmp_path, lambda name, code: exits.put((name, code)))
    pid = supervisor.start('world', [sys.executable, '-c', ENDLESS], os.environ)
    wait_until(lambda: 'begun' in supervisor.log_file('world').read_text())
    yield supervisor, exits, pid
    supervisor.stop()


def is_there(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize('stopped, end', [(False, signal.SIGABRT), (True, signal.SIGKILL)], ids=['in a circle', 'stopped'])
def test_a_process_that_hangs_tells_where_and_is_gone_with_its_children(hanging, stopped, end):
    supervisor, exits, pid = hanging
    if stopped:
        os.kill(pid, signal.SIGSTOP)
    supervisor.kill('world')
    assert exits.get(timeout=TIMEOUT) == ('world', -end)
    assert ('in task_of_a_user' in supervisor.log_file('world').read_text()) != stopped
    wait_until(lambda: not is_there(pid))
