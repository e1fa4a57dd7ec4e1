"""Nothing waits by a clock that can be set: timers go on where a node's time stands still, and nobody else asks for the time."""

from __future__ import annotations

import re

from diagnostic_msgs.msg import DiagnosticArray
from harness import REPOSITORY, TIMEOUT, Listener
from test_parameters import start

from dae_ros.ros import names, qos

WALL_CLOCK = re.compile(r'time\.time\b|time_ns\(|datetime\.now|clock_gettime')
MAY_ASK = {'nodes/bringup.py',          # to name a folder
           'nodes/recorder.py',         # to name a bag, and once for the stamps in it
           'dae_ros/ros/graph_run.py',  # for the age of files, as the next
           'dae_ros/ros/shared_memory.py'}


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


def test_nobody_asks_a_clock_that_can_be_set_but_for_names_and_ages_of_files_and_recorded_stamps():
    sources = [path for folder in ('dae_ros', 'nodes') for path in (REPOSITORY / folder).rglob('*.py')]
    asking = {path.relative_to(REPOSITORY).as_posix() for path in sources if WALL_CLOCK.search(path.read_text())}
    assert asking <= MAY_ASK
