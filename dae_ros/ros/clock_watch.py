"""Tells when the host's clock is set: libraries built for an old glibc, such as the wheels', wait by it even for a steady moment.

When it is set back by an hour, a timer of rclpy's events executor comes an hour late.
"""

from __future__ import annotations

import os
import select
import threading
import time
from typing import Callable

GLANCE = 1.0  # s between looks
JUMP = 0.2    # s; clocks that are only being corrected drift apart by less in that time


class ClockWatch:
    """Calls `on_set` with the seconds that the clock was set forward by, in a thread of its own, until it is closed."""

    def __init__(self, on_set: Callable[[float], None]):
        self._on_set = on_set
        self._ending, self._end = os.pipe()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        before = _ahead()
        while not select.select([self._ending], [], [], GLANCE)[0]:  # the wait of a lock may hang on the clock itself
            now = _ahead()
            if abs(now - before) > JUMP:
                self._on_set(now - before)
            before = now

    def close(self) -> None:
        """Returns when nothing is called any more."""
        os.close(self._end)
        self._thread.join()
        os.close(self._ending)


def _ahead() -> float:
    """The clock that can be set, as seen from the one that cannot [s]."""
    return time.time() - time.monotonic()
