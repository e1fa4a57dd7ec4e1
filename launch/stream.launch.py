"""Trains a team from what its robots do at their own rate: the same processes that `bringup --stream` starts.

    ros2 launch dae_ros stream.launch.py task_file:=streaming simulate:=true parameters:="seed:=2"
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dae_ros.restarts import Restarts, describe
from dae_ros.ros.execution import streaming_graph
from dae_ros.ros.graph import find_task_file, node_environment, read_settings, read_values
from dae_ros.run_folder import RunFolder
from launch import LaunchDescription

RESPAWN_DELAY = 2.0  # s


def start(context) -> list:
    """The nodes of the run that the launch arguments describe; when the trainer is done, or one keeps dying, all end."""
    names = ('task_file', 'namespace', 'run_folder', 'simulate', 'parameters')
    argument = {name: LaunchConfiguration(name).perform(context) for name in names}
    task_file = find_task_file(argument['task_file'])
    overrides = argument['parameters'].split()
    settings, values = read_settings(task_file, overrides), read_values(task_file, overrides)
    path = argument['run_folder'] or f'runs/{task_file.stem}-{datetime.now():%Y%m%d-%H%M%S}'
    folder = RunFolder(Path(path).absolute(), settings)
    restarts = Restarts(settings.run.max_restarts)

    def end_all(name: str):
        def on_exit(event, _) -> Shutdown | None:
            if (name, event.returncode) == ('trainer', 0) or restarts.delay(name, event.returncode) is None:
                return Shutdown(reason=f'{name} {describe(event.returncode)}')

        return on_exit

    environment = [SetEnvironmentVariable(name, value) for name, value in node_environment().items()]
    return environment + [
        Node(package='dae_ros', executable=process.executable, name=process.name, namespace=argument['namespace'],
             parameters=[str(folder.settings_file), dict(process.parameters)], output='screen', respawn=True,
             respawn_delay=RESPAWN_DELAY, on_exit=end_all(process.name))
        for process in streaming_graph(settings, values, folder, argument['simulate'] == 'true')]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        DeclareLaunchArgument('task_file', default_value='streaming', description='a task file, or the name of one in config/'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the team'),
        DeclareLaunchArgument('run_folder', default_value='', description='where the run goes; default runs/<task file>-<time>'),
        DeclareLaunchArgument('simulate', default_value='false', description='our simulator plays the robots'),
        DeclareLaunchArgument('parameters', default_value='', description='settings to change: "seed:=2 beta:=1"'),
        OpaqueFunction(function=start),
    ])
