"""Nothing waits by a clock that can be set: timers go on where a node's time stands still, and nobody else asks for the time."""

from __future__ import annotations

import re

from diagnostic_msgs.msg import DiagnosticArray
from harness import REPOSITORY, TIMEOUT, Listener
from test_parameters import start

from dae_ros.ros import names, qos

WALL_CLOCK = re.compile(r'time\.time\b|time_ns\(|datetime\.now|clock_gettime')
NAMES_FOLDERS = {'nodes/bringup.py', 'nodes/recorder.py', 'launch/train.launch.py'}  # and stamps what is recorded


def test_a_node_whose_clock_stands_still_goes_on_giving_signs_of_life(domain, tmp_path):
    process = start('world', '-p', 'use_sim_time:=true', cwd=tmp_path)  # and nobody publishes the time
    heard: list[DiagnosticArray] = []
    try:
        with Listener() as listener:
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, heard.append, qos.EVENTS)
            listener.spin_until(lambda: len(heard) >= 3)
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=TIMEOUT)
    assert all(report.header.stamp.sec == 0 for report in heard) and 'Traceback' not in errors


def test_nothing_but_names_of_folders_and_recorded_stamps_come_from_a_clock_that_can_be_set():
    sources = [path for folder in ('dae_ros', 'nodes', 'launch') for path in (REPOSITORY / folder).rglob('*.py')]
    asking = {path.relative_to(REPOSITORY).as_posix() for path in sources if WALL_CLOCK.search(path.read_text())}
    assert asking <= NAMES_FOLDERS
