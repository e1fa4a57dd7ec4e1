"""Simulated teams: the built-in tasks, and the way to the worlds of a task by its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.types import WorldSpec
from dae_ros.worlds import own_particle, pettingzoo, smac, smax
from dae_ros.worlds.base import JointObservation, Transition, Worlds
from dae_ros.worlds.matrix_game import MatrixGame
from dae_ros.worlds.pettingzoo import PettingZooWorlds
from dae_ros.worlds.smac import SmacWorlds
from dae_ros.worlds.smax import SmaxWorlds
from dae_ros.worlds.tasks import Formation, Line, Navigation

__all__ = ['BUILT_IN', 'JointObservation', 'Transition', 'Worlds', 'make_worlds', 'side_by_side', 'world_spec']

BUILT_IN: dict[str, Callable[[TaskSettings], Worlds]] = {
    'navigation': Navigation,
    'formation': Formation,
    'line': Line,
    'matrix_game': MatrixGame,
}

PLUGGED_IN: dict[str, Callable[[TaskSettings], Worlds]] = {
    own_particle.PREFIX: own_particle.make,
    pettingzoo.PREFIX: PettingZooWorlds,
    smac.PREFIX: SmacWorlds,
    smax.PREFIX: SmaxWorlds,
}


def make_worlds(task: TaskSettings) -> Worlds:
    """The worlds of one group of those `task` asks for, not yet reset; all groups' are alike and differ in their draws.

    Raises SettingsError for an unknown task or settings that do not fit it, WorldError where a module or its
    environment cannot be used.
    """
    task = side_by_side(task, task.worlds_per_group)
    if task.task in BUILT_IN:
        return BUILT_IN[task.task](task)
    for prefix, make in PLUGGED_IN.items():
        if task.task.startswith(prefix):
            return make(task)
    raise SettingsError(f'unknown task {task.task!r}; there are {", ".join(BUILT_IN)}, particle:MODULE, pettingzoo:MODULE, '
                        'smac:MAP and smax:MAP')


def world_spec(task: TaskSettings) -> WorldSpec:
    """The sizes of `task`, for whoever does not simulate it; builds one world, whatever num_worlds.

    Raises as `make_worlds`.
    """
    worlds = make_worlds(side_by_side(task, 1))
    worlds.close()
    return worlds.spec


def side_by_side(task: TaskSettings, num_worlds: int) -> TaskSettings:
    """`task` with so many worlds, in one group."""
    return dataclasses.replace(task, num_worlds=num_worlds, world_groups=1)
