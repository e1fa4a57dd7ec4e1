"""A trained team at work as separate processes, until Ctrl-C; people read what each robot says of itself."""

from __future__ import annotations

from pathlib import Path
from typing import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from dae_ros.restarts import Restarts
from dae_ros.ros import names, qos
from dae_ros.ros.graph import NodeProcess
from dae_ros.ros.process_run import ProcessRun

MAX_RESTARTS = 5  # of a node


class ExecutionRun(ProcessRun):
    """The processes of one team in a namespace; `note` shows what each node says of itself whenever that changes."""

    def __init__(self, processes: list[NodeProcess], settings_file: Path, namespace: str, note: Callable[[str], None]):
        super().__init__(processes, settings_file, namespace, Restarts(MAX_RESTARTS), note)
        self._said: dict[str, str] = {}

    def _listen(self, node: Node) -> None:
        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._later(self._on_diagnostics), qos.EVENTS)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = self._process_of.get(status.name)
            if name is not None and self._said.get(name) != status.message:
                self._said[name] = status.message
                self._note(f'{name}: {status.message}')
