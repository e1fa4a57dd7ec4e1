"""What runs have left on disk: how far each is, its metrics, and the facts of its ends."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dae_ros.report.metrics import STEPS, read_metrics
from reproduce.figures import Run


def finished_file(folder: Path, environment_steps: int) -> Path:
    """Where a run's facts lie that came to an end after so many steps."""
    return folder / f'finished_{environment_steps:010d}.json'


class Records:
    """The folder all runs lie in."""

    def __init__(self, folder: Path):
        self.folder = folder

    def path(self, run: Run) -> Path:
        return self.folder / run.name

    def log_file(self, run: Run) -> Path:
        """What the run's process said."""
        return self.path(run) / 'log.txt'

    def finished(self, run: Run) -> bool:
        """Whether it came to its end, or went past it on the way to more steps."""
        return finished_file(self.path(run), run.steps).exists() or self.progress(run.name)[0] > run.steps

    def facts(self, run: Run) -> dict[str, Any] | None:
        """Of the end at exactly its steps; None if it went past them without one."""
        file = finished_file(self.path(run), run.steps)
        return json.loads(file.read_text()) if file.exists() else None

    def speed(self) -> float:
        """Robot steps per second and core, over all runs that came to an end; nan if none did."""
        found = [json.loads(file.read_text()) for file in self.folder.glob('*/finished_*.json')]
        work = sum(facts['environment_steps'] * facts['settings']['num_agents'] for facts in found)
        return work / sum(facts['seconds'] for facts in found) if found else math.nan

    def metrics(self, run: Run) -> dict[str, np.ndarray]:
        """Columns of a finished run's metrics up to its steps, [rows] by name."""
        columns = read_metrics(self.path(run) / 'metrics.csv')
        kept = columns[STEPS] <= run.steps
        return {name: values[kept] for name, values in columns.items()}

    def credit(self, run: Run) -> dict[str, np.ndarray]:
        """Columns of what was measured of its credit, [rows] by name; none where it learns no reward."""
        file = self.path(run) / 'credit' / 'metrics.csv'
        return read_metrics(file) if file.exists() else {}

    def progress(self, name: str) -> tuple[int, float]:
        """Environment steps behind the run of this name, and the mean return of its newest rollout."""
        file = self.folder / name / 'metrics.csv'
        columns = read_metrics(file) if file.exists() else {STEPS: np.empty(0)}
        return (int(columns[STEPS][-1]), float(columns['mean_return'][-1])) if len(columns[STEPS]) else (0, float('nan'))
