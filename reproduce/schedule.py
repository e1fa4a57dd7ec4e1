"""Trains runs as processes, a few at a time, and tells how they get on."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Iterable, Sequence

from benchmarks.machine import ROOT
from dae_ros import config
from reproduce.figures import EXACT, PRETRAINED, Run
from reproduce.progress import Progress
from reproduce.records import Records

SHOW_PERIOD = 1.0    # s between looks at how far runs are
STOP_TIMEOUT = 60.0  # s a run gets to write its checkpoint
LOG_TAIL = 8         # lines of a failed run's log that are shown


@dataclass(frozen=True)
class Job:
    """What one process does: takes a run from some steps, where an earlier job ends, to its end."""

    run: Run
    begins_at: int

    def work(self, steps: int) -> int:
        """Robot steps left when the run is at `steps`."""
        return (self.run.steps - min(max(steps, self.begins_at), self.run.steps)) * self.run.settings.task.num_agents


def jobs(runs: Sequence[Run], records: Records) -> list[Job]:
    """What is left to do, most telling first: the first seeds of everything, cheap ones before dear ones, then the second
    ones, and at last those that go on beyond the others of their figure."""
    todo, ends = [], {}
    shortest = sorted(dict.fromkeys(runs), key=lambda run: run.steps)
    for run in shortest:
        begins_at = ends.get(run.name, 0)
        ends[run.name] = run.steps
        if not records.finished(run):
            todo.append(Job(run, begins_at))
    return sorted(todo, key=lambda job: (job.begins_at > 0, job.run.seed, job.work(0)))


def train(todo: Sequence[Job], workers: int, records: Records, progress: Progress,
          on_finished: Callable[[], None]) -> list[Run]:
    """Trains `workers` runs at a time; calls `on_finished` after each. Returns those that failed.

    Whatever ends it, such as KeyboardInterrupt, the processes are stopped, and write their checkpoints, before it returns.
    """
    waiting, running, failed = list(todo), {}, []
    try:
        while waiting or running:
            while len(running) < workers and (job := _next(waiting, running)) is not None:
                running[job] = _start(job.run, records)
            _wait_for_an_end(running.values(), SHOW_PERIOD)
            for job, process in list(running.items()):
                if process.poll() is None:
                    continue
                del running[job]
                if process.returncode == 0 and records.finished(job.run):
                    progress.note(f'{job.run.name} is at {job.run.steps:,} steps')
                    on_finished()
                else:
                    failed.append(job.run)
                    tail = records.log_file(job.run).read_text(errors='replace').splitlines()[-LOG_TAIL:]
                    progress.note('\n  '.join([f'{job.run.name} failed with exit code {process.returncode}:', *tail]))
            progress.update(waiting, running, records)
    finally:
        _stop(running.values())
    return failed


def _next(waiting: list[Job], running: dict[Job, subprocess.Popen]) -> Job | None:
    """Takes the first job whose run is not being trained already."""
    busy = {job.run.name for job in running}
    for place, job in enumerate(waiting):
        if job.run.name not in busy:
            return waiting.pop(place)
    return None


def _start(run: Run, records: Records) -> subprocess.Popen:
    path = records.path(run)
    path.mkdir(parents=True, exist_ok=True)
    with open(records.log_file(run), 'w') as log:
        # A session of its own: Ctrl-C reaches this process alone, which then stops the runs.
        command = [sys.executable, '-m', 'reproduce.run', path.absolute(), json.dumps(config.flatten(run.settings)),
                   *([EXACT] if run.exact else []), *([f'{PRETRAINED}={run.pretrained}'] if run.pretrained else [])]
        return subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)


def _wait_for_an_end(processes: Iterable[subprocess.Popen], seconds: float) -> None:
    """Returns when one of the processes has ended, or after so many seconds."""
    ends = [os.pidfd_open(process.pid) for process in processes]
    try:
        select.select(ends, [], [], seconds)
    finally:
        for end in ends:
            os.close(end)


def _stop(processes: Iterable[subprocess.Popen]) -> None:
    processes = list(processes)
    for process in processes:
        process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + STOP_TIMEOUT
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
