"""This process's place among those that torchrun started, without importing torch."""

from __future__ import annotations

import os


def rank() -> int:
    """0 for the leader, and for a process that torchrun did not start."""
    return int(os.environ.get('RANK', 0))


def size() -> int:
    """How many processes there are."""
    return int(os.environ.get('WORLD_SIZE', 1))
