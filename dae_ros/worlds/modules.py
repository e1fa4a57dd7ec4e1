"""The modules that tasks outside the package lie in, by the task's name."""

from __future__ import annotations

import importlib
from types import ModuleType

from dae_ros.errors import WorldError


def module_of(task: str, prefix: str) -> ModuleType:
    """The module that the task `prefix` + MODULE names. Raises WorldError."""
    name = task.removeprefix(prefix)
    try:
        return importlib.import_module(name)
    except (ImportError, ValueError, TypeError) as error:
        raise WorldError(f'cannot import {name!r} ({error}); install its package or correct the name after {prefix}') from error
