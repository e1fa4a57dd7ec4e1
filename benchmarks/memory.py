"""Memory of every process of a training on the graph, update after update: it must not grow.

    python -m benchmarks.memory [--updates 2200] [--robots 4]

The matrix game in 8 worlds, started by bringup. What the kernel says is resident (RSS) and what of it is a process's own,
without libraries and DDS's shared memory, is read every 100 updates. Growth, of what is its own, is the median of the last
three readings less that of three from update 200 on, when buffers and caches have been filled.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from dae_ros_msgs.msg import TrainingStatus
from rclpy.executors import SingleThreadedExecutor

from dae_ros.ros import names, qos
from dae_ros.ros.farewell import leave
from dae_ros.ros.graph import node_environment

EVERY, WARM_UP = 100, 200  # updates
READINGS, SHOWN = 3, 5     # how many make a median, and every which one is shown
TIMEOUT = 120.0  # s without any news of the graph
MIB = 2**20


class Reading(NamedTuple):
    """Memory of a process [MiB]."""

    resident: float
    own: float


def read(bringup: int) -> dict[str, Reading]:
    """Memory of bringup and of each process it started, by name."""
    children = Path(f'/proc/{bringup}/task/{bringup}/children').read_text().split()
    found = {Path(os.readlink(f'/proc/{child}/fd/1')).stem: child for child in children}
    page = os.sysconf('SC_PAGE_SIZE') / MIB
    memory = {}
    for name, process in {**found, 'bringup': bringup}.items():
        resident, shared = (int(pages) * page for pages in Path(f'/proc/{process}/statm').read_text().split()[1:3])
        memory[name] = Reading(resident, resident - shared)
    return memory


def measure(updates: int = 2200, robots: int = 4) -> dict[str, Any]:
    """`updates`, memory `resident` and `own` at each of them and `growth` by process [MiB], and `seconds` the run took."""
    os.environ.update(node_environment())
    readings: dict[int, dict[str, Reading]] = {}
    newest, heard_at, began = 0, time.monotonic(), time.monotonic()
    values = {'task': 'matrix_game', 'num_agents': robots, 'num_worlds': 8, 'num_steps': robots, 'epochs': 1,
              'reward_network.epochs': 1, 'evaluation_episodes': 0, 'total_steps': (updates + 1) * 8 * robots}
    settings = [text for name, value in values.items() for text in ('-p', f'{name}:={value}')]

    def hear(status: TrainingStatus) -> None:
        nonlocal newest, heard_at
        newest, heard_at = max(newest, status.policy_version), time.monotonic()
        if newest >= WARM_UP and newest // EVERY * EVERY not in readings:
            readings[newest // EVERY * EVERY] = read(bringup.pid)

    rclpy.init(args=[])
    node = rclpy.create_node('benchmark', namespace='memory', start_parameter_services=False)
    node.create_subscription(TrainingStatus, names.TRAINING_STATUS, hear, qos.LATCHED_INPUT)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with tempfile.TemporaryDirectory() as scratch:
        bringup = subprocess.Popen([sys.executable, '-m', 'dae_ros_nodes.bringup', '--run-folder', str(Path(scratch, 'run')),
                                    '--namespace', 'memory', *settings], stdout=subprocess.DEVNULL)
        try:
            while newest < updates:
                executor.spin_once(timeout_sec=1.0)
                if bringup.poll() is not None or time.monotonic() - heard_at > TIMEOUT:
                    raise RuntimeError('the graph stood still')
        finally:
            bringup.send_signal(signal.SIGINT)
            bringup.wait()
            leave([node])
            rclpy.try_shutdown()
    rows = {name: [reading[name] for reading in readings.values()] for name in readings[WARM_UP]}
    own = {name: [reading.own for reading in row] for name, row in rows.items()}
    return {'updates': list(readings), 'seconds': time.monotonic() - began, 'own': own,
            'resident': {name: [reading.resident for reading in row] for name, row in rows.items()},
            'growth': {name: growth(row) for name, row in own.items()}}


def growth(readings: list[float]) -> float:
    return statistics.median(readings[-READINGS:]) - statistics.median(readings[:READINGS])


def as_text(found: dict[str, Any]) -> str:
    """What `measure` found, for people."""
    lines = [f'{"[MiB its own] update":24}' + ''.join(f'{update:8}' for update in found['updates'][::SHOWN])
             + f'{"growth":>10}{"resident":>10}']
    for name, each in found['own'].items():
        lines.append(f'  {name:22}' + ''.join(f'{one:8.1f}' for one in each[::SHOWN])
                     + f'{found["growth"][name]:10.2f}{found["resident"][name][-1]:10.1f}')
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--updates', type=int, default=2200)
    parser.add_argument('--robots', type=int, default=4)
    arguments = parser.parse_args()
    print(as_text(measure(arguments.updates, arguments.robots)))


if __name__ == '__main__':
    main()
