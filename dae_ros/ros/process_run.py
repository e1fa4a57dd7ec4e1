"""Processes of a team, started together: watched, started again when they die, and stopped at the end."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dae_ros.errors import DaeRosError
from dae_ros.restarts import Restarts, describe
from dae_ros.ros import transport
from dae_ros.ros.farewell import leave
from dae_ros.ros.graph import NodeProcess, enclave_arguments, node_environment
from dae_ros.ros.supervisor import Supervisor

LOG_TAIL = 15  # lines of a dead node's log that are shown


class ProcessRun:
    """Processes in a namespace. What happens to them becomes a call in `run`'s thread, one after the other.

    Subclasses say what they listen to, and what else is to be done at which moment.
    """

    def __init__(self, processes: list[NodeProcess], settings_file: Path, namespace: str, restarts: Restarts,
                 note: Callable[[str], None]):
        """`note` shows people a sentence. Logs go beside the settings file."""
        self._processes = {process.name: process for process in processes}
        self._settings_file, self._namespace = settings_file, namespace
        self._restarts, self._note = restarts, note
        self._due = dict.fromkeys(self._processes, 0.0)  # when to start whom; s, monotonic
        self._finished = False
        self._events: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._supervisor = Supervisor(settings_file.parent / 'logs', self._later(self._on_exit))

    def run(self) -> None:
        """Returns when the run is finished. Raises DaeRosError when it cannot go on; no process is left either way."""
        os.environ.update(node_environment())  # for this process too: it must hear the others
        transport.choose()
        enclave = enclave_arguments('bringup', self._namespace)
        rclpy.init(args=['--ros-args', *enclave], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('bringup', namespace=self._namespace, start_parameter_services=False)
        self._process_of = {f'{node.get_namespace().rstrip("/")}/{name}': process.name
                            for process in self._processes.values() for name in process.nodes}
        self._listen(node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)

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
                    self._on_moment(wake)
                else:
                    event()
        finally:
            self._supervisor.stop()
            rclpy.try_shutdown()
            if spinning.ident is not None:
                spinning.join()
            leave([node])

    def _listen(self, node: Node) -> None:
        """Makes the subscriptions that are needed; their callbacks go through `_later`."""

    def _later(self, act: Callable[..., None]) -> Callable[..., None]:
        """`act` as a callback for other threads."""
        return lambda *arguments: self._events.put(partial(act, *arguments))

    def _next_moment(self) -> float | None:
        """When `_on_moment` is to be called; s, monotonic."""
        return min(self._due.values(), default=None)

    def _on_moment(self, wake: float) -> None:
        """The moment `wake` has come."""
        self._start_due()

    def _start_due(self) -> None:
        for name in [name for name, at in self._due.items() if at <= time.monotonic()]:
            del self._due[name]
            process = self._processes[name]
            command = [sys.executable, '-m', f'dae_ros_nodes.{process.executable}',
                       *process.arguments(self._settings_file, self._namespace)]
            self._supervisor.start(name, command, os.environ)
            self._on_start(name)

    def _on_start(self, name: str) -> None:
        """A process was started."""

    def _on_exit(self, name: str, code: int) -> None:
        """A process ended: it is started again. Raises DaeRosError if it keeps dying."""
        delay = self._restarts.delay(name, code)
        if delay is None:
            log = self._supervisor.log_file(name)
            tail = log.read_text(errors='replace').splitlines()[-LOG_TAIL:]
            if not os.statvfs(log).f_bavail:
                tail.append(f'the disk that {log} lies on is full')
            raise DaeRosError('\n'.join([f'{name} {describe(code)}; the end of {log}:', *tail]))
        self._note(f'{name} {describe(code)} and is started again')
        self._due[name] = time.monotonic() + delay
