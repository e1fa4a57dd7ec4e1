"""Drives robots with a trained team: the same processes that `bringup --execute` starts, from the same description.

    ros2 launch dae_ros execute.launch.py policy:=navigation task_file:=navigation simulate:=true
"""

from __future__ import annotations

from dae_ros.ros.execution import execution_graph, find_policy, write_values
from dae_ros.ros.graph import find_task_file, read_values
from dae_ros.ros.launched import description, nodes
from dae_ros.run_folder import new_run


def start(argument: dict[str, str]) -> list:
    """Agents and bridges of the team that the launch arguments describe."""
    values = read_values(find_task_file(argument['task_file']), argument['parameters'].split())
    processes = execution_graph(values, find_policy(argument['policy']), argument['simulate'] == 'true')
    settings_file = write_values(values, new_run('execution').absolute() / 'settings.yaml')
    return nodes(processes, settings_file, argument['namespace'])


def generate_launch_description():
    return description(('policy', 'task_file', 'namespace', 'simulate', 'parameters'), start)
