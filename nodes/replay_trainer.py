"""replay_trainer: learns from a recorded run while it is played again, and ends with the weights its trainer ended with.

    ros2 run dae_ros replay_trainer --ros-args --params-file runs/navigation/settings.yaml -p run_folder:=runs/replayed
"""

from __future__ import annotations

import sys
from functools import partial

from dae_ros_nodes.trainer import TrainingNode
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from dae_ros.replay.mcap import Message
from dae_ros.replay.replayed_run import ReplayedRun
from dae_ros.ros import qos
from dae_ros.ros.node import run
from dae_ros.ros.recorded import RecordedTopic, rollout_topics, type_name


class ReplayTrainerNode(TrainingNode):
    """Wires a `ReplayedRun` to its topics. Nobody is asked for a rollout: a training is told what it would have asked for."""

    def __init__(self):
        super().__init__('replay_trainer')
        training = self._training
        task = training.settings.task
        self._replayed = ReplayedRun(training.spec, task.worlds_per_group, task.world_groups)
        requests, *data = rollout_topics(training.spec.num_agents, task.world_groups)
        self._requests: Subscription | None = None
        self._listen_to_requests = partial(self._hear, requests, qos.REPLAYED_LATCHED)
        self._data = {topic.name: self._hear(topic, qos.REPLAYED) for topic in data}
        self._publish_policy()
        self._wanted = self._request_rollout()

    def _hear(self, topic: RecordedTopic, profile: QoSProfile) -> Subscription:
        take = partial(self._take, self.resolve_topic_name(topic.name), type_name(topic.kind))
        return self.listen(topic.kind, topic.name, profile, take, raw=True)

    def on_matched(self) -> None:
        """Who waits for subscribers to all topics shall begin when this node has found all its publishers, and not only they it:
        the latched requests, of which none is lost, are what it listens to last."""
        if self._requests is None and not self._missing():
            self._requests = self._listen_to_requests()

    def _missing(self) -> list[str]:
        return [name for name, subscription in self._data.items() if not subscription.get_publisher_count()]

    def _take(self, topic: str, kind: str, data: bytes) -> None:
        """Takes in one message and learns from the rollouts that it completes."""
        self._replayed.take(Message(topic, kind, 0, memoryview(data)))
        while not self.done and (trajectory := self._replayed.answer(self._wanted)) is not None:
            self._learn(trajectory)
            if not self.context.ok():
                raise ExternalShutdownException()
            if self._training.finished:
                self._finish()
            else:
                self._wanted = self._request_rollout()

    def diagnose(self):
        missing = self._missing()
        sentence = f'waiting for {", ".join(missing)}' if missing else f'waiting for rollout {self._wanted.rollout}'
        return sentence, {'environment steps': self._training.environment_steps, **self._replayed.skipped}


def main(args: list[str] | None = None) -> int:
    return run(ReplayTrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
