"""Whether and when a node that has ended is started again."""

from __future__ import annotations

import signal
from collections import Counter

EXIT_REFUSED = 2  # exit code of a node that cannot run like this, and could not if it were started again
FIRST_DELAY = 0.25  # s
LONGEST_DELAY = 8.0  # s


class Restarts:
    """Restarts with growing delays, at most `limit` of a node in a row. A run that gets on may have any number of them."""

    def __init__(self, limit: int):
        self._limit = limit
        self._in_a_row: Counter[str] = Counter()

    def got_on(self) -> None:
        """The run got on: what died before is forgiven."""
        self._in_a_row.clear()

    def delay(self, name: str, code: int) -> float | None:
        """Seconds until node `name`, which ended with exit code `code`, is to be started again; None: it is not."""
        if code == EXIT_REFUSED or self._in_a_row[name] >= self._limit:
            return None
        self._in_a_row[name] += 1
        return min(FIRST_DELAY * 2 ** (self._in_a_row[name] - 1), LONGEST_DELAY)


def describe(code: int) -> str:
    """An exit code for people."""
    if code >= 0:
        return f'ended with exit code {code}'
    try:
        return f'was killed by {signal.Signals(-code).name}'
    except ValueError:
        return f'was killed by signal {-code}'


class SignsOfLife:
    """Who is silent: has been started, has not ended, and has said nothing for `limit` seconds."""

    def __init__(self, limit: float):
        self.limit = limit
        self._heard: dict[str, float] = {}

    def started(self, name: str, now: float) -> None:
        """From here on the node is expected to speak."""
        self._heard[name] = now

    def heard(self, name: str, now: float) -> None:
        """The node spoke; of one that has ended this is an echo."""
        if name in self._heard:
            self._heard[name] = now

    def forgive(self, now: float) -> None:
        """Whoever listens was away until now: nobody could be heard."""
        self._heard = dict.fromkeys(self._heard, now)

    def ended(self, name: str) -> None:
        """From here on nothing is expected of the node."""
        self._heard.pop(name, None)

    def deadlines(self) -> list[float]:
        """When each node will be silent unless it is heard before."""
        return [heard + self.limit for heard in self._heard.values()]

    def silent(self, now: float) -> list[str]:
        """Who is silent now; named once. Nobody where everybody is: then it is the listener who hears nothing."""
        silent = [name for name, heard in self._heard.items() if now - heard >= self.limit]
        if len(silent) == len(self._heard):
            self.forgive(now)
            return []
        for name in silent:
            self.ended(name)
        return silent
