"""A trained team at work as separate processes, until Ctrl-C: watched, started again when they die, and stopped at the end."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from pathlib import Path
from typing import Callable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from dae_ros.errors import DaeRosError
from dae_ros.restarts import Restarts, describe
from dae_ros.ros import names, qos
from dae_ros.ros.graph import NodeProcess, node_environment
from dae_ros.ros.supervisor import Supervisor

MAX_RESTARTS = 5  # of a node
LOG_TAIL = 15     # lines of a dead node's log that are shown


class ExecutionRun:
    """The processes of one team in a namespace; `note` shows people what each node says of itself whenever that changes."""

    def __init__(self, processes: list[NodeProcess], settings_file: Path, namespace: str, note: Callable[[str], None]):
        self._note = note
        self._namespace = namespace
        self._commands = {process.name: [sys.executable, '-m', f'dae_ros_nodes.{process.executable}',
                                         *process.arguments(settings_file, namespace)] for process in processes}
        self._restarts = Restarts(MAX_RESTARTS)
        self._due = dict.fromkeys(self._commands, 0.0)  # when to start whom; s, monotonic
        self._said: dict[str, str] = {}
        self._events: queue.SimpleQueue[tuple[Callable[..., None], tuple]] = queue.SimpleQueue()
        self._supervisor = Supervisor(settings_file.parent / 'logs', lambda *ended: self._events.put((self._on_exit, ended)))

    def run(self) -> None:
        """Runs until it is interrupted. Raises DaeRosError when a node keeps dying; no process is left either way."""
        os.environ.update(node_environment())
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('bringup', namespace=self._namespace, start_parameter_services=False)
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                 lambda message: self._events.put((self._on_diagnostics, (message,))), qos.EVENTS)
        self._names = {f'{node.get_namespace().rstrip("/")}/{name}': name for name in self._commands}
        executor = SingleThreadedExecutor()
        executor.add_node(node)

        def spin() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                pass

        spinning = threading.Thread(target=spin, daemon=True)
        try:
            spinning.start()
            while True:
                self._start_due()
                wake = min(self._due.values(), default=None)
                try:
                    act, arguments = self._events.get(timeout=None if wake is None else max(0.0, wake - time.monotonic()))
                except queue.Empty:
                    continue
                act(*arguments)
        finally:
            self._supervisor.stop()
            rclpy.try_shutdown()
            spinning.join()

    def _start_due(self) -> None:
        for name in [name for name, at in self._due.items() if at <= time.monotonic()]:
            del self._due[name]
            self._supervisor.start(name, self._commands[name], os.environ)

    def _on_exit(self, name: str, code: int) -> None:
        delay = self._restarts.delay(name, code)
        if delay is None:
            log = self._supervisor.log_file(name)
            tail = log.read_text(errors='replace').splitlines()[-LOG_TAIL:]
            raise DaeRosError('\n'.join([f'{name} {describe(code)}; the end of {log}:', *tail]))
        self._note(f'{name} {describe(code)} and is started again')
        self._due[name] = time.monotonic() + delay

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = self._names.get(status.name)
            if name is not None and self._said.get(name) != status.message:
                self._said[name] = status.message
                self._note(f'{name}: {status.message}')
