"""Shows how far a run is: a bar on a terminal, a line now and then anywhere else."""

from __future__ import annotations

import math
import sys
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from dae_ros.report.style import rounded, signed

LINE_PERIOD = 5.0  # s between two lines where there is no terminal
LONGEST = 1e9  # s; nobody is told of more


class ProgressDisplay:
    """A context manager; leaving it gives the terminal back, whatever the reason."""

    def __init__(self):
        self._console = Console(file=sys.stdout, highlight=False)
        columns = (TextColumn('{task.description}'), BarColumn(bar_width=None), TextColumn('{task.fields[facts]}'))
        self._progress = Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._bar = self._progress.add_task('starting', total=None, facts='')
        self._state = ''
        self._printed_at = -math.inf

    def __enter__(self) -> ProgressDisplay:
        self._progress.start()
        return self

    def __exit__(self, *_) -> None:
        self._progress.stop()

    def note(self, text: str) -> None:
        """Prints a line, above the bar if there is one. What would command the terminal is left out."""
        shown = ''.join(letter for letter in text if letter.isprintable() or letter == '\n')
        self._console.print(shown, markup=False, soft_wrap=True)

    def update(self, state: str, environment_steps: int, total_steps: int, mean_return: float, steps_per_second: float,
               policy_version: int) -> None:
        """Shows the run as it stands."""
        if state in ('collecting', 'learning'):
            state = 'training'  # they take turns several times a second
        facts = f'{rounded(environment_steps)}/{rounded(total_steps)} steps'
        if math.isfinite(mean_return):
            facts += f', return {signed(mean_return)}'
        if 0 < steps_per_second < math.inf:
            left = min(max(total_steps - environment_steps, 0) / steps_per_second, LONGEST)
            facts += f', {steps_per_second:,.0f}/s, policy {policy_version}, {_duration(left)} left'
        self._progress.update(self._bar, description=state, completed=environment_steps, total=total_steps, facts=facts)
        now = time.monotonic()
        if self._progress.disable and (now - self._printed_at > LINE_PERIOD or state != self._state):
            self._printed_at = now
            self.note(f'{state}: {facts}')
        self._state = state


def _duration(seconds: float) -> str:
    """Minutes and seconds, for people."""
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes}:{rest:02d}'
