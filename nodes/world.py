"""world: simulates the team's worlds, or one group of them, in lockstep with its agents; or plays robots in real time.

    ros2 run dae_ros world --ros-args -p task:=navigation -p num_agents:=3 -p num_worlds:=128
    ros2 run dae_ros world --ros-args -p task:=navigation -p num_agents:=3 -p real_time_factor:=1.0
"""

from __future__ import annotations

import sys

from dae_ros_msgs import msg

from dae_ros.config import (
    SETTINGS,
    BodySettings,
    GroupBinding,
    RobotWorldSettings,
    RunBinding,
    TaskSettings,
    check_group,
    declarations,
    from_flat,
)
from dae_ros.rollout.lockstep import WorldEnd, check_request
from dae_ros.ros import convert, names, qos
from dae_ros.ros.node import TeamNode, is_over, run, settings_of_process
from dae_ros.types import JointState, Observation, RolloutRequest
from dae_ros.worlds import make_worlds


class WorldNode(TeamNode):
    """Wires a `WorldEnd` to its topics; begins a rollout once everyone it needs has been found."""

    def __init__(self):
        super().__init__('world', declarations(TaskSettings, GroupBinding, RunBinding))
        binding, self._group = self.settings.pop('run'), self.settings.pop('group')
        task = from_flat(self.settings).task
        self._world_groups = task.world_groups
        check_group(self._group, self._world_groups)
        self._worlds = make_worlds(task)
        self._end = WorldEnd(self._worlds, binding, self._group)
        self._bound = binding != 0
        self._wanted: RolloutRequest | None = None

        def topic(name: str) -> str:
            return names.in_group(name, self._group, self._world_groups)

        robots = range(self._worlds.spec.num_agents)
        self._observations = [self.publisher(msg.Observation, topic(names.OBSERVATION.format(i)), qos.LATCHED) for i in robots]
        self._joint_state = self.publisher(msg.JointState, topic(names.JOINT_STATE), qos.ROLLOUT)
        self._shared_reward = self.publisher(msg.SharedReward, topic(names.SHARED_REWARD), qos.ROLLOUT)
        self._actions = [self.listen(msg.Action, topic(names.ACTION.format(i)), qos.ROLLOUT, self._on_action) for i in robots]
        self.listen(msg.TrainingStatus, names.TRAINING_STATUS, qos.LATCHED_INPUT, self._on_status)
        self.listen(msg.RolloutRequest, names.ROLLOUT_REQUEST, qos.LATCHED_INPUT, self._on_request)

    @property
    def _run(self) -> int:
        """The run whose request this world has taken, or that it was bound to; 0 for none."""
        return self._end.run if self._wanted is None else self._wanted.run

    def on_matched(self) -> None:
        self._begin_if_ready()

    def _on_request(self, message: msg.RolloutRequest) -> None:
        request = convert.rollout_request(message)
        check_request(request, self._wanted or self._end.request, self._run)
        self._wanted = request
        self._begin_if_ready()

    def _begin_if_ready(self) -> None:
        """Begins the wanted rollout once every message of it would reach someone."""
        if self._wanted is None or self._missing():
            return
        request, self._wanted = self._wanted, None
        self._send(self._end.on_request(request))

    def _missing(self) -> list[str]:
        """Whom the graph still lacks."""
        missing = [f'agent of robot {robot}' for robot, (observation, action) in enumerate(zip(self._observations, self._actions))
                   if not observation.get_subscription_count() or not action.get_publisher_count()]
        if not self._joint_state.get_subscription_count() or not self._shared_reward.get_subscription_count():
            missing.append('trainer')
        return missing

    def _on_action(self, message: msg.Action) -> None:
        self._send(self._end.on_action(convert.action(message)))

    def _on_status(self, message: msg.TrainingStatus) -> None:
        """A world that joined the run it heard is free for the next one when that run is over."""
        if is_over(message) and message.run == self._run and not self._bound:
            self._end, self._wanted = WorldEnd(self._worlds, group=self._group), None

    def _send(self, data) -> None:
        for datum in data:
            if isinstance(datum, Observation):
                self._observations[datum.robot].publish(convert.observation_message(datum))
            elif isinstance(datum, JointState):
                self._joint_state.publish(convert.joint_state_message(datum, self._worlds.spec.state_is_observations))
            else:
                self._shared_reward.publish(convert.shared_reward_message(datum))

    def diagnose(self):
        request = self._end.request
        if self._wanted is not None:
            sentence = f'waiting for {", ".join(self._missing())}'
        elif self._end.waiting_for:
            sentence = f'waiting for actions of robots {self._end.waiting_for}'
        else:
            sentence = 'waiting for a request'
        values = {'run': f'{self._run:x}'} | ({'group': self._group} if self._world_groups > 1 else {})
        return sentence, values if request is None else {**values, 'rollout': request.rollout, 'attempt': request.attempt}

    def close(self) -> None:
        self._worlds.close()


def make_world() -> TeamNode:
    """The world that the command line asks for: in lockstep, or our robots. Raises SettingsError."""
    declared = declarations(TaskSettings, GroupBinding, RunBinding, BodySettings, RobotWorldSettings)
    if not settings_of_process('world', [*declared, SETTINGS['seed']])['real_time_factor']:
        return WorldNode()
    from dae_ros_nodes.robot_world import RobotWorldNode

    return RobotWorldNode()


def main(args: list[str] | None = None) -> int:
    return run(make_world, args)


if __name__ == '__main__':
    sys.exit(main())
