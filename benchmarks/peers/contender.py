"""One contender: a driver in a process that stays alive and does a block of work when it is its turn."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from benchmarks.machine import ROOT, Bystanders
from benchmarks.peers import environments

DRIVERS = Path(__file__).with_name('drivers')
LONGEST_START = 900.0  # s; compiling on a busy machine takes minutes
LONGEST_BLOCK = 300.0  # s


class Contender(NamedTuple):
    """Who is measured, and how its driver is started."""

    name: str
    environment: str  # of the peer; empty is ours
    driver: str
    arguments: tuple[str, ...]


class Block(NamedTuple):
    """One turn of a contender."""

    speed: float       # environment steps per second, all worlds together
    bystanders: float  # mean number of cores that other processes kept busy meanwhile


class ContenderFailed(Exception):
    """Says in a sentence what became of a driver."""


class Running:
    """A contender's process. Use as a context, which ends it."""

    def __init__(self, contender: Contender, folder: Path):
        """Starts the driver in `folder`, a new one of its own. Raises CannotInstall where its environment is missing."""
        self.name = contender.name
        self.versions: dict[str, str] = {}
        self._steps_per_unit = 0
        self._log = folder / 'log.txt'
        if contender.environment:
            python = environments.prepare(contender.environment)
            variables = environments.clean_environment()
        else:
            python = Path(sys.executable)
            variables = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))}
        folder.mkdir()
        answers, answer = os.pipe()
        self._answers = os.fdopen(answers)
        with open(self._log, 'wb') as log:
            self._process = subprocess.Popen(
                [python, DRIVERS / contender.driver, *contender.arguments], cwd=folder, pass_fds=[answer], bufsize=0,
                env={**variables, 'BENCHMARK_ANSWERS': str(answer)}, stdin=subprocess.PIPE, stdout=log, stderr=log)
        os.close(answer)

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_) -> None:
        self._process.stdin.close()  # a driver that waits for its turn ends now
        self._process.kill()
        self._process.wait()
        self._answers.close()

    def warm_up(self) -> float:
        """Waits for the first unit, which compiles, and returns the seconds of another. Raises ContenderFailed."""
        ready = self._answer(LONGEST_START)
        self._steps_per_unit, self.versions = ready['steps_per_unit'], ready['versions']
        return self._work(1)

    def measure(self, units: int) -> Block:
        """A turn of `units` units. Raises ContenderFailed."""
        bystanders = Bystanders(self._process.pid)
        seconds = self._work(units)
        return Block(units * self._steps_per_unit / seconds, bystanders.cores())

    def _work(self, units: int) -> float:
        try:
            self._process.stdin.write(f'{units}\n'.encode())
        except BrokenPipeError:
            pass  # the missing answer says more
        return self._answer(LONGEST_BLOCK)['seconds']

    def _answer(self, longest: float) -> dict:
        if not select.select([self._answers], [], [], longest)[0]:
            raise ContenderFailed(f'{self.name} did not answer within {longest:.0f} s')
        line = self._answers.readline()
        if not line:
            said = (self._log.read_text(errors='replace').strip() or 'nothing').splitlines()[-1]
            raise ContenderFailed(f'{self.name} ended before its time; its last words: {said}')
        return json.loads(line)
