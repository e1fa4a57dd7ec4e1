"""Drives robots with a trained team: the same processes that `bringup --execute` starts, from the same description.

    ros2 launch dae_ros execute.launch.py policy:=navigation task_file:=navigation simulate:=true
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dae_ros.ros.execution import execution_graph, find_policy, write_values
from dae_ros.ros.graph import find_task_file, node_environment, read_values
from launch import LaunchDescription

RESPAWN_DELAY = 2.0  # s


def start(context) -> list:
    """Agents and bridges of the team that the launch arguments describe."""
    names = ('policy', 'task_file', 'namespace', 'simulate', 'parameters')
    argument = {name: LaunchConfiguration(name).perform(context) for name in names}
    values = read_values(find_task_file(argument['task_file']), argument['parameters'].split())
    processes = execution_graph(values, find_policy(argument['policy']), argument['simulate'] == 'true')
    settings_file = write_values(values, Path(f'runs/execution-{datetime.now():%Y%m%d-%H%M%S}/settings.yaml').absolute())
    environment = [SetEnvironmentVariable(name, value) for name, value in node_environment().items()]
    return environment + [
        Node(package='dae_ros', executable=process.executable, name=process.name, namespace=argument['namespace'],
             parameters=[str(settings_file), dict(process.parameters)], output='screen', respawn=True,
             respawn_delay=RESPAWN_DELAY)
        for process in processes]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        DeclareLaunchArgument('policy', description='a policy file, the name of one that comes with the package, or '
                                                    'parameter_server for what that has'),
        DeclareLaunchArgument('task_file', default_value='navigation', description='a task file, or the name of one in config/'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the team'),
        DeclareLaunchArgument('simulate', default_value='false', description='our simulator plays the robots'),
        DeclareLaunchArgument('parameters', default_value='', description='settings to change: "max_speed:=0.3"'),
        OpaqueFunction(function=start),
    ])
