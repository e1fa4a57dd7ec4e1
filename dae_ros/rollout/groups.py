"""Joins the rollouts of several groups of worlds, which know nothing of each other, into one trajectory."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from dae_ros.rollout.assembler import Assembler
from dae_ros.types import RolloutRequest, Trajectory, WorldSpec


class GroupedAssembler:
    """One assembler for each group. A datum says nothing of its group: hand it to the assembler of the group it came from."""

    def __init__(self, spec: WorldSpec, worlds_per_group: int, world_groups: int):
        self.groups = [Assembler(spec, worlds_per_group) for _ in range(world_groups)]

    def begin(self, request: RolloutRequest) -> None:
        """Forget what was collected and collect the rollout of `request`."""
        for assembler in self.groups:
            assembler.begin(request)

    @property
    def complete(self) -> bool:
        """Whether nothing of the rollout is missing in any group."""
        return all(assembler.complete for assembler in self.groups)

    def missing(self) -> str:
        """What has not arrived, for people."""
        if len(self.groups) == 1:
            return self.groups[0].missing()
        return '; '.join(f'in group {group} {assembler.missing()}' for group, assembler in enumerate(self.groups)
                         if not assembler.complete)

    def trajectory(self) -> Trajectory:
        """The complete rollout. Its arrays are not touched by the next one."""
        return join([assembler.trajectory() for assembler in self.groups])


def join(trajectories: Sequence[Trajectory]) -> Trajectory:
    """The groups' trajectories of one rollout as one, their worlds in the order of the groups."""
    if len(trajectories) == 1:
        return trajectories[0]
    # Final states go by step and then by world: within a step, a stable sort keeps the order of the groups.
    steps = np.concatenate([np.nonzero(trajectory.truncated)[0] for trajectory in trajectories])
    final_states = np.concatenate([trajectory.final_states for trajectory in trajectories])
    joined = {name: _beside(parts) for name, parts in zip(Trajectory._fields, zip(*trajectories)) if name != 'final_states'}
    return Trajectory(final_states=final_states[np.argsort(steps, kind='stable')], **joined)


def _beside(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """The groups' arrays [T, W, ...] beside each other. What no group has there is not; a task has it in all or in none."""
    return None if parts[0] is None else np.concatenate(parts, axis=1)
