"""stream_trainer: learns from robots that act at their own rate, without simulator, lockstep or anybody's patience.

    ros2 run dae_ros stream_trainer --ros-args --params-file config/navigation.yaml -p num_worlds:=16
"""

from __future__ import annotations

import sys

from dae_ros_msgs import msg
from dae_ros_nodes.trainer import GroupInputs, TrainerNode

from dae_ros.config import StreamSettings, declarations
from dae_ros.errors import SettingsError
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.rollout.streaming import StreamAssembler
from dae_ros.ros import convert, names, qos
from dae_ros.ros.node import run


class StreamTrainerNode(TrainerNode):
    """A trainer whose rollouts are the newest whole episodes of one team, `num_worlds` of them, instead of what it asked for."""

    def __init__(self):
        super().__init__(*declarations(StreamSettings))

    def _make_assembler(self) -> StreamAssembler:
        training, settings = self._training, self._training.settings
        steps = TaskMonitor(settings.task).episode_steps
        if settings.run.num_steps != steps or settings.task.world_groups != 1:
            raise SettingsError(f'streaming needs num_steps = {steps}, an episode, and world_groups = 1')
        if settings.run.evaluation_greedy and settings.run.evaluation_episodes:
            raise SettingsError('in a stream robots draw their actions to the end: set evaluation_greedy to false')
        return StreamAssembler(training.spec, settings.task.num_worlds, steps, training.run, self._more['max_staleness'])

    def _listen_to_group(self, group: int) -> GroupInputs:
        assembler = self._assembler
        joint_state = self._join(msg.JointState, names.JOINT_STATE, convert.joint_state, assembler.on_joint_state)
        shared_reward = self._join(msg.SharedReward, names.SHARED_REWARD, convert.shared_reward, assembler.on_reward)
        actions = []
        for robot in range(self._training.spec.num_agents):
            actions.append(self._join(msg.Action, names.ACTION.format(robot), convert.action, assembler.on_action))
            self._join(msg.Observation, names.OBSERVATION.format(robot), convert.observation, assembler.on_observation)
        return GroupInputs(joint_state, shared_reward, actions)

    def _join(self, kind: type, topic: str, read, take):
        def receive(message) -> None:
            take(read(message))
            self._collected()

        return self.listen(kind, topic, qos.ROLLOUT, receive)

    def on_new_source(self) -> None:
        """Nothing is begun anew: who comes later joins the stream."""

    def _missing(self) -> list[str]:
        """Whom the graph lacks to begin with. A stream that flowed once flows on: members leave and come back."""
        return [] if self._answered else super()._missing()

    def _ask(self) -> None:
        self._assembler.begin(self._request_rollout().policy_version)

    def _begin_anew_if_silent(self) -> None:
        """Silence is no reason to stop: robots may be charging."""

    def diagnose(self):
        sentence, values = super().diagnose()
        assembler = self._assembler
        return sentence, {**values, 'episodes with holes': assembler.holed, 'episodes somebody left': assembler.left,
                          'episodes too stale': assembler.stale}


def main(args: list[str] | None = None) -> int:
    return run(StreamTrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
