"""From settings to what drives a robot."""

from __future__ import annotations

from typing import Any, Mapping

import numpy as np

from dae_ros.config import SETTINGS, TaskSettings, from_flat
from dae_ros.errors import SettingsError
from dae_ros.robots.geometry import TaskFrame
from dae_ros.robots.motion import Limits, Motion
from dae_ros.robots.pilot import Pilot
from dae_ros.robots.safety import Bounds, Safety
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.robots.watch import Watch
from dae_ros.worlds.particle import TIME_STEP

RUN = 1  # of stamps where nobody named a run


def task_settings(settings: Mapping[str, Any]) -> TaskSettings:
    """The task among all settings by their names."""
    return from_flat({name: value for name, value in settings.items() if name in SETTINGS}).task


def task_frame(settings: Mapping[str, Any]) -> TaskFrame:
    """How the task lies in the robots' world; its second is as long as its ten steps take."""
    slowness = 1.0 / (settings['control_rate'] * TIME_STEP)
    return TaskFrame(settings['scale'], (settings['origin_x'], settings['origin_y']), slowness)


def limits_in(settings: Mapping[str, Any]) -> Limits:
    """What a robot can do."""
    return Limits(*(settings[f'max_{name}'] for name in Limits._fields))


def make_pilot(settings: Mapping[str, Any]) -> Pilot:
    """The pilot of one robot. Raises SettingsError where settings do not fit each other."""
    robot, monitor, frame = settings['robot'], TaskMonitor(task_settings(settings)), task_frame(settings)
    num_agents = monitor.spec.num_agents
    if robot >= num_agents:
        raise SettingsError(f'robot must lie in 0 .. {num_agents - 1} where num_agents is {num_agents}, not {robot}')
    motion = Motion(settings['drive'] == 'differential', limits_in(settings), frame)
    bounds = Bounds(*(settings[name] for name in Bounds._fields))
    return Pilot(robot, settings['run'] or RUN, monitor, motion, frame,
                 1.0 / settings['control_rate'], Safety(robot, num_agents, bounds, settings['enabled'], _goes_on(settings)))


def make_watch(settings: Mapping[str, Any]) -> Watch:
    """Who watches the whole team. Raises SettingsError."""
    bounds = Bounds(*(settings[name] for name in Bounds._fields))
    return Watch(settings['run'] or RUN, TaskMonitor(task_settings(settings)), task_frame(settings),
                 1.0 / settings['control_rate'], bounds, _goes_on(settings))


def _goes_on(settings: Mapping[str, Any]) -> bool:
    return settings['on_lost_team_mate'] == 'go_on'


def landmarks_in(text: str) -> np.ndarray:
    """Positions [L, 2] in a text such as '0.5 0.5, -1 2'. Raises SettingsError."""
    try:
        return np.array([[float(part) for part in place.split()] for place in text.split(',')], np.float64).reshape(-1, 2)
    except ValueError as error:
        raise SettingsError(f"landmarks must be written as 'x y, x y, ...', not {text!r}") from error
