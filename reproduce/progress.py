"""Shows how the runs get on: a bar for all and one for each in training, or plain lines where there is no terminal."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Iterable

from rich import progress
from rich.console import Console

from dae_ros.report.style import rounded, signed
from reproduce.records import Records

if TYPE_CHECKING:
    from reproduce.schedule import Job

LINE_PERIOD = 60.0   # s between two lines where there is no terminal
SPEED_PERIOD = 30.0  # s over which a run's speed is taken


class Progress:
    """A context manager; leaving it gives the terminal back, whatever the reason."""

    def __init__(self):
        self._console = Console(file=sys.stdout, highlight=False)
        columns = (progress.TextColumn('{task.description}'), progress.BarColumn(bar_width=24),
                   progress.TextColumn('{task.fields[facts]}'))
        self._bars = progress.Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._overall = self._bars.add_task('all runs', total=None, facts='')
        self._bar_of: dict[Job, progress.TaskID] = {}
        self._seen: dict[Job, list[tuple[float, int]]] = {}  # times and steps, over which the speed is taken
        self._began: tuple[float, int] | None = None
        self._printed_at = -math.inf

    def __enter__(self) -> Progress:
        self._bars.start()
        return self

    def __exit__(self, *_) -> None:
        self._bars.stop()

    def note(self, text: str) -> None:
        """Prints a line, above the bars if there are any."""
        self._console.print(text, markup=False, soft_wrap=True)

    def update(self, waiting: Iterable[Job], running: Iterable[Job], records: Records) -> None:
        """Shows everything as it stands."""
        now, lines = time.monotonic(), []
        left = sum(job.work(records.progress(job.run.name)[0]) for job in waiting)
        for job in [job for job in self._bar_of if job not in running]:
            self._bars.remove_task(self._bar_of.pop(job))
        for job in running:
            steps, mean_return = records.progress(job.run.name)
            left += job.work(steps)
            facts = f'{rounded(steps)}/{rounded(job.run.steps)} steps, {self._speed(job, now, steps):,.0f}/s'
            if math.isfinite(mean_return):
                facts += f', return {signed(mean_return)}'
            if job not in self._bar_of:
                self._bar_of[job] = self._bars.add_task(job.run.name, total=job.run.steps, facts='')
            self._bars.update(self._bar_of[job], completed=steps, facts=facts)
            lines.append(f'  {job.run.name}: {facts}')
        self._began = self._began or (now, left)
        began, work = self._began
        done = work - left
        facts = f'{len(lines)} running, {len(list(waiting))} waiting'
        if done > 0:
            facts += f', {_duration((now - began) * left / done)} left'
        self._bars.update(self._overall, completed=done, total=work, facts=facts)
        if self._bars.disable and now - self._printed_at > LINE_PERIOD:
            self._printed_at = now
            self.note('\n'.join([facts, *lines]))

    def _speed(self, job: Job, now: float, steps: int) -> float:
        """Environment steps per second lately."""
        seen = self._seen.setdefault(job, [])
        seen.append((now, steps))
        while len(seen) > 2 and now - seen[0][0] > SPEED_PERIOD:
            del seen[0]
        (began, before), (ended, after) = seen[0], seen[-1]
        return max(0, after - before) / (ended - began) if ended > began else 0.0


def _duration(seconds: float) -> str:
    """Hours and minutes, for people."""
    minutes = round(seconds / 60)
    return f'{minutes // 60} h {minutes % 60:02d} min'
