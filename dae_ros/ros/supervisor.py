"""Starts processes, notices when one ends, and leaves none behind."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Callable, Mapping

from dae_ros.command import hurried, uninterrupted

GRACE = 8.0  # s from the request to stop until a process is killed
GLANCE = 0.1  # s between looks at whether it is to hurry
LAST_WORDS = 1.0  # s for a process that hangs to tell its log where
_PR_SET_PDEATHSIG = 1
_prctl = ctypes.CDLL(None).prctl  # found here: to look for it in the child may take a lock that was another thread's at the fork


def _end_with_parent() -> None:
    """In the child, before it becomes the node: have the kernel end it should the supervisor be killed."""
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def catches(pid: int, number: int) -> bool:
    """Whether a process handles a signal itself; False where it is gone."""
    try:
        status = dict(line.split(':', 1) for line in Path(f'/proc/{pid}/status').read_text().splitlines())
    except (FileNotFoundError, ProcessLookupError):
        return False
    return bool(int(status.get('SigCgt', '0'), 16) >> number - 1 & 1)


class Supervisor:
    """A group of processes with a log file each.

    `on_exit(name, code)` is called from another thread when a process ends, whatever the reason.
    """

    def __init__(self, log_folder: Path, on_exit: Callable[[str, int], None]):
        self._log_folder = log_folder
        self._on_exit = on_exit
        self._processes: dict[str, subprocess.Popen] = {}
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, command: list[str], environment: Mapping[str, str]) -> int:
        """Starts a process in a session of its own: Ctrl-C in the terminal reaches the supervisor alone. Its process id."""
        with uninterrupted(), open(self.log_file(name), 'ab') as log:  # or nobody would know of the process
            process = subprocess.Popen(command, env={**environment, 'PYTHONFAULTHANDLER': '1'}, stdin=subprocess.DEVNULL,
                                       stdout=log, stderr=log, start_new_session=True, preexec_fn=_end_with_parent)
            self._processes[name] = process
        threading.Thread(target=self._watch, args=(name, process), daemon=True).start()
        return process.pid

    def kill(self, name: str) -> None:
        """Ends a process that hangs, and whatever it started; its log shows where it was, unless it is stopped."""
        process = self._processes[name]
        if process.poll() is None:
            os.kill(process.pid, signal.SIGABRT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(LAST_WORDS)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

    def log_file(self, name: str) -> Path:
        """Where the process's output goes."""
        return self._log_folder / f'{name}.log'

    def wait(self, name: str, timeout: float) -> int:
        """The exit code of a process that ends by itself; subprocess.TimeoutExpired if it does not within `timeout` s."""
        return self._processes[name].wait(timeout)

    def stop(self) -> None:
        """Asks every process to end and kills what has not within `GRACE` seconds, or when it is interrupted again."""
        try:
            for process in self._alive():
                # Until it has come so far as to handle signals itself, Ctrl-C would have it show where in its imports it was.
                os.killpg(process.pid, signal.SIGINT if catches(process.pid, signal.SIGTERM) else signal.SIGTERM)
            deadline = time.monotonic() + GRACE
            for process in self._processes.values():
                while process.poll() is None and time.monotonic() < deadline and not hurried():
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(GLANCE)
        except KeyboardInterrupt:
            pass
        for process in self._alive():
            os.killpg(process.pid, signal.SIGKILL)
        for process in self._processes.values():
            process.wait()

    def _alive(self) -> list[subprocess.Popen]:
        return [process for process in self._processes.values() if process.poll() is None]

    def _watch(self, name: str, process: subprocess.Popen) -> None:
        self._on_exit(name, process.wait())
