"""Removes the shared memory that killed processes leave behind: half a MiB each, which Fast DDS never gives back."""

from __future__ import annotations

import fcntl
import re
import time
from pathlib import Path

FOLDER = Path('/dev/shm')
YOUNG = 10.0  # s; a process makes its segment's lock and takes it a moment later
_LOCK = re.compile(r'fastrtps_[0-9a-f]{16}_el')


def remove_left_behind(since: float, folder: Path = FOLDER) -> list[str]:
    """Removes Fast DDS's segments that were made since then and whose owner is gone; their names.

    since: seconds since the epoch. An owner holds a lock on the file beside its segment for as long as it lives.
    """
    removed = []
    for lock in folder.glob('fastrtps_*_el'):
        try:
            made = lock.stat().st_mtime
            if _LOCK.fullmatch(lock.name) and since <= made <= time.time() - YOUNG and _is_free(lock):
                segment = lock.with_name(lock.name.removesuffix('_el'))
                segment.unlink(missing_ok=True)
                lock.unlink(missing_ok=True)
                removed.append(segment.name)
        except (FileNotFoundError, PermissionError):
            continue  # somebody else's work, or somebody else's segment
    return removed


def _is_free(lock: Path) -> bool:
    with open(lock, 'rb') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True
