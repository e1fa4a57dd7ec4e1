"""Collects rollouts in one process: the graph's worlds, agents and assemblers wired to each other by function calls.

The same settings give the same trajectories, bit for bit, as the ROS graph; tests use it as the graph's oracle.
"""

from __future__ import annotations

from collections.abc import Callable

from dae_ros.learning.policy import Policy
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.groups import GroupedAssembler
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.training import Training
from dae_ros.types import JointState, Observation, RolloutRequest, Trajectory
from dae_ros.worlds.base import Worlds


class InProcessCollector:
    """A world end and N agent ends for each group.

    `worlds` are those of one group. A rollout begins with a reset that depends on nothing before, so the groups take turns
    with them.
    """

    def __init__(self, worlds: Worlds, world_groups: int = 1):
        self._assembler = GroupedAssembler(worlds.spec, worlds.num_worlds, world_groups)
        self._groups = [_Group(worlds, group, assembler) for group, assembler in enumerate(self._assembler.groups)]

    def collect(self, request: RolloutRequest, policy: Policy) -> Trajectory:
        """The rollout that answers `request`, every robot acting with `policy`, which has the version it names."""
        self._assembler.begin(request)
        for group in self._groups:
            group.collect(request, policy)
        return self._assembler.trajectory()


class _Group:
    """One world end and N agent ends, and the assembler that hears them."""

    def __init__(self, worlds: Worlds, group: int, assembler: Assembler):
        self._world = WorldEnd(worlds, group=group)
        self._agents = [AgentEnd(robot, group=group) for robot in range(worlds.spec.num_agents)]
        self._assembler = assembler

    def collect(self, request: RolloutRequest, policy: Policy) -> None:
        for agent in self._agents:
            agent.on_request(request)
            if agent.missing_version is not None:
                agent.on_policy(request.run, request.policy_version, policy)
        data = self._world.on_request(request)
        while data:
            actions = []
            for datum in data:
                if isinstance(datum, Observation):
                    actions.append(self._agents[datum.robot].on_observation(datum))
                elif isinstance(datum, JointState):
                    self._assembler.on_joint_state(datum)
                else:
                    self._assembler.on_reward(datum)
            data = []
            for action in actions:
                self._assembler.on_action(action)
                data += self._world.on_action(action)


def train(training: Training, worlds: Worlds, on_update: Callable[[], None]) -> None:
    """Takes `training` to its end with the worlds of one group; `on_update` is called after every rollout."""
    collector = InProcessCollector(worlds, training.settings.task.world_groups)
    while not training.finished:
        training.consume(collector.collect(training.request(), training.policy))
        on_update()
