"""The processes of a team on robots, described once: agents and bridges, our simulator in the robots' place, and who trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dae_ros.config import ROBOT_SETTINGS, SETTINGS, Settings
from dae_ros.errors import SettingsError
from dae_ros.robots.setup import task_settings
from dae_ros.ros import names
from dae_ros.ros.graph import NodeProcess, key_parameters, process_groups, shipped_config, training_graph
from dae_ros.run_folder import RunFolder

NEEDED = {'seed', *(name for name, info in SETTINGS.items() if info.group == 'task'), *ROBOT_SETTINGS}
FROM_SERVER = 'parameter_server'  # in place of a file: whatever the parameter server has


def find_policy(name: str) -> str:
    """The file, or that of this name in the package's config/policies; '' for the parameter server's. Raises SettingsError."""
    if name == FROM_SERVER:
        return ''
    for path in (Path(name), shipped_config() / 'policies' / f'{name}.safetensors'):
        if path.is_file():
            return str(path.resolve())
    raise SettingsError(f'there is no policy file {name}')


def execution_graph(values: dict[str, Any], policy_file: str, simulate: bool, key_file: str = '') -> list[NodeProcess]:
    """An agent and a bridge for each robot; with `simulate` also the robots, which may then move from the start, and as many of
    their agents and bridges in one process as `robots_per_process` says: there is no robot whose nodes must stand alone."""
    robots = range(task_settings(values).num_agents)
    own_clock = clock_parameters(values, simulate)
    agent = {'execute': True, **({'policy_file': policy_file} if policy_file else key_parameters(key_file)), **own_clock}
    bridge = {'enabled': values.get('enabled', simulate), **own_clock}
    if simulate:
        world = NodeProcess('world', 'world', {'real_time_factor': real_time_factor(values)})
        groups = process_groups(robots, values.get('robots_per_process', 0))
        return [world, *(robots_together(group, {**agent, **bridge}) for group in groups)]
    return [*(NodeProcess('agent', f'agent_{robot}', {'robot': robot, **agent}) for robot in robots),
            *(NodeProcess('robot_bridge', f'bridge_{robot}', {'robot': robot, **bridge}) for robot in robots)]


def robots_together(robots: range, parameters: dict[str, Any]) -> NodeProcess:
    """Some robots of ours, all in one process."""
    nodes = tuple(name for robot in robots for name in (names.agent_node(robot, 0, 1), names.BRIDGE_NODE.format(robot)))
    parameters = {'robot': robots[0], 'robots': len(robots), **parameters}
    return NodeProcess('robot', f'robots_{robots[0]}-{robots[-1]}', parameters, nodes)


def streaming_graph(settings: Settings, values: dict[str, Any], folder: RunFolder, simulate: bool,
                    key_file: str = '') -> list[NodeProcess]:
    """The same with who learns from it: parameter server, trainer and task monitor. Agents draw their actions."""
    server, trainer = training_graph(settings, folder, key_file)[-2:]
    monitor = NodeProcess('task_monitor', 'task_monitor', clock_parameters(values, simulate))
    more = {'world': {}, 'agent': {'run': folder.run, 'greedy': False}, 'robot_bridge': {'run': folder.run},
            'robot': {'run': folder.run, 'greedy': False}, 'task_monitor': {'run': folder.run}}
    robots = {name: value for name, value in values.items() if name in ROBOT_SETTINGS}  # not in the run's settings file
    return [server, trainer._replace(executable='stream_trainer', parameters={**trainer.parameters, **robots}),
            *(process._replace(parameters={**robots, **process.parameters, **more[process.executable]})
              for process in (monitor, *execution_graph(values, '', simulate, key_file)))]


def clock_parameters(values: dict[str, Any], simulate: bool) -> dict[str, Any]:
    """What nodes need to go by the simulator's clock, where that is not the system's."""
    return {'use_sim_time': True} if simulate and real_time_factor(values) != 1.0 else {}


def real_time_factor(values: dict[str, Any]) -> float:
    """How many times as fast as real robots our simulator plays them."""
    return values.get('real_time_factor') or 1.0


def write_values(values: dict[str, Any], path: Path) -> Path:
    """A parameter file with those of these values that some node on robots has."""
    values = {name: value for name, value in values.items() if name in NEEDED}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}, sort_keys=False), encoding='utf-8')
    return path
