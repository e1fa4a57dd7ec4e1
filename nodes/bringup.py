"""bringup: trains a team from one task file: starts the whole graph, shows its progress, and stops it again.

    ros2 run dae_ros bringup navigation -p seed:=2
    ros2 run dae_ros bringup config/navigation.yaml --in-process
"""

from __future__ import annotations

import argparse
import os
import queue
import signal
import sys
import threading
import time
from datetime import datetime
from pathlib import Path

from dae_ros import torchrun
from dae_ros.config import SETTINGS, Settings
from dae_ros.errors import DaeRosError
from dae_ros.report.progress import ProgressDisplay
from dae_ros.report.summary import Summary
from dae_ros.restarts import Restarts, describe
from dae_ros.ros.graph import find_task_file, node_environment, read_settings, training_graph
from dae_ros.run_folder import RunFolder
from dae_ros.worlds import world_spec

LOG_TAIL = 15  # lines of a dead node's log that are shown


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    settings_help = '\n'.join(f'  {info.name} := {info.default!r}  {info.describe()}' for info in SETTINGS.values())
    parser = argparse.ArgumentParser(prog='bringup', description=__doc__.split('\n')[0].removeprefix('bringup: '),
                                     epilog=f'settings (in the task file, or with -p):\n{settings_help}',
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('task_file', nargs='?', help='a task file, or the name of one that comes with the package, such as '
                                                     'navigation; without one every setting has its default')
    parser.add_argument('-p', '--parameter', action='append', default=[], metavar='NAME:=VALUE', help='change a setting')
    parser.add_argument('--run-folder', type=Path, help='where the run goes; default runs/<task file>-<time>. A folder with '
                                                        'an unfinished run of the same settings resumes it')
    parser.add_argument('--namespace', default='', help='namespace of the team, so that several can run side by side')
    parser.add_argument('--in-process', action='store_true', help='the same run, bit for bit, in this process without ROS')
    return parser.parse_args(arguments)


def train_in_process(settings: Settings, folder: RunFolder, display: ProgressDisplay) -> None:
    """The run without ROS. Raises KeyboardInterrupt through; what was checkpointed stays."""
    from dae_ros.final_report import write_report
    from dae_ros.rollout.in_process import train
    from dae_ros.training import Training
    from dae_ros.worlds import make_worlds

    training, worlds = Training(settings, world_spec(settings.task), folder), make_worlds(settings.task)
    try:
        train(training, worlds, lambda: display.update(
            'evaluating' if training.evaluating else 'training', training.environment_steps, training.total_steps,
            training.mean_return, training.steps_per_second, training.policy_version))
        display.note('drawing the report')
        write_report(training, folder)
    finally:
        training.close()
        worlds.close()


def train_on_graph(settings: Settings, folder: RunFolder, namespace: str, display: ProgressDisplay) -> None:
    """The run as separate processes; one that dies is started again. Raises DaeRosError when that does not help."""
    import rclpy
    from dae_ros_msgs.msg import TrainingStatus
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from dae_ros.ros import names, qos
    from dae_ros.ros.supervisor import Supervisor

    states = {getattr(TrainingStatus, name): name.lower() for name in
              ('WAITING', 'COLLECTING', 'LEARNING', 'PAUSED', 'EVALUATING', 'FINISHED', 'FAILED')}
    events: queue.SimpleQueue = queue.SimpleQueue()
    supervisor = Supervisor(folder.path / 'logs', lambda name, code: events.put((name, code)))
    os.environ.update(node_environment())  # for this process too: it must hear the status
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('bringup', namespace=namespace, start_parameter_services=False)
    node.create_subscription(TrainingStatus, names.TRAINING_STATUS, lambda status: events.put(('status', status)),
                             qos.LATCHED_INPUT)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            pass

    spinning = threading.Thread(target=spin, daemon=True)
    # The processes torchrun started learn with the trainer they found, and with no other.
    restarts = Restarts(settings.run.max_restarts if torchrun.size() == 1 else 0)
    graph = {process.name: process for process in training_graph(settings, folder)}
    due = dict.fromkeys(graph, 0.0)  # when to start whom; s, monotonic
    newest, detail = 0, ''
    try:
        while True:
            for name in [name for name, at in due.items() if at <= time.monotonic()]:
                del due[name]
                command = [sys.executable, '-m', f'dae_ros_nodes.{graph[name].executable}',
                           *graph[name].arguments(folder.settings_file, namespace)]
                supervisor.start(name, command, os.environ)
            if spinning.ident is None:
                spinning.start()
            try:
                name, event = events.get(timeout=max(0.0, min(due.values()) - time.monotonic()) if due else None)
            except queue.Empty:
                continue
            if name == 'status':
                if event.run != folder.run:
                    continue
                if event.policy_version > newest:
                    newest = event.policy_version
                    restarts.got_on()
                display.update(states.get(event.state, '?'), event.environment_steps, event.total_steps,
                               event.mean_return, event.steps_per_second, event.policy_version)
                if event.detail not in ('', detail):
                    display.note(event.detail)
                detail = event.detail
            elif name == 'trainer' and event == 0:
                if not folder.summary_file.exists():
                    raise DaeRosError(f'the trainer was stopped before its end; --run-folder {folder.path} goes on from there')
                return
            else:
                delay = restarts.delay(name, event)
                if delay is None:
                    log = supervisor.log_file(name)
                    tail = log.read_text(errors='replace').splitlines()[-LOG_TAIL:]
                    raise DaeRosError('\n'.join([f'{name} {describe(event)}; the end of {log}:', *tail]))
                display.note(f'{name} {describe(event)} and is started again')
                due[name] = time.monotonic() + delay
    finally:
        supervisor.stop()
        rclpy.try_shutdown()
        if spinning.ident is not None:
            spinning.join()


def interrupt(number: int, frame) -> None:
    """SIGTERM ends bringup the way Ctrl-C does."""
    raise KeyboardInterrupt


def main(args: list[str] | None = None) -> int:
    arguments = parse_arguments(args)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        if torchrun.rank() > 0:
            from dae_ros.learning.distributed import help_to_learn

            help_to_learn()
            return 0
        task_file = find_task_file(arguments.task_file) if arguments.task_file else None
        settings = read_settings(task_file, arguments.parameter)
        stem = task_file.stem if task_file else settings.task.task.replace(':', '_')
        path = arguments.run_folder or Path('runs') / f'{stem}-{datetime.now():%Y%m%d-%H%M%S}'
        folder = RunFolder(path, settings)
        with ProgressDisplay() as display:
            display.note(f'training in {path} (logs of the nodes in {path / "logs"})')
            if arguments.in_process:
                train_in_process(settings, folder, display)
            else:
                train_on_graph(settings, folder, arguments.namespace, display)
        print(Summary.read(folder.summary_file).lines())
        return 0
    except KeyboardInterrupt:
        print('stopped; every process is down', file=sys.stderr)
        return 130
    except DaeRosError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2


if __name__ == '__main__':
    sys.exit(main())
