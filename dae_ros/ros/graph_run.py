"""A training as separate processes: started, watched, started again when they die or fall silent, and stopped at the end."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from functools import partial
from typing import Callable

import rclpy
from dae_ros_msgs.msg import TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from dae_ros import torchrun
from dae_ros.config import Settings
from dae_ros.errors import DaeRosError
from dae_ros.report.progress import ProgressDisplay
from dae_ros.restarts import Restarts, SignsOfLife, describe
from dae_ros.ros import names, qos, shared_memory
from dae_ros.ros.graph import NodeProcess, enclave_arguments, node_environment
from dae_ros.ros.supervisor import Supervisor
from dae_ros.run_folder import RunFolder

LOG_TAIL = 15  # lines of a dead node's log that are shown
OVERSLEPT = 2.0  # s; later than this it was bringup itself that was stopped
STATES = {getattr(TrainingStatus, name): name.lower() for name in
          ('WAITING', 'COLLECTING', 'LEARNING', 'PAUSED', 'EVALUATING', 'FINISHED', 'FAILED')}


class GraphRun:
    """One run of a team in a namespace. What happens to it becomes a call in `run`'s thread, one after the other."""

    def __init__(self, settings: Settings, folder: RunFolder, namespace: str, display: ProgressDisplay,
                 processes: list[NodeProcess]):
        self._folder = folder
        self._namespace = namespace
        self._display = display
        self._processes = {process.name: process for process in processes}
        # The processes that torchrun started learn with the trainer they found, and with no other.
        self._restarts = Restarts(settings.run.max_restarts if torchrun.size() == 1 else 0)
        self._signs = SignsOfLife(settings.run.silence_timeout)
        self._due = dict.fromkeys(self._processes, 0.0)  # when to start whom; s, monotonic
        self._newest = 0  # policy version
        self._detail = ''
        self._finished = False
        self._events: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._supervisor = Supervisor(folder.path / 'logs', self._later(self._on_exit))

    def run(self) -> None:
        """Returns when the trainer is done. Raises DaeRosError when the run cannot go on; no process is left either way."""
        os.environ.update(node_environment())  # for this process too: it must hear the status
        enclave = enclave_arguments('bringup', self._namespace)
        rclpy.init(args=['--ros-args', *enclave], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('bringup', namespace=self._namespace, start_parameter_services=False)
        node.create_subscription(TrainingStatus, names.TRAINING_STATUS, self._later(self._on_status), qos.LATCHED_INPUT)
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._later(self._on_diagnostics), qos.EVENTS)
        self._diagnostics = node.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos.EVENTS)
        self._process_of = {f'{node.get_namespace().rstrip("/")}/{name}': process.name
                            for process in self._processes.values() for name in process.nodes}
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        began = time.time()

        def spin() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                pass

        spinning = threading.Thread(target=spin, daemon=True)
        try:
            self._start_due()
            spinning.start()
            while not self._finished:
                wake = self._next_moment()
                try:
                    event = self._events.get(timeout=None if wake is None else max(0.0, wake - time.monotonic()))
                except queue.Empty:
                    if time.monotonic() - wake > OVERSLEPT:
                        self._signs.forgive(time.monotonic())
                    self._start_due()
                    self._kill_silent()
                else:
                    event()
        finally:
            self._supervisor.stop()
            rclpy.try_shutdown()
            if spinning.ident is not None:
                spinning.join()
            shared_memory.remove_left_behind(began)

    def _later(self, act: Callable[..., None]) -> Callable[..., None]:
        """`act` as a callback for other threads."""
        return lambda *arguments: self._events.put(partial(act, *arguments))

    def _next_moment(self) -> float | None:
        """When a node is to be started or may count as silent; s, monotonic."""
        return min([*self._due.values(), *self._signs.deadlines()], default=None)

    def _start_due(self) -> None:
        for name in [name for name, at in self._due.items() if at <= time.monotonic()]:
            del self._due[name]
            process = self._processes[name]
            command = [sys.executable, '-m', f'dae_ros_nodes.{process.executable}',
                       *process.arguments(self._folder.settings_file, self._namespace)]
            self._supervisor.start(name, command, os.environ)
            self._signs.started(name, time.monotonic())

    def _kill_silent(self) -> None:
        """A process that is there but says nothing is stopped or hangs: it makes room for another."""
        for name in self._signs.silent(time.monotonic()):
            sentence = f'{name} has said nothing for {self._signs.limit:g} s and is killed'
            self._display.note(sentence)
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
            self._display.note(status.detail)
        self._detail = status.detail

    def _on_exit(self, name: str, code: int) -> None:
        self._signs.ended(name)
        if (name, code) == ('trainer', 0):
            if not self._folder.summary_file.exists():
                raise DaeRosError('the trainer was stopped before its end; '
                                  f'--run-folder {self._folder.path} goes on from there')
            self._finished = True
            return
        delay = self._restarts.delay(name, code)
        if delay is None:
            log = self._supervisor.log_file(name)
            tail = log.read_text(errors='replace').splitlines()[-LOG_TAIL:]
            if not os.statvfs(log).f_bavail:
                tail.append(f'the disk that {log} lies on is full')
            raise DaeRosError('\n'.join([f'{name} {describe(code)}; the end of {log}:', *tail]))
        self._display.note(f'{name} {describe(code)} and is started again')
        self._due[name] = time.monotonic() + delay
