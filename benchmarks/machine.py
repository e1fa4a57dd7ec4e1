"""What a benchmark ran on, and whether anything else ran there meanwhile."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
QUIET = 0.1  # cores that other processes may keep busy on average during a measurement
TICKS_PER_SECOND = os.sysconf('SC_CLK_TCK')


def description() -> dict[str, Any]:
    """The machine and the commit, for the record of a result."""
    return {'processor': _processor(), 'cores': len(os.sched_getaffinity(0)),
            'system': f'{platform.system()} {platform.machine()}', 'python': platform.python_version(),
            'date': time.strftime('%Y-%m-%d %H:%M'), 'commit': commit(ROOT)}


def commit(folder: Path) -> str:
    """The commit checked out in `folder`, marked where files differ from it; empty outside git."""
    described = subprocess.run(['git', 'describe', '--always', '--dirty', '--abbrev=12', '--exclude=*'], cwd=folder,
                               capture_output=True, text=True)
    return described.stdout.strip()


def _processor() -> str:
    for line in Path('/proc/cpuinfo').read_text().splitlines():
        name, _, value = line.partition(':')
        if name.strip() == 'model name':
            return value.strip()
    return platform.processor() or 'unknown'


class Bystanders:
    """How many cores all other processes kept busy since this was made, while one process was measured."""

    def __init__(self, measured: int):
        self._measured = measured
        self._seconds, self._began = self._seconds_of_others(), time.monotonic()

    def cores(self) -> float:
        """Mean number of cores the others kept busy, processor time taken by other virtual machines included."""
        return max(0.0, (self._seconds_of_others() - self._seconds) / (time.monotonic() - self._began))

    def _seconds_of_others(self) -> float:
        """Processor seconds of everything but the measured process, counted from some fixed moment."""
        user, nice, system, _idle, _waiting, interrupt, soft_interrupt, stolen = map(
            int, Path('/proc/stat').read_text().split('\n', 1)[0].split()[1:9])
        # The name before the last parenthesis may hold spaces; 11 fields on are the times of the process, then its children's.
        own = Path(f'/proc/{self._measured}/stat').read_text().rpartition(')')[2].split()[11:15]
        busy = user + nice + system + interrupt + soft_interrupt + stolen
        return (busy - sum(map(int, own))) / TICKS_PER_SECOND
