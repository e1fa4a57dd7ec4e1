"""A process ends also while it is being told that others have left."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from harness import Listener, end, preloadable
from std_msgs.msg import UInt32
from test_parameters import start

from dae_ros.ros import names, qos

MANY = 100  # of which the node is told one by one when they are gone; it takes much less to end


def test_a_node_ends_while_it_is_told_that_another_has_left(domain, tmp_path, monkeypatch):
    told = tmp_path / 'told'
    monkeypatch.setenv('TOLD', str(told))
    monkeypatch.setenv('LD_PRELOAD', str(preloadable('slow_farewell.c', tmp_path)))
    process, heard = start('parameter_server', cwd=tmp_path), []
    monkeypatch.delenv('LD_PRELOAD')
    with Listener() as listener:
        try:
            publishers = [listener.node.create_publisher(UInt32, f'number_{number}', 1) for number in range(MANY)]
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, heard.append, qos.EVENTS)
            listener.spin_until(lambda: bool(heard))
            for publisher in publishers:
                listener.node.destroy_publisher(publisher)
            listener.spin_until(told.exists)
        finally:
            (_, errors), = end(process)
    assert process.returncode == 0, errors
