"""A training as separate processes, which are replaced also when they fall silent, until the trainer is done."""

from __future__ import annotations

import time

from dae_ros_msgs.msg import TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from dae_ros import torchrun
from dae_ros.config import Settings
from dae_ros.errors import DaeRosError
from dae_ros.report.progress import ProgressDisplay
from dae_ros.restarts import Restarts, SignsOfLife
from dae_ros.ros import names, qos
from dae_ros.ros.graph import NodeProcess
from dae_ros.ros.process_run import ProcessRun
from dae_ros.run_folder import RunFolder

OVERSLEPT = 2.0  # s; later than this it was bringup itself that was stopped
STATES = {getattr(TrainingStatus, name): name.lower() for name in
          ('WAITING', 'COLLECTING', 'LEARNING', 'PAUSED', 'EVALUATING', 'FINISHED', 'FAILED')}


class GraphRun(ProcessRun):
    """One run of a team in a namespace; it is finished when the trainer is done."""

    def __init__(self, settings: Settings, folder: RunFolder, namespace: str, display: ProgressDisplay,
                 processes: list[NodeProcess]):
        # The processes that torchrun started learn with the trainer they found, and with no other.
        restarts = Restarts(settings.run.max_restarts if torchrun.size() == 1 else 0)
        super().__init__(processes, folder.settings_file, namespace, restarts, display.note)
        self._folder = folder
        self._display = display
        self._signs = SignsOfLife(settings.run.silence_timeout)
        self._newest = 0  # policy version
        self._detail = ''

    def _listen(self, node: Node) -> None:
        node.create_subscription(TrainingStatus, names.TRAINING_STATUS, self._later(self._on_status), qos.LATCHED_INPUT)
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._later(self._on_diagnostics), qos.EVENTS)
        self._diagnostics = node.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos.EVENTS)

    def _next_moment(self) -> float | None:
        """When a node is to be started or may count as silent; s, monotonic."""
        return min([*self._due.values(), *self._signs.deadlines()], default=None)

    def _on_moment(self, wake: float) -> None:
        if time.monotonic() - wake > OVERSLEPT:
            self._signs.forgive(time.monotonic())
        super()._on_moment(wake)
        self._kill_silent()

    def _on_start(self, name: str) -> None:
        self._signs.started(name, time.monotonic())

    def _kill_silent(self) -> None:
        """A process that is there but says nothing is stopped or hangs: it makes room for another."""
        for name in self._signs.silent(time.monotonic()):
            sentence = f'{name} has said nothing for {self._signs.limit:g} s and is killed'
            self._note(sentence)
            nodes = [node for node, process in self._process_of.items() if process == name]
            self._diagnostics.publish(DiagnosticArray(status=[
                DiagnosticStatus(level=DiagnosticStatus.STALE, name=node, message=sentence) for node in nodes]))
            self._supervisor.kill(name)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in self._process_of and status.level != DiagnosticStatus.STALE:
                self._signs.heard(self._process_of[status.name], time.monotonic())

    def _on_status(self, status: TrainingStatus) -> None:
        if status.run != self._folder.run:
            return
        self._signs.heard('trainer', time.monotonic())
        if status.policy_version > self._newest:
            self._newest = status.policy_version
            self._restarts.got_on()
        self._display.update(STATES.get(status.state, '?'), status.environment_steps, status.total_steps, status.mean_return,
                             status.steps_per_second, status.policy_version)
        if status.detail not in ('', self._detail):
            self._note(status.detail)
        self._detail = status.detail

    def _on_exit(self, name: str, code: int) -> None:
        self._signs.ended(name)
        if (name, code) != ('trainer', 0):
            super()._on_exit(name, code)
        elif not self._folder.summary_file.exists():
            raise DaeRosError('the trainer was stopped before its end; '
                              f'--run-folder {self._folder.path} goes on from there')
        else:
            self._finished = True
