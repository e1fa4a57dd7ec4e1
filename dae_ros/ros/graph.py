"""The processes of a training, described once: `bringup` and the launch files start what this says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Iterable, NamedTuple

from dae_ros import config, settings_yaml
from dae_ros.config import ROBOT_SETTINGS, SETTINGS, Settings
from dae_ros.errors import SettingsError
from dae_ros.ros import names
from dae_ros.run_folder import RunFolder
from dae_ros.worlds import world_spec

_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


class NodeProcess(NamedTuple):
    """A process with one node of the same name, or with several."""

    executable: str
    name: str
    parameters: dict[str, int | str]  # beside those of the run's settings file
    several: tuple[str, ...] = ()     # names of its nodes, which they give themselves; none where it is one node

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of its nodes."""
        return self.several or (self.name,)

    def arguments(self, settings_file: Path, namespace: str) -> list[str]:
        """What follows the executable on its command line."""
        arguments = ['--ros-args', '--params-file', str(settings_file)]
        if not self.several:
            arguments += ['-r', f'__node:={self.name}']
        if namespace:
            arguments += ['-r', f'__ns:=/{namespace.strip("/")}']
        arguments += enclave_arguments(self.name, namespace)
        for name, value in self.parameters.items():
            arguments += ['-p', f'{name}:={value}']
        return arguments


def training_graph(settings: Settings, folder: RunFolder, key_file: str = '') -> list[NodeProcess]:
    """Parameter server, trainer and, for each group, a world and its robots' agents: the processes of one run."""
    run = {'run': folder.run}
    key = key_parameters(key_file)
    return [
        *(process for group in range(settings.task.world_groups) for process in _group(settings, group, run, key)),
        NodeProcess('parameter_server', 'parameter_server',
                    {'policies_folder': str(folder.policies), 'keep_policies': settings.run.keep_checkpoints, **run,
                     **key}),
        NodeProcess('trainer', 'trainer', {'run_folder': str(folder.path), **key}),
    ]


def watching(processes: list[NodeProcess], world: int | None) -> list[NodeProcess]:
    """The same, with a trainer that publishes the credit in this world; None for no world."""
    if world is None:
        return processes
    return [process._replace(parameters={**process.parameters, 'watched_world': world})
            if process.executable in ('trainer', 'stream_trainer') else process for process in processes]


def key_parameters(key_file: str) -> dict[str, str]:
    """What those who sign policies or take them are told."""
    return {'key_file': str(Path(key_file).absolute())} if key_file else {}


def _group(settings: Settings, group: int, run: dict[str, int], key: dict[str, str]) -> list[NodeProcess]:
    """World and agents of one group, numbered where there are several."""
    task = settings.task
    mark = f'_{group}' if task.world_groups > 1 else ''
    teams = process_groups(range(task.num_agents), settings.run.robots_per_process)
    return [NodeProcess('world', f'world{mark}', {'group': group, **run}),
            *(_agents(robots, group, task.world_groups, mark, {**run, **key}) for robots in teams)]


def process_groups(robots: range, together: int) -> list[range]:
    """The robots, so many `together` whose nodes share a process; 0 for all."""
    # With SROS 2 a process has one enclave, and every robot's names its own topics alone.
    together = 1 if _secured() else together or len(robots)
    return [robots[first:first + together] for first in range(0, len(robots), together)]


def _agents(robots: range, group: int, world_groups: int, mark: str, given: dict[str, int | str]) -> NodeProcess:
    """The agents of some robots of a group."""
    nodes = tuple(names.agent_node(robot, group, world_groups) for robot in robots)
    parameters = {'group': group, 'robot': robots[0], **given}
    if len(robots) == 1:
        return NodeProcess('agent', nodes[0], parameters)
    return NodeProcess('agent', f'agents{mark}_{robots[0]}-{robots[-1]}', {**parameters, 'robots': len(robots)}, nodes)


def enclave_arguments(name: str, namespace: str) -> list[str]:
    """With SROS 2 switched on, what tells a node its enclave, which has the node's name."""
    if not _secured():
        return []
    return ['--enclave', f'{"/" + namespace.strip("/") if namespace else ""}/{name}']


def _secured() -> bool:
    return os.environ.get('ROS_SECURITY_ENABLE') == 'true'


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
    """The run's settings with the `name:=value` overrides put in, checked as a whole. Raises SettingsError."""
    values = read_values(task_file, overrides)
    settings = config.from_flat({name: value for name, value in values.items() if name in SETTINGS})
    world_spec(settings.task)
    return settings


def read_values(task_file: Path | None, overrides: Iterable[str]) -> dict[str, Any]:
    """What the task file and the `name:=value` overrides say, of the run and of its robots, by name. Raises SettingsError."""
    values = settings_yaml.load(task_file) if task_file else {}
    values.update(settings_yaml.parse_override(text) for text in overrides)
    known = {**SETTINGS, **ROBOT_SETTINGS}
    for name in values:
        if name not in known:
            raise config.unknown_setting(name, known)
    return {name: known[name].check(value) for name, value in values.items()}


def node_environment() -> dict[str, str]:
    """Environment variables for the nodes where the user has set none: this host only, and quick discovery."""
    reach = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    chosen = any(name in os.environ for name in (_PROFILES, 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER'))
    if not chosen and os.environ.get(reach, 'LOCALHOST').upper() == 'LOCALHOST':
        # The profile reaches as far; LOCALHOST itself would let only 32 processes find each other, and bring shared memory back.
        return {reach: 'SYSTEM_DEFAULT', _PROFILES: _profiles('fastdds_this_host.xml')}
    defaults = {reach: 'LOCALHOST', _PROFILES: _profiles('fastdds.xml')}
    return {name: os.environ.get(name, value) for name, value in defaults.items()}


def acknowledging_environment() -> dict[str, str]:
    """Environment variables for a node that waits until its messages are acknowledged, which otherwise takes seconds."""
    own = {_profiles(f'{name}.xml'): _profiles(f'{name}_player.xml') for name in ('fastdds', 'fastdds_this_host')}
    given = os.environ.get(_PROFILES, _profiles('fastdds.xml'))
    return {_PROFILES: own[given]} if given in own else {}


def _profiles(name: str) -> str:
    return str((shipped_config() / name).resolve())
