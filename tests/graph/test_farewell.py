"""A process ends also while it is being told that others have left."""

from __future__ import annotations

import subprocess
import sys

import pytest
from harness import TIMEOUT, Listener, end, preloadable
from std_msgs.msg import UInt32
from test_parameters import start

from dae_ros.ros import names

MANY = 100  # of which the node is told one by one when they are gone; it takes much less to end

REFUSED = """
import sys
from dae_ros.errors import SettingsError
from dae_ros.ros.node import TeamNode, run

class RefusedNode(TeamNode):
    def __init__(self):
        super().__init__('refused', ())
        sys.stdin.readline()
        raise SettingsError('it was asked to')

sys.exit(run(RefusedNode))
"""


@pytest.fixture
def tell(domain, tmp_path, monkeypatch):
    """Starts a process by a function and has it told, slowly, that many have left; it is still being told when this returns."""
    told, listener = tmp_path / 'told', Listener()

    def tell(start_process):
        monkeypatch.setenv('TOLD', str(told))
        monkeypatch.setenv('LD_PRELOAD', str(preloadable('slow_farewell.c', tmp_path)))
        process = start_process()
        monkeypatch.delenv('LD_PRELOAD')
        try:
            publishers = [listener.node.create_publisher(UInt32, f'number_{number}', 1) for number in range(MANY)]
            listener.spin_until(lambda: listener.node.count_publishers(names.DIAGNOSTICS))
            for publisher in publishers:
                listener.node.destroy_publisher(publisher)
            listener.spin_until(told.exists)
        except BaseException:
            process.kill()
            raise
        return process

    with listener:
        yield tell


def test_a_node_ends_while_it_is_told_that_others_have_left(tell, tmp_path):
    process = tell(lambda: start('parameter_server', cwd=tmp_path))
    (_, errors), = end(process)
    assert process.returncode == 0, errors


def test_a_node_ends_so_too_that_is_refused_while_it_is_made(tell):
    process = tell(lambda: subprocess.Popen([sys.executable, '-c', REFUSED], stdin=subprocess.PIPE, stderr=subprocess.PIPE,
                                            text=True))
    try:
        _, errors = process.communicate('\n', TIMEOUT)
    finally:
        process.kill()
    assert process.returncode == 2 and 'error: it was asked to' in errors
