"""The processes of a training, described once: `bringup` and the launch files start what this says."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from dae_ros.config import Settings
from dae_ros.run_folder import RunFolder


class NodeProcess(NamedTuple):
    """One node in a process of its own."""

    executable: str
    name: str
    parameters: dict[str, Any]  # beside those of the run's settings file

    def arguments(self, settings_file: Path, namespace: str) -> list[str]:
        """What follows the executable on its command line."""
        arguments = ['--ros-args', '--params-file', str(settings_file), '-r', f'__node:={self.name}']
        if namespace:
            arguments += ['-r', f'__ns:=/{namespace.strip("/")}']
        for name, value in self.parameters.items():
            arguments += ['-p', f'{name}:={value}']
        return arguments


def training_graph(settings: Settings, folder: RunFolder) -> list[NodeProcess]:
    """World, one agent per robot, parameter server and trainer of one run."""
    run = {'run': folder.run}
    agents = [NodeProcess('agent', f'agent_{robot}', {'robot': robot, **run}) for robot in range(settings.task.num_agents)]
    return [
        NodeProcess('world', 'world', run),
        *agents,
        NodeProcess('parameter_server', 'parameter_server', {'policies_folder': folder.policies, **run}),
        NodeProcess('trainer', 'trainer', {'run_folder': folder.path}),
    ]
