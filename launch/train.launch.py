"""Trains a team: the same processes that `bringup` starts, from the same description.

    ros2 launch dae_ros train.launch.py task_file:=navigation namespace:=red parameters:="seed:=2 beta:=1"
"""

from __future__ import annotations

from pathlib import Path

from dae_ros.ros.graph import find_task_file, read_settings, training_graph
from dae_ros.ros.launched import description, nodes
from dae_ros.run_folder import RunFolder, new_run


def start(argument: dict[str, str]) -> list:
    """The nodes of the run that the launch arguments describe."""
    task_file = find_task_file(argument['task_file'])
    settings = read_settings(task_file, argument['parameters'].split())
    folder = RunFolder(Path(argument['run_folder'] or new_run(task_file.stem)).absolute(), settings)
    return nodes(training_graph(settings, folder, argument['key_file']), folder.settings_file, argument['namespace'],
                 settings.run.max_restarts)


def generate_launch_description():
    return description(('task_file', 'namespace', 'run_folder', 'key_file', 'parameters'), start)
