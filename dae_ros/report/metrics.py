"""The metrics of a run as they come in: rows of metrics.csv for scripts, TensorBoard events for people."""

from __future__ import annotations

import csv
import threading
from pathlib import Path
from typing import Mapping

import numpy as np

from dae_ros.files import write_atomically

STEPS = 'environment_steps'  # the first column


class MetricsLog:
    """Writes folder/metrics.csv and folder/tensorboard, a row per update, each on disk before `write` returns.

    A resumed run goes on from its last checkpoint: what was logged beyond it is dropped, and logged anew.
    """

    def __init__(self, folder: Path, resume_at: int | None = None):
        """`resume_at`: environment steps of the checkpoint the run goes on from; None begins a new log."""
        from torch.utils.tensorboard import SummaryWriter  # here, so that reading metrics needs no torch

        path = folder / 'metrics.csv'
        folder.mkdir(parents=True, exist_ok=True)
        lines = _whole_lines(path) if resume_at is not None and path.exists() else []
        self._names = lines[0].strip().split(',') if lines else None
        kept = lines[:1] + [line for line in lines[1:] if _steps(line) <= resume_at]
        write_atomically(path, ''.join(kept).encode())
        threading.excepthook = _left_to_the_next_write
        self._file = open(path, 'a', encoding='utf-8', newline='')
        self._rows = csv.writer(self._file, lineterminator='\n')
        self._events = SummaryWriter(str(folder / 'tensorboard'), purge_step=0 if resume_at is None else resume_at + 1,
                                     flush_secs=5)

    def write(self, environment_steps: int, metrics: Mapping[str, float]) -> None:
        """Append the metrics of one update. Raises ValueError if their names are not those of the first row."""
        if self._names is None:
            self._names = [STEPS, *metrics]
            self._rows.writerow(self._names)
        if metrics.keys() != set(self._names[1:]):
            differing = ', '.join(sorted(metrics.keys() ^ set(self._names[1:])))
            raise ValueError(f'every row must have the metrics of the first; these are missing or new: {differing}')
        self._rows.writerow([int(environment_steps), *(float(metrics[name]) for name in self._names[1:])])
        self._file.flush()
        for name, value in metrics.items():
            self._events.add_scalar(name, value, environment_steps)

    def close(self) -> None:
        """Ends both files."""
        self._file.close()
        self._events.close()


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """The columns of a metrics.csv by name, each [rows] float64; also while the run still writes it.

    Raises OSError if it cannot be read and ValueError if it is not a table of numbers.
    """
    names, *rows = csv.reader(_whole_lines(path) or [STEPS])
    if any(len(row) != len(names) for row in rows):
        raise ValueError(f'{path} has rows that are not as long as its header')
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return dict(zip(names, table.T))


def _left_to_the_next_write(failure: threading.ExceptHookArgs) -> None:
    """TensorBoard writes in a thread of its own and raises at the next event what went wrong there; nobody is told twice."""
    if not issubclass(failure.exc_type, OSError):
        threading.__excepthook__(failure)


def _whole_lines(path: Path) -> list[str]:
    """The lines of a file but for a last one without an end, which was being written when its writer was killed."""
    with open(path, encoding='utf-8', newline='') as file:
        return [line for line in file if line.endswith('\n')]


def _steps(line: str) -> int:
    return int(line.split(',', 1)[0])
