"""Particle tasks of one's own: `particle:MODULE` is the one class in MODULE that derives from `ParticleWorlds`."""

from __future__ import annotations

from inspect import isabstract

from dae_ros.config import TaskSettings
from dae_ros.errors import WorldError
from dae_ros.worlds.modules import module_of
from dae_ros.worlds.particle import ParticleWorlds

PREFIX = 'particle:'


def make(task: TaskSettings) -> ParticleWorlds:
    """The worlds of `task`. Raises WorldError if its module cannot be imported or has no such class, or several."""
    module = module_of(task.task, PREFIX)
    found = [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, ParticleWorlds)
             and kind.__module__ == module.__name__ and not isabstract(kind)]
    if len(found) != 1:
        names = ', '.join(kind.__name__ for kind in found) or 'none'
        raise WorldError(f'{module.__name__} must have one class that derives from ParticleWorlds and has all its methods; it '
                         f'has {names}')
    return found[0](task)
