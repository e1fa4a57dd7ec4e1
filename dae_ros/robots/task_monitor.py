"""A task seen on robots that are not simulated here: observations, state and reward from where they are.

They are computed by the very code of the simulated worlds, so a policy meets on robots what it was trained on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.types import WorldSpec
from dae_ros.worlds import make_worlds, side_by_side
from dae_ros.worlds.particle import ParticleWorlds


class Sight(NamedTuple):
    """What a task shows of one team at one moment."""

    observations: np.ndarray  # [N, O] float32
    state: np.ndarray         # [S] float32
    reward: float             # earned by the joint action that led here; paid at once, whatever the reward_delay


def one_team(task: TaskSettings) -> ParticleWorlds:
    """One world of the task. Raises SettingsError where the task is not one of robots in the plane."""
    worlds = make_worlds(side_by_side(task, 1))
    if not isinstance(worlds, ParticleWorlds):
        worlds.close()
        raise SettingsError(f'task {task.task!r} is not one of robots in the plane, such as navigation')
    return worlds


class TaskMonitor:
    """One team of a particle task whose robots move outside."""

    def __init__(self, task: TaskSettings):
        """Raises SettingsError where the task is not one of robots in the plane."""
        self._worlds = one_team(task)

    @property
    def spec(self) -> WorldSpec:
        """The task's sizes."""
        return self._worlds.spec

    @property
    def num_landmarks(self) -> int:
        """How many landmarks the task has (L)."""
        return self._worlds.landmarks.shape[1]

    @property
    def episode_steps(self) -> int:
        """Steps of an episode."""
        return self._worlds.episode_steps

    @property
    def radius(self) -> float:
        """Of a robot, in task units."""
        return self._worlds.radius

    @property
    def targets(self) -> np.ndarray:
        """The N places the team should cover, [N, 2] in task units, as of the last sight."""
        return self._worlds.targets[0]

    def see(self, positions: np.ndarray, velocities: np.ndarray, landmarks: np.ndarray) -> Sight:
        """What the task shows of robots at `positions` [N, 2] with `velocities` [N, 2] per s, among `landmarks` [L, 2].

        All in task units (`geometry.TaskFrame`). ValueError if an argument is of another shape.
        """
        observations, state = self.observe(positions, velocities, landmarks)
        return Sight(observations, state, float(self._worlds.reward()[0]))

    def observe(self, positions: np.ndarray, velocities: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same without the reward: observations [N, O] and state [S], float32."""
        given = np.shape(positions), np.shape(velocities), np.shape(landmarks)
        needed = *2 * [(self.spec.num_agents, 2)], (self.num_landmarks, 2)
        if given != needed:
            raise ValueError(f'positions, velocities and landmarks are {given} where {needed} is needed')
        self._worlds.set_state(positions, velocities, landmarks)
        observations, state = self._worlds.observe()
        return observations[0], state[0]
