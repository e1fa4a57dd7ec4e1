"""The processes of a training, described once: `bringup` and the launch files start what this says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Iterable, NamedTuple

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.errors import SettingsError
from dae_ros.run_folder import RunFolder
from dae_ros.worlds import world_spec

_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


class NodeProcess(NamedTuple):
    """One node in a process of its own."""

    executable: str
    name: str
    parameters: dict[str, int | str]  # beside those of the run's settings file

    def arguments(self, settings_file: Path, namespace: str) -> list[str]:
        """What follows the executable on its command line."""
        arguments = ['--ros-args', '--params-file', str(settings_file), '-r', f'__node:={self.name}']
        if namespace:
            arguments += ['-r', f'__ns:=/{namespace.strip("/")}']
        for name, value in self.parameters.items():
            arguments += ['-p', f'{name}:={value}']
        return arguments


def training_graph(settings: Settings, folder: RunFolder) -> list[NodeProcess]:
    """Parameter server, trainer and, for each group, a world and one agent per robot: the processes of one run."""
    run = {'run': folder.run}
    return [
        *(process for group in range(settings.task.world_groups) for process in _group(settings, group, run)),
        NodeProcess('parameter_server', 'parameter_server',
                    {'policies_folder': str(folder.policies), 'keep_policies': settings.run.keep_checkpoints, **run}),
        NodeProcess('trainer', 'trainer', {'run_folder': str(folder.path)}),
    ]


def _group(settings: Settings, group: int, run: dict[str, int]) -> list[NodeProcess]:
    """World and agents of one group, numbered where there are several."""
    mark = f'_{group}' if settings.task.world_groups > 1 else ''
    agents = [NodeProcess('agent', f'agent{mark}_{robot}', {'group': group, 'robot': robot, **run})
              for robot in range(settings.task.num_agents)]
    return [NodeProcess('world', f'world{mark}', {'group': group, **run}), *agents]


def find_task_file(name: str) -> Path:
    """The file `name`, or the task file of that name in the package's config folder. Raises SettingsError."""
    if '/' in name or name.endswith('.yaml'):
        return Path(name)
    shipped = shipped_config()
    if not (shipped / f'{name}.yaml').exists():
        there = ', '.join(sorted(path.stem for path in shipped.glob('*.yaml')))
        raise SettingsError(f'there is no task file {name!r}; the package has {there}')
    return shipped / f'{name}.yaml'


def shipped_config() -> Path:
    """The config folder of the installed package, or of the source tree."""
    try:
        from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
    except ImportError:  # an in-process run needs no ROS
        return Path(__file__).parents[2] / 'config'
    try:
        return Path(get_package_share_directory('dae_ros')) / 'config'
    except PackageNotFoundError:
        return Path(__file__).parents[2] / 'config'


def read_settings(task_file: Path | None, overrides: Iterable[str]) -> Settings:
    """The task file's settings with the `name:=value` overrides put in, checked as a whole. Raises SettingsError."""
    values = config.load_task_file(task_file) if task_file else {}
    values.update(config.parse_override(text) for text in overrides)
    settings = config.from_flat(values)
    world_spec(settings.task)
    return settings


def node_environment() -> dict[str, str]:
    """Environment variables for the nodes where the user has set none: this host only, and quick discovery."""
    defaults = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', _PROFILES: _profiles('fastdds.xml')}
    return {name: os.environ.get(name, value) for name, value in defaults.items()}


def acknowledging_environment() -> dict[str, str]:
    """Environment variables for a node that waits until its messages are acknowledged, which otherwise takes seconds."""
    ours = os.environ.get(_PROFILES) in (None, _profiles('fastdds.xml'))
    return {_PROFILES: _profiles('fastdds_player.xml')} if ours else {}


def _profiles(name: str) -> str:
    return str((shipped_config() / name).resolve())
