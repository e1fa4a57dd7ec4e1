"""When the next message of a replay is due: at a rate, paused, or one by one, as other threads say."""

from __future__ import annotations

import math
import threading
import time


class Pace:
    """Bag time that runs beside the clock. One thread waits for it, any other moves it."""

    def __init__(self, rate: float, paused: bool):
        """`rate`: seconds of the bag in a second; infinite where nothing is to be waited for."""
        self._rate = rate
        self._paused = paused
        self._steps = 0  # messages to be let through in the pause
        self._at, self._since = 0.0, time.monotonic()  # s of bag time, and when it was that time
        self._stopped = False
        self._changed = threading.Condition()

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def stopped(self) -> bool:
        return self._stopped

    def wait_for(self, moment: float) -> bool:
        """Returns once the message of a bag time [s] is due; whether it may be sent, which it may not any more after `stop`."""
        with self._changed:
            while not self._stopped:
                if self._paused:
                    if self._steps:
                        self._steps -= 1
                        self._at = moment
                        return True
                    self._changed.wait()
                else:
                    left = (moment - self._at) / self._rate - (time.monotonic() - self._since)
                    if left <= 0:
                        return True
                    self._changed.wait(left)
            return False

    def begin(self, moment: float) -> None:
        """It is this bag time [s] now: the replay begins, or begins again."""
        with self._changed:
            self._at, self._since = moment, time.monotonic()

    def pause(self) -> bool:
        """Stands still from now on; False if it stood still before."""
        with self._changed:
            if self._paused:
                return False
            if math.isfinite(self._rate):
                self._at += (time.monotonic() - self._since) * self._rate
            self._paused = True
            self._changed.notify()
            return True

    def resume(self) -> bool:
        """Goes on; False if it was going on already."""
        with self._changed:
            was_paused, self._paused, self._steps = self._paused, False, 0
            if was_paused:
                self._since = time.monotonic()
                self._changed.notify()
            return was_paused

    def play_next(self) -> bool:
        """Lets one message through in the pause; False if there is no pause."""
        with self._changed:
            self._steps += self._paused
            self._changed.notify()
            return self._paused

    def stop(self) -> None:
        """Ends the waiting for good."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
