"""Settings as people write them: a task file, or `name:=value` on a command line.

A task file is a ROS 2 parameter file (`/**: ros__parameters:`), so the same file serves `--params-file` and `bringup`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Iterator, Mapping

import yaml

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.errors import SettingsError


def parse_override(text: str) -> tuple[str, Any]:
    """`name:=value` as ROS writes it; the value is read as YAML."""
    name, separator, value = text.partition(':=')
    if not separator or not name:
        raise SettingsError(f'expected name:=value, not {text!r}')
    return name, _read_yaml(value, f'the value in {text!r}')


def load(path: str | Path) -> dict[str, Any]:
    """The settings a task file sets, by public names, not yet checked.

    Raises SettingsError if the file cannot be read or is not of the form `/**: ros__parameters: {...}`.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding='utf-8')
    except OSError as error:
        raise SettingsError(f'cannot read the task file {path}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise SettingsError(f'{path} is not a UTF-8 text: {error.reason}') from error
    content = _read_yaml(text, str(path))
    try:
        (node, body), = content.items()
        (key, parameters), = body.items()
    except (AttributeError, ValueError) as error:
        raise SettingsError(f'{path} must have the one key /**: and under it ros__parameters:') from error
    if node != '/**' or key != 'ros__parameters' or not isinstance(parameters, dict):
        raise SettingsError(f'{path} must have the one key /**: and under it ros__parameters:')
    try:
        return dict(_flat_items(parameters))
    except RecursionError as error:
        raise SettingsError(f'the parameters in {path} contain themselves') from error


class _YamlLoader(yaml.SafeLoader):
    """YAML 1.1 as PyYAML reads it, and numbers such as 7e-4, which ROS reads as numbers and PyYAML as texts."""


_YamlLoader.add_implicit_resolver('tag:yaml.org,2002:float', re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
                                  list('-+.0123456789'))


def _read_yaml(text: str, origin: str) -> Any:
    """What `text` says. Raises SettingsError, also for the errors of values that PyYAML lets through."""
    try:
        return yaml.load(text, _YamlLoader)
    except (yaml.YAMLError, ValueError, LookupError, RecursionError) as error:
        raise SettingsError(f'{origin} is not YAML: {" ".join(str(error).split())}') from error


def _flat_items(tree: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat_items(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


def dump(settings: Settings) -> str:
    """`settings` as a task file that `load` reads back."""
    nested: dict[str, Any] = {}
    for name, value in config.flatten(settings).items():
        group, _, rest = name.rpartition('.')
        (nested.setdefault(group, {}) if group else nested)[rest] = value
    return yaml.safe_dump({'/**': {'ros__parameters': nested}}, sort_keys=False)
