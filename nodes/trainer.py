"""trainer: learns from the team's joint states, actions and shared reward, and sends out the policy.

    ros2 run dae_ros trainer --ros-args --params-file config/navigation.yaml -p beta:=0.95
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any, Callable, NamedTuple, NoReturn

from dae_ros_msgs import msg
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import ExternalShutdownException
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from dae_ros import torchrun
from dae_ros.config import (
    LearnerSettings,
    RewardNetworkSettings,
    RunSettings,
    SettingInfo,
    TaskSettings,
    TeamKey,
    TrainerSettings,
    declarations,
    from_flat,
)
from dae_ros.errors import DaeRosError, SettingsError, StalledError
from dae_ros.final_report import write_report
from dae_ros.learning.distributed import help_to_learn
from dae_ros.restarts import EXIT_REFUSED
from dae_ros.rollout.groups import GroupedAssembler
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.ros.node import FAREWELL, TeamNode, is_over, run
from dae_ros.ros.trust import team_key
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.types import RolloutRequest, Trajectory
from dae_ros.weights.codec import encode_policy, seal
from dae_ros.worlds import world_spec
from dae_ros.worlds.particle import TIME_STEP

Status = msg.TrainingStatus
MAKE_WAY_AFTER = {  # attempts in vain beside another trainer, by whether anyone has answered and whether the other is ahead
    (False, True): 1, (False, False): 3, (True, True): 5}
SHORT_PATIENCE = 1.0  # s; with nodes that have just started: what is sent before they have found each other may be lost


class GroupInputs(NamedTuple):
    """What the trainer hears of one group of worlds."""

    joint_state: Subscription
    shared_reward: Subscription
    actions: list[Subscription]  # of each robot


class TrainingNode(TeamNode):
    """A `Training` that sends out its policy and its status. Subclasses say where its rollouts come from."""

    def __init__(self, name: str, *more: SettingInfo):
        """`more` settings are for subclasses."""
        super().__init__(name, [*declarations(TaskSettings, LearnerSettings, RewardNetworkSettings, RunSettings, TrainerSettings,
                                              TeamKey), *more])
        self._more = {info.name: self.settings.pop(info.name) for info in more}
        folder, watched = self.settings.pop('run_folder'), self.settings.pop('watched_world')
        self._key = team_key(self, self.settings.pop('key_file'))
        settings = from_flat(self.settings)
        if watched >= settings.task.num_worlds:
            raise SettingsError(f'watched_world must be -1 or lie in 0 .. {settings.task.num_worlds - 1}, not {watched}')
        spec = world_spec(settings.task)
        folder = Path(folder or f'runs/{settings.task.task.replace(":", "_")}_n{spec.num_agents}_seed{settings.run.seed}')
        self._folder = RunFolder(folder, settings)
        self._training = Training(settings, spec, self._folder)
        self._state = Status.WAITING
        self._credit = self._watch(watched) if watched >= 0 else []
        self._policy_update = self.publisher(msg.PolicyWeights, names.POLICY_UPDATE, qos.LATCHED)
        self._status = self.publisher(Status, names.TRAINING_STATUS, qos.LATCHED)
        self.create_service(Trigger, names.SAVE, self._on_save)

    def _learn(self, trajectory: Trajectory) -> None:
        """Takes in the rollout asked for last."""
        if not self._training.evaluating:
            self._announce(Status.LEARNING, '')
        version = self._training.policy_version
        self._training.consume(trajectory)
        if self._training.policy_version != version:
            self._publish_policy()
            self._publish_credit()

    def _request_rollout(self) -> RolloutRequest:
        """The rollout wanted now."""
        request = self._training.request()
        self._announce(Status.EVALUATING if self._training.evaluating else Status.COLLECTING, '')
        return request

    def _finish(self) -> None:
        self._announce(Status.EVALUATING, 'drawing the report')
        write_report(self._training, self._folder)
        self._announce(Status.FINISHED, '')
        self._status.wait_for_all_acked(FAREWELL)
        self.done = True

    # What others see.

    def _watch(self, world: int) -> list[Publisher]:
        """Where each robot's credit in a world goes."""
        self._training.watch(world)
        return [self.publisher(Vector3Stamped, names.CREDIT.format(robot), qos.ROLLOUT)
                for robot in range(self._training.spec.num_agents)]

    def _publish_credit(self) -> None:
        begin = (self._training.policy_version - 1) * self._training.settings.run.num_steps
        for robot, publisher in enumerate(self._credit):
            for message in convert_robots.credit_messages(self._training.credit, robot, begin * TIME_STEP, TIME_STEP):
                publisher.publish(message)

    def _publish_policy(self) -> None:
        if not self.context.ok():
            raise ExternalShutdownException()
        training = self._training
        weights = seal(training.run, training.policy_version, encode_policy(training.policy), self._key)
        self._policy_update.publish(convert.policy_weights_message(weights))

    def _announce(self, state: int, detail: str) -> None:
        training = self._training
        self._state = state
        self._status.publish(Status(run=training.run, state=state, detail=detail,
                                    environment_steps=training.environment_steps, total_steps=training.total_steps,
                                    policy_version=training.policy_version, mean_return=training.mean_return,
                                    steps_per_second=training.steps_per_second))

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._training.save()
        response.success, response.message = True, f'saved in {self._folder.checkpoints}'
        return response

    def close(self) -> None:
        self._training.close()


class TrainerNode(TrainingNode):
    """Wires a `GroupedAssembler` to its topics. Learning happens in the callback of the last datum."""

    def __init__(self, *more: SettingInfo):
        super().__init__('trainer', *more)
        training, settings = self._training, self._training.settings
        self._assembler = self._make_assembler()
        self._paused = False
        self._request = self.publisher(msg.RolloutRequest, names.ROLLOUT_REQUEST, qos.LATCHED)
        self._groups = [self._listen_to_group(group) for group in range(settings.task.world_groups)]
        self.create_service(Trigger, names.PAUSE, self._on_pause)
        self.create_service(Trigger, names.RESUME, self._on_resume)
        self.listen(Status, names.TRAINING_STATUS, qos.LATCHED_INPUT, self._on_status)
        self._rival: Status | None = None  # of another trainer that is at work here
        self._answered = False  # whether anything has ever arrived, and a whole rollout
        self._settled = False
        self._heard = False  # whether anything of the rollout under way has arrived, and when the last of it; s, monotonic
        self._heard_at = 0.0
        self._silent_attempts = 0  # in a row
        # Seconds without a message after which a rollout is begun anew.
        self._patience = SHORT_PATIENCE if training.attempt else settings.run.rollout_timeout
        self.every(min(SHORT_PATIENCE, settings.run.rollout_timeout) / 4, self._begin_anew_if_silent)
        self._publish_policy()
        self._advance()

    def _make_assembler(self):
        task = self._training.settings.task
        return GroupedAssembler(self._training.spec, task.worlds_per_group, task.world_groups)

    def _listen_to_group(self, group: int) -> GroupInputs:
        """What comes on a group's topics goes to its assembler and to no other."""
        assembler, world_groups = self._assembler.groups[group], len(self._assembler.groups)

        def listen(kind: type, topic: str, read: Callable[[Any], Any], take: Callable[[Any], None]) -> Subscription:
            def receive(message) -> None:
                take(read(message))
                self._collected()

            return self.listen(kind, names.in_group(topic, group, world_groups), qos.ROLLOUT, receive)

        return GroupInputs(
            listen(msg.JointState, names.JOINT_STATE, convert.joint_state, assembler.on_joint_state),
            listen(msg.SharedReward, names.SHARED_REWARD, convert.shared_reward, assembler.on_reward),
            [listen(msg.Action, names.ACTION.format(robot), convert.action, assembler.on_action)
             for robot in range(self._training.spec.num_agents)])

    # The run, from rollout to rollout.

    def on_matched(self) -> None:
        if self._state == Status.WAITING or self._collecting and self._missing():
            self._advance()

    def on_new_source(self) -> None:
        """Begins the rollout anew that a world or an agent cannot join in its middle; one still to begin it hears of itself."""
        if self._collecting:
            self._patience = SHORT_PATIENCE
            if self._heard:
                self._advance()

    @property
    def _collecting(self) -> bool:
        return self._state in (Status.COLLECTING, Status.EVALUATING)

    def _advance(self) -> None:
        """Does what comes next: wait, pause, ask for a rollout, or report and end."""
        if not self.context.ok():
            raise ExternalShutdownException()
        if self._training.finished:
            self._finish()
        elif self._paused:
            self._announce(Status.PAUSED, 'call trainer/resume to go on')
        elif self._missing():
            self._announce(Status.WAITING, f'waiting for {", ".join(self._missing())}')
        else:
            self._ask()

    def _ask(self) -> None:
        request = self._request_rollout()
        self._assembler.begin(request)
        self._heard, self._heard_at = False, time.monotonic()
        self._request.publish(convert.rollout_request_message(request))

    def _missing(self) -> list[str]:
        """Whom the graph still lacks."""
        missing = []
        for group, inputs in enumerate(self._groups):
            where = f' in group {group}' if len(self._groups) > 1 else ''
            missing += [f'agent of robot {robot}{where}' for robot, action in enumerate(inputs.actions)
                        if not action.get_publisher_count()]
            if not inputs.joint_state.get_publisher_count() or not inputs.shared_reward.get_publisher_count():
                missing.append(f'world{where}')
        if not self._policy_update.get_subscription_count():
            missing.append('parameter server')
        return missing

    def _collected(self) -> None:
        """Learns once the rollout is complete."""
        self._heard, self._heard_at, self._answered = True, time.monotonic(), True
        if not self._assembler.complete:
            return
        self._patience, self._silent_attempts, self._settled = self._training.settings.run.rollout_timeout, 0, True
        self._learn(self._assembler.trajectory())
        self._advance()

    def _begin_anew_if_silent(self) -> None:
        """Begins a rollout anew when nothing of it has come for too long. A timer set anew by each message would cost more."""
        settings = self._training.settings.run
        patience = min(self._patience, settings.rollout_timeout)
        if not self._collecting or time.monotonic() - self._heard_at < patience:
            return
        self._silent_attempts += 1
        self._make_way()
        sentence = f'nothing heard for {patience:g} s; missing: {self._assembler.missing()}'
        if self._silent_attempts >= settings.max_silent_attempts:
            self._fail(f'given up after {self._silent_attempts} attempts at a rollout: {sentence}')
        self.get_logger().warning(f'{sentence}; the rollout is begun anew')
        if patience == settings.rollout_timeout:
            self._announce(self._state, sentence)
        self._patience = 2 * patience  # worlds may be slow
        self._publish_policy()  # an older one that somebody sent again may have taken its place
        self._advance()

    def _on_status(self, status: Status) -> None:
        """Takes note of another trainer."""
        if status.run == self._training.run:
            return
        self._rival = None if is_over(status) else status
        if not self._answered or is_over(status) and not self._settled:  # then the other's nodes are free
            self._patience = SHORT_PATIENCE

    def _make_way(self) -> None:
        """Ends this trainer if the team is another's: nobody answers it, or some do not who may have joined the other's run.

        Of two that started at once on nodes bound to no run the one stays whom the nodes answered, or who is ahead.
        """
        rival, training = self._rival, self._training
        if rival is None or self._settled:
            return
        behind = (rival.environment_steps, rival.run) > (training.environment_steps, training.run)
        if self._silent_attempts >= MAKE_WAY_AFTER.get((self._answered, behind), math.inf):
            self._fail(f'another trainer is at work here: its run {rival.run:x} has {rival.environment_steps} of '
                       f'{rival.total_steps} steps. Start this one in a namespace of its own, or when that one is done')

    def _fail(self, sentence: str) -> NoReturn:
        """Ends this trainer; nodes that joined its run are free. Raises StalledError."""
        self._announce(Status.FAILED, sentence)
        self._status.wait_for_all_acked(FAREWELL)
        raise StalledError(sentence)

    # What others see.

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._paused = True
        response.success, response.message = True, 'pausing after the rollout under way'
        return response

    def _on_resume(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, 'going on' if self._paused else 'was not paused'
        self._paused = False
        if self._state == Status.PAUSED:
            self._advance()
        return response

    def diagnose(self):
        training = self._training
        missing = self._missing()
        silent = time.monotonic() - self._heard_at
        if missing:
            sentence = f'waiting for {", ".join(missing)}'
        elif self._collecting and silent >= SHORT_PATIENCE:
            sentence = f'nothing heard for {silent:.0f} s; missing: {self._assembler.missing()}'
        else:
            sentence = f'policy version {training.policy_version}'
        return sentence, {'run': f'{training.run:x}', 'environment steps': training.environment_steps,
                          'mean return': training.mean_return}


def main(args: list[str] | None = None) -> int:
    if torchrun.rank() > 0:
        return help_the_leader()
    return run(TrainerNode, args)


def help_the_leader() -> int:
    """What a trainer does that torchrun started beside the one that leads."""
    try:
        help_to_learn()
    except KeyboardInterrupt:
        pass
    except DaeRosError as error:
        print(f'error: {error}', file=sys.stderr)
        return EXIT_REFUSED
    return 0


if __name__ == '__main__':
    sys.exit(main())
