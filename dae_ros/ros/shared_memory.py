"""Removes the shared memory that killed processes leave behind: half a MiB each, and now and then a port that nobody can open.

A process that is killed while it makes a port's segment leaves one that is not there yet for ever: Fast DDS in whoever comes next
with the same port, which is whoever takes its place, waits for it without an end.
"""

from __future__ import annotations

import fcntl
import re
import sys
import time
from pathlib import Path

FOLDER = Path('/dev/shm')
YOUNG = 10.0  # s; a process makes its segment's lock and takes it a moment later
_IS_MADE = 2  # the word that a segment begins with when it can be used
_LOCK = re.compile(r'fastrtps_[0-9a-f]{16}_el')
_PORT = re.compile(r'fastrtps_port[0-9]+')


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


def remove_half_made_ports(folder: Path = FOLDER) -> list[str]:
    """Removes ports that somebody began to make and never finished; their names. To be called before a process joins DDS."""
    removed = []
    for port in folder.glob('fastrtps_port*'):
        try:
            if _PORT.fullmatch(port.name) and port.stat().st_mtime <= time.time() - YOUNG and not _is_made(port):
                port.unlink()
                removed.append(port.name)
        except (FileNotFoundError, PermissionError):
            continue  # somebody else was quicker, or somebody else's port
    return removed


def _is_made(segment: Path) -> bool:
    with open(segment, 'rb') as file:
        return int.from_bytes(file.read(4), sys.byteorder) == _IS_MADE


def _is_free(lock: Path) -> bool:
    with open(lock, 'rb') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True
