"""Nothing waits by a clock that can be set: a training goes on when the host's clock jumps, or a node's time stands still."""

from __future__ import annotations

import os
import re
import signal
import struct
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import LASTING, REPOSITORY, Listener, bringup, end, finish, oracle, pid_of, preloadable
from test_parameters import start

from dae_ros import config
from dae_ros.report.summary import Summary
from dae_ros.ros import names, qos
from dae_ros.ros.graph import training_graph
from dae_ros.run_folder import RunFolder

HOUR = 3600  # s

WALL_CLOCK = re.compile(r'time\.time\b|time_ns\(|datetime\.now|clock_gettime')
MAY_ASK = {'dae_ros/ros/clock_watch.py',  # whether it was set
           'dae_ros/run_folder.py',       # to name a folder
           'nodes/recorder.py'}           # to name a bag, and once for the stamps in it


def test_a_node_whose_clock_stands_still_goes_on_giving_signs_of_life(domain, tmp_path):
    process = start('world', '-p', 'use_sim_time:=true', cwd=tmp_path)  # and nobody publishes the time
    heard: list[DiagnosticArray] = []
    try:
        with Listener() as listener:
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, heard.append, qos.EVENTS)
            listener.spin_until(lambda: len(heard) >= 3)
    finally:
        (_, errors), = end(process)
    assert all(report.header.stamp.sec == 0 for report in heard) and 'Traceback' not in errors


def test_nobody_asks_a_clock_that_can_be_set_but_for_names_and_recorded_stamps():
    sources = [path for folder in ('dae_ros', 'nodes') for path in (REPOSITORY / folder).rglob('*.py')]
    asking = {path.relative_to(REPOSITORY).as_posix() for path in sources if WALL_CLOCK.search(path.read_text())}
    assert asking <= MAY_ASK


class HostClock:
    """Sets the host's clock, as far as processes that are started from here on can tell. To this one it is as ever."""

    def __init__(self, library: Path, offset: Path, monkeypatch):
        self._offset = offset
        self.set(0)
        monkeypatch.setenv('CLOCK_OFFSET', str(offset))
        monkeypatch.setenv('LD_PRELOAD', str(library))

    def set(self, seconds: int) -> None:
        with open(self._offset, 'r+b' if self._offset.exists() else 'wb') as file:
            file.write(struct.pack('=q', seconds))


@pytest.fixture
def host_clock(tmp_path, monkeypatch):
    return HostClock(preloadable('clock_jump.c', tmp_path), tmp_path / 'offset', monkeypatch)


UPDATES = 80
VALUES = {**LASTING, 'total_steps': UPDATES * 8 * 25, 'rollout_timeout': 60.0}


@pytest.fixture(scope='module')
def expected(tmp_path_factory):
    return oracle(tmp_path_factory.mktemp('alone') / 'run', VALUES)


@pytest.mark.parametrize('killed', [None, 'agents_0-2'])
def test_a_training_goes_on_to_the_same_weights_when_the_clock_is_set_back_by_an_hour_and_then_right(
        killed, domain, host_clock, expected, tmp_path):
    settings = config.from_flat(VALUES)
    folder = RunFolder(tmp_path / 'run', settings)
    nodes = {f'/{node}' for process in training_graph(settings, folder) for node in process.nodes}
    shown: dict[str, int] = {}  # hours that a node's clock is off

    def hear(report: DiagnosticArray) -> None:
        shown[report.status[0].name] = round((report.header.stamp.sec - time.time()) / HOUR)

    process = bringup(folder.path, VALUES)
    try:
        with Listener() as listener:
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, hear, qos.EVENTS)
            listener.wait_for_status(lambda status: status.policy_version >= 3)
            attempts = (folder.path / 'attempts').read_text()
            for hours in (-1, 0):
                host_clock.set(hours * HOUR)
                listener.spin_until(lambda: shown == dict.fromkeys(nodes, hours), lambda: str(shown))
                if killed and hours:
                    os.kill(pid_of(killed, folder.path), signal.SIGKILL)
                    version = max(int(path.stem[-8:]) for path in folder.checkpoints.glob('checkpoint_*'))
                    listener.wait_for_status(lambda status: status.policy_version >= min(version + 5, UPDATES))
        code, output, errors = finish(process)
    finally:
        host_clock.set(0)
        process.kill()
    assert code == 0, output + errors
    summary = Summary.read(folder.summary_file)
    assert (summary.weights_sha256, summary.evaluation_return) == expected
    assert 'is killed' not in output
    assert output.count('started again') == (killed is not None)
    assert killed or (folder.path / 'attempts').read_text() == attempts, 'a rollout was begun anew'
    assert not any('Traceback' in text for text in (output, errors, *(log.read_text() for log in folder.path.glob('logs/*'))))
