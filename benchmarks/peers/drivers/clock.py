"""The driver's end of a measurement: does units of work when asked and answers how long they took.

A unit is whatever the driver repeats, one training update or one episode of all worlds. The one who asks writes a number
of units per line to standard input; each answer is a line of JSON to the file descriptor named in BENCHMARK_ANSWERS,
because libraries print to standard output. The first answer comes unasked, when the first unit, which compiles and warms
up, is done. When nobody is left to ask, the process ends.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.metadata import version


class Clock:
    """Call `tick` after every unit; it returns when the next may begin."""

    def __init__(self, steps_per_unit: int, *packages: str):
        """steps_per_unit: environment steps of one unit, all worlds together. packages: whose versions to report."""
        self._answers = os.fdopen(int(os.environ['BENCHMARK_ANSWERS']), 'w')
        self._answer = {'steps_per_unit': steps_per_unit, 'versions': {name: version(name) for name in packages}}
        self._left = 1

    def tick(self) -> None:
        now = time.perf_counter()
        self._left -= 1
        if self._left:
            return
        if self._answer is None:
            self._answer = {'seconds': now - self._began}
        print(json.dumps(self._answer), file=self._answers, flush=True)
        self._answer = None
        request = sys.stdin.readline()
        if not request:
            os._exit(0)  # this may be a callback within compiled code, which no exception gets through
        self._left = int(request)
        self._began = time.perf_counter()
