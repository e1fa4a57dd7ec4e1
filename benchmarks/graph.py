"""Times training over the ROS graph beside the same training in one process, and says where the time goes.

    python -m benchmarks.graph [--beta 0 0.95] [--robots 3] [--worlds 128] [--updates 30] [--rounds 3]

Navigation, 25 steps a rollout, otherwise default settings. The graph with all agents in one process, the graph with a
process for each, and the single process take turns, so that all meet the same disturbances; every number is the median
of the rounds. Steps per second leave out the first updates, which warm up, and count everything else: collecting,
learning, logs and checkpoints. A tick is one step of all worlds; its CPU milliseconds are those of the process's
threads, DDS's among them, while a rollout is collected.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Callable, Sequence

import rclpy
from dae_ros_msgs.msg import TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.report.metrics import STEPS, read_metrics
from dae_ros.ros import names, qos
from dae_ros.ros.farewell import leave
from dae_ros.ros.graph import NodeProcess, node_environment, training_graph
from dae_ros.ros.supervisor import Supervisor
from dae_ros.run_folder import RunFolder

WARM_UP = 3      # updates
TIMEOUT = 600.0  # s for whatever is waited for
ANSWER_TIMEOUT = 5.0  # s after which a service is asked again
GRAPHS = {'graph': 0, 'agents_apart': 1}  # robots per process


def cpu_seconds(process: int) -> float:
    """Processor time that a process has used, all its threads together."""
    return time.clock_gettime(~process << 3 | 2)  # the clock that clock_getcpuclockid(3) gives


def run_graph(settings: Settings, path: Path, updates: int, bag: Path | None = None) -> dict[str, float]:
    """Trains over the graph for `updates` updates, recorded into `bag` if there is one; CPU seconds per tick while collecting,
    by node. The training begins when the recorder, which nobody waits for, has found all nodes."""
    folder = RunFolder(path, settings)
    codes: dict[str, int] = {}
    supervisor = Supervisor(path / 'logs', codes.__setitem__)
    processes: dict[str, int] = {}
    used: Counter[str] = Counter()
    before: dict[str, float] = {}
    rollouts, newest, recorder = 0, 0, ''

    def hear(status: TrainingStatus) -> None:
        nonlocal before, newest, rollouts
        now = {name: cpu_seconds(process) for name, process in processes.items()}
        if status.run != folder.run:
            return
        newest = status.policy_version
        if before and status.state == TrainingStatus.LEARNING:
            used.update({name: now[name] - before[name] for name in now})
            rollouts += 1
        before = now if status.state == TrainingStatus.COLLECTING and newest >= WARM_UP else {}

    def diagnosed(report: DiagnosticArray) -> None:
        nonlocal recorder
        recorder = next((status.message for status in report.status if status.name == '/recorder'), recorder)

    def spin_until(condition: Callable[[], bool], limit: float = TIMEOUT) -> bool:
        """Whether the condition holds within so many seconds."""
        deadline = time.monotonic() + limit
        while not condition() and time.monotonic() < deadline:
            if codes:
                raise RuntimeError(f'a node ended, exit codes {codes}; the logs are in {path / "logs"}')
            executor.spin_once(timeout_sec=1.0)
        return condition()

    def expect(condition: Callable[[], bool]) -> None:
        if not spin_until(condition):
            raise RuntimeError(f'the graph stood still; its logs are in {path / "logs"}')

    def call(name: str) -> None:
        """Asks again where the answer was dropped, as it may be for a client that has just been met."""
        client = node.create_client(Trigger, name)
        expect(client.service_is_ready)
        while not spin_until(client.call_async(Trigger.Request()).done, ANSWER_TIMEOUT):
            pass

    rclpy.init(args=[])
    node = rclpy.create_node('benchmark', start_parameter_services=False)
    node.create_subscription(TrainingStatus, names.TRAINING_STATUS, hear, qos.LATCHED_INPUT)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        nodes = {process.name: process for process in training_graph(settings, folder)}
        if bag is not None:
            nodes = {'trainer': nodes.pop('trainer'), 'recorder': NodeProcess('recorder', 'recorder', {'bag': str(bag)}), **nodes}
            node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, diagnosed, qos.EVENTS)
        for process in nodes.values():
            command = [sys.executable, '-m', f'dae_ros_nodes.{process.executable}',
                       *process.arguments(folder.settings_file, '')]
            processes[process.name] = supervisor.start(process.name, command, os.environ)
            if bag is not None and process.name == 'trainer':
                call(names.PAUSE)
        if bag is not None:
            expect(lambda: recorder == 'recording')
            call(names.RESUME)
        expect(lambda: newest >= updates)
    finally:
        supervisor.stop()
        leave([node])
        rclpy.try_shutdown()
    return {name: seconds / rollouts / settings.run.num_steps for name, seconds in used.items()}


def run_single_process(settings: Settings, path: Path) -> None:
    """The same training in one process."""
    path.mkdir()
    task_file = path / 'task.yaml'
    task_file.write_text(settings_yaml.dump(settings))
    subprocess.run([sys.executable, '-m', 'dae_ros_nodes.bringup', str(task_file), '--in-process', '--run-folder',
                    str(path / 'run')], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def timing(folder: Path) -> dict[str, float]:
    """Steps per second and the milliseconds of a rollout's phases, from a run's metrics after the warm-up."""
    metrics = read_metrics(folder / 'metrics.csv')
    steps, seconds = metrics[STEPS], metrics[STEPS] / metrics['steps_per_second']
    phases = {name: 1e3 * statistics.median(metrics[f'seconds/{name}'][WARM_UP:]) for name in ('collecting', 'learning')}
    return {'steps_per_second': (steps[-1] - steps[WARM_UP - 1]) / (seconds[-1] - seconds[WARM_UP - 1]), **phases}


def medians(rounds: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(one[name] for one in rounds) for name in rounds[0]}


def measure(betas: Sequence[float] = (0.0, 0.95), robots: int = 3, worlds: int = 128, updates: int = 30,
            rounds: int = 3) -> dict:
    """For each beta: `single_process`, `graph` and `agents_apart` (steps_per_second, collecting and learning in ms), the graphs
    with `ratio` over the single process and `ratios` of the turns, `transport`, which is what collecting takes longer than in
    the single process, and `cpu_ms_per_tick` by process."""
    os.environ.update(node_environment())
    results = {}
    for beta in betas:
        settings = config.from_flat({'num_agents': robots, 'num_worlds': worlds, 'beta': beta, 'evaluation_episodes': 0,
                                     'total_steps': updates * worlds * config.RunSettings.num_steps})
        timings, cpu = {name: [] for name in (*GRAPHS, 'single_process')}, {name: [] for name in GRAPHS}
        with tempfile.TemporaryDirectory() as scratch:
            for turn in range(rounds):
                for name, together in GRAPHS.items():
                    path = Path(scratch, f'{name}{turn}')
                    cpu[name].append(run_graph(config.from_flat({'robots_per_process': together}, settings), path, updates))
                    timings[name].append(timing(path))
                run_single_process(settings, Path(scratch, f'single{turn}'))
                timings['single_process'].append(timing(Path(scratch, f'single{turn}', 'run')))
        single = timings['single_process']
        results[f'{beta:g}'] = {'single_process': medians(single),
                                **{name: beside(timings[name], single) | {'cpu_ms_per_tick': milliseconds(cpu[name])}
                                   for name in GRAPHS}}
    return results


def beside(graph: Sequence[dict[str, float]], single: Sequence[dict[str, float]]) -> dict:
    """What `measure` says of a graph, from the turns of both."""
    ratios = [one['steps_per_second'] / other['steps_per_second'] for one, other in zip(graph, single)]
    transport = [one['collecting'] - other['collecting'] for one, other in zip(graph, single)]
    return {**medians(graph), 'ratio': statistics.median(ratios), 'ratios': ratios, 'transport': statistics.median(transport)}


def milliseconds(rounds: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: 1e3 * seconds for name, seconds in medians(rounds).items()}


def as_text(beta: str, found: dict) -> str:
    """What `measure` found for one beta, for people."""
    lines = [f'beta {beta}']
    for name, one in found.items():
        lines.append(f'  {name.replace("_", " "):16}{one["steps_per_second"]:8.0f} steps/s'
                     f'   collecting {one["collecting"]:6.1f} ms   learning {one["learning"]:7.1f} ms')
    for name in GRAPHS:
        one = found[name]
        lines.append(f'  {name.replace("_", " ")} at {one["ratio"]:.3f} of the single process '
                     f'({", ".join(f"{ratio:.3f}" for ratio in one["ratios"])}), transport {one["transport"]:.0f} ms')
        lines.append('    CPU per tick  ' + '   '.join(f'{node} {ms:.2f} ms' for node, ms in one['cpu_ms_per_tick'].items()))
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--beta', type=float, nargs='+', default=[0.0, 0.95])
    parser.add_argument('--robots', type=int, default=3)
    parser.add_argument('--worlds', type=int, default=128)
    parser.add_argument('--updates', type=int, default=30)
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--json', action='store_true', help='print the numbers as JSON')
    arguments = parser.parse_args()
    results = measure(arguments.beta, arguments.robots, arguments.worlds, arguments.updates, arguments.rounds)
    if arguments.json:
        print(json.dumps(results, indent=2))
        return
    for beta, found in results.items():
        print(as_text(beta, found))


if __name__ == '__main__':
    main()
