"""The processes of a trained team on robots, described once: agents and bridges, and our simulator where it plays the robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Iterable

import yaml

from dae_ros import config
from dae_ros.config import ROBOT_SETTINGS, SETTINGS
from dae_ros.errors import SettingsError
from dae_ros.robots.setup import task_settings
from dae_ros.ros.graph import NodeProcess, shipped_config

KNOWN = {**SETTINGS, **ROBOT_SETTINGS}
NEEDED = {'seed', *(name for name, info in SETTINGS.items() if info.group == 'task'), *ROBOT_SETTINGS}  # by these nodes
FROM_SERVER = 'parameter_server'  # in place of a file: whatever the parameter server has


def read_values(task_file: Path | None, overrides: Iterable[str]) -> dict[str, Any]:
    """The task file's values with the `name:=value` overrides put in, by name, checked. Raises SettingsError."""
    values = config.load_task_file(task_file) if task_file else {}
    values.update(config.parse_override(text) for text in overrides)
    for name in values:
        if name not in KNOWN:
            raise config.unknown_setting(name, KNOWN)
    return {name: KNOWN[name].check(value) for name, value in values.items() if name in NEEDED}


def find_policy(name: str) -> str:
    """The file, or that of this name in the package's config/policies; '' for the parameter server's. Raises SettingsError."""
    if name == FROM_SERVER:
        return ''
    for path in (Path(name), shipped_config() / 'policies' / f'{name}.safetensors'):
        if path.is_file():
            return str(path.resolve())
    raise SettingsError(f'there is no policy file {name}')


def execution_graph(values: dict[str, Any], policy_file: str, simulate: bool) -> list[NodeProcess]:
    """An agent and a bridge for each robot; with `simulate` also the robots, which may then move from the start."""
    robots = range(task_settings(values).num_agents)
    own_clock = {'use_sim_time': True} if simulate and values.get('real_time_factor', 1.0) != 1.0 else {}
    bridge = {'enabled': values.get('enabled', simulate), **own_clock}
    return [*([NodeProcess('robot_world', 'robot_world', {})] if simulate else []),
            *(NodeProcess('robot_agent', f'agent_{robot}', {'robot': robot, 'policy_file': policy_file, **own_clock})
              for robot in robots),
            *(NodeProcess('robot_bridge', f'bridge_{robot}', {'robot': robot, **bridge}) for robot in robots)]


def write_values(values: dict[str, Any], path: Path) -> Path:
    """A parameter file with these values, for all nodes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}, sort_keys=False), encoding='utf-8')
    return path
