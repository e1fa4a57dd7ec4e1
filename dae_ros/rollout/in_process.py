"""Collects rollouts in one process: the graph's world, agents and assembler wired to each other by function calls.

The same settings give the same trajectories, bit for bit, as the ROS graph; tests use it as the graph's oracle.
"""

from __future__ import annotations

from collections.abc import Callable

from dae_ros.learning.policy import Policy
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.training import Training
from dae_ros.types import JointState, Observation, RolloutRequest, Trajectory
from dae_ros.worlds.base import Worlds


class InProcessCollector:
    """One world end and N agent ends."""

    def __init__(self, worlds: Worlds):
        self._world = WorldEnd(worlds)
        self._agents = [AgentEnd(robot) for robot in range(worlds.spec.num_agents)]
        self._assembler = Assembler(worlds.spec, worlds.num_worlds)

    def collect(self, request: RolloutRequest, policy: Policy) -> Trajectory:
        """The rollout that answers `request`, every robot acting with `policy`, which has the version it names."""
        self._assembler.begin(request)
        for agent in self._agents:
            agent.on_request(request)
            if agent.missing_version is not None:
                agent.on_policy(request.policy_version, policy)
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
        return self._assembler.trajectory()


def train(training: Training, worlds: Worlds, on_update: Callable[[], None]) -> None:
    """Takes `training` to its end; `on_update` is called after every rollout."""
    collector = InProcessCollector(worlds)
    while not training.finished:
        training.consume(collector.collect(training.request(), training.policy))
        on_update()
