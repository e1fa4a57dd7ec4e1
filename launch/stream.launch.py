"""Trains a team from what its robots do at their own rate: the same processes that `bringup --stream` starts.

    ros2 launch dae_ros stream.launch.py task_file:=streaming simulate:=true parameters:="seed:=2"
"""

from __future__ import annotations

from pathlib import Path

from dae_ros.ros.execution import streaming_graph
from dae_ros.ros.graph import find_task_file, read_settings, read_values
from dae_ros.ros.launched import description, nodes
from dae_ros.run_folder import RunFolder, new_run


def start(argument: dict[str, str]) -> list:
    """The nodes of the run that the launch arguments describe."""
    task_file = find_task_file(argument['task_file'])
    overrides = argument['parameters'].split()
    settings, values = read_settings(task_file, overrides), read_values(task_file, overrides)
    folder = RunFolder(Path(argument['run_folder'] or new_run(task_file.stem)).absolute(), settings)
    return nodes(streaming_graph(settings, values, folder, argument['simulate'] == 'true'), folder.settings_file,
                 argument['namespace'], settings.run.max_restarts)


def generate_launch_description():
    return description(('task_file', 'namespace', 'run_folder', 'simulate', 'parameters'), start, task_file='streaming')
