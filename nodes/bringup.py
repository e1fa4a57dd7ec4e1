"""bringup: trains a team from one task file, or drives robots with it: starts the whole graph, and stops it again.

    ros2 run dae_ros bringup navigation -p seed:=2
    ros2 run dae_ros bringup config/navigation.yaml --in-process
    ros2 run dae_ros bringup navigation --execute runs/mine/policy.safetensors
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dae_ros import torchrun
from dae_ros.command import interrupt_once, run_command, uninterrupted
from dae_ros.config import ROBOT_SETTINGS, SETTINGS, Settings
from dae_ros.errors import SettingsError

if TYPE_CHECKING:
    from dae_ros.report.progress import ProgressDisplay
    from dae_ros.run_folder import RunFolder


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    settings_help, robots_help = ('\n'.join(f'  {info.name} := {info.default!r}  {info.describe()}' for info in group.values())
                                  for group in (SETTINGS, ROBOT_SETTINGS))
    parser = argparse.ArgumentParser(prog='bringup', description=__doc__.split('\n')[0].removeprefix('bringup: '),
                                     epilog=f'settings (in the task file, or with -p):\n{settings_help}\n\n'
                                            f'with --execute also:\n{robots_help}',
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('task_file', nargs='?', help='a task file, or the name of one that comes with the package, such as '
                                                     'navigation; without one every setting has its default')
    parser.add_argument('-p', '--parameter', action='append', default=[], metavar='NAME:=VALUE', help='change a setting')
    parser.add_argument('--run-folder', type=Path, help='where the run goes; default runs/<task file>-<time>. A folder with '
                                                        'an unfinished run of the same settings resumes it')
    parser.add_argument('--namespace', default='', help='namespace of the team, so that several can run side by side')
    parser.add_argument('--key-file', default='', help='file with the key that the team signs its policies with; without one '
                                                       'they are not signed')
    parser.add_argument('--in-process', action='store_true', help='the same run, bit for bit, in this process without ROS')
    parser.add_argument('--execute', metavar='POLICY', help='drive robots with a trained team: a policy file, the name of one '
                                                            'that comes with the package, or parameter_server for what that has')
    parser.add_argument('--stream', action='store_true', help='train with robots that act at their own rate')
    parser.add_argument('--watch', type=int, metavar='WORLD', help='publish who earns what in this world after each update, on '
                                                               'robot_<i>/credit')
    parser.add_argument('--simulate', action='store_true', help='with --execute or --stream: our simulator plays the robots')
    return parser.parse_args(arguments)


def train_in_process(settings: Settings, folder: RunFolder, display: ProgressDisplay) -> None:
    """The run without ROS. Raises KeyboardInterrupt through; what was checkpointed stays."""
    with uninterrupted():
        from dae_ros.final_report import write_report
        from dae_ros.rollout.in_process import train
        from dae_ros.training import Training
        from dae_ros.worlds import make_worlds, world_spec

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


def train_on_graph(settings: Settings, folder: RunFolder, arguments: argparse.Namespace, display: ProgressDisplay) -> None:
    """The run as separate processes. Raises DaeRosError when it cannot go on."""
    with uninterrupted():
        from dae_ros.ros.graph import training_graph, watching
        from dae_ros.ros.graph_run import GraphRun

    processes = watching(training_graph(settings, folder, arguments.key_file), arguments.watch)
    GraphRun(settings, folder, arguments.namespace, display, processes).run()


def train_on_robots(settings: Settings, folder: RunFolder, arguments: argparse.Namespace, display: ProgressDisplay) -> None:
    """The run as a stream of what robots do. Raises DaeRosError when it cannot go on."""
    with uninterrupted():
        from dae_ros.ros.execution import streaming_graph
        from dae_ros.ros.graph import read_values, watching
        from dae_ros.ros.graph_run import GraphRun

    values = read_values(task_file_of(arguments), arguments.parameter)
    processes = watching(streaming_graph(settings, values, folder, arguments.simulate, arguments.key_file), arguments.watch)
    GraphRun(settings, folder, arguments.namespace, display, processes).run()


def task_file_of(arguments: argparse.Namespace) -> Path | None:
    from dae_ros.ros.graph import find_task_file

    return find_task_file(arguments.task_file) if arguments.task_file else None


def execute(arguments: argparse.Namespace) -> None:
    """Drives robots until Ctrl-C."""
    with uninterrupted():
        from dae_ros.ros.execution import execution_graph, find_policy, write_values
        from dae_ros.ros.execution_run import ExecutionRun
        from dae_ros.ros.graph import read_values
        from dae_ros.run_folder import new_run

    values = read_values(task_file_of(arguments), arguments.parameter)
    folder = arguments.run_folder or new_run('execution')
    processes = execution_graph(values, find_policy(arguments.execute), arguments.simulate, arguments.key_file)
    print(f'driving; Ctrl-C stops the robots (logs of the nodes in {folder / "logs"})', flush=True)
    settings_file = write_values(values, folder / 'settings.yaml')
    ExecutionRun(processes, settings_file, arguments.namespace, lambda line: print(line, flush=True)).run()


def bring_up(arguments: argparse.Namespace) -> int:
    """The run that the arguments describe, or this process's part of its learning. The exit code."""
    if arguments.simulate and not (arguments.execute or arguments.stream):
        raise SettingsError('--simulate goes with --execute POLICY or --stream')
    if arguments.watch is not None and (arguments.execute or arguments.in_process):
        raise SettingsError('--watch goes with a training on the graph')
    if arguments.execute:
        execute(arguments)
        return 0
    if torchrun.rank() > 0:
        from dae_ros.learning.distributed import help_to_learn

        help_to_learn()
        return 0
    # Here, because it takes a second in which Ctrl-C is to be heard; it waits, since Python tells of one that meets an import.
    with uninterrupted():
        from dae_ros.report.progress import ProgressDisplay
        from dae_ros.report.summary import Summary
        from dae_ros.ros.graph import read_settings
        from dae_ros.run_folder import RunFolder, new_run

    task_file = task_file_of(arguments)
    settings = read_settings(task_file, arguments.parameter)
    stem = task_file.stem if task_file else settings.task.task.replace(':', '_')
    path = arguments.run_folder or new_run(stem)
    folder = RunFolder(path, settings)
    with ProgressDisplay() as display:
        display.note(f'training in {path} (logs of the nodes in {path / "logs"})')
        if arguments.stream:
            train_on_robots(settings, folder, arguments, display)
        elif arguments.in_process:
            train_in_process(settings, folder, display)
        else:
            train_on_graph(settings, folder, arguments, display)
    print(Summary.read(folder.summary_file).lines())
    return 0


def main(args: list[str] | None = None) -> int:
    def act() -> int:
        interrupt_once()
        return bring_up(parse_arguments(args))

    return run_command(act, 'stopped; every process is down')


if __name__ == '__main__':
    sys.exit(main())
