"""Notices, from the stamps alone, what is missing between the messages of a topic."""

from __future__ import annotations

import struct

_STAMP = struct.Struct('<4xQIII')  # behind the CDR header; every datum of a rollout begins with its stamp


class Gaps:
    """The last stamp of each topic."""

    def __init__(self):
        self._last: dict[str, tuple[int, int, int, int]] = {}

    def missing(self, topic: str, data: bytes) -> int:
        """How many messages were missed right before this one: steps of its rollout that have not come.

        Nothing is known of what came before the first message of a topic.
        """
        if len(data) < _STAMP.size:
            return 0
        stamp = _STAMP.unpack_from(data)
        last, self._last[topic] = self._last.get(topic), stamp
        if last is None:
            return 0
        expected = last[3] + 1 if stamp[:3] == last[:3] else 0
        return max(0, stamp[3] - expected)
