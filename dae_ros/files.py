"""Files that are either whole or not there, and locks on them."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import BinaryIO

from dae_ros.errors import FileError

_UNFINISHED = '.part'


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces `path` by `data` so that a reader, or a crash at any moment, sees the old file or the new one, whole.

    Raises FileError, with the old file still there, if it cannot be written.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}{_UNFINISHED}')
    try:
        try:
            with open(temporary, 'wb') as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise FileError(f'cannot write {path}: {error.strerror or error}') from error


def remove_unfinished(folder: Path) -> None:
    """Removes what writers left that were killed in the middle. Nobody may be writing to the folder."""
    for temporary in folder.glob(f'.*{_UNFINISHED}'):
        temporary.unlink(missing_ok=True)


def hold(path: Path) -> BinaryIO | None:
    """Makes the file and keeps others out until what this returns is closed, by the end of the process at the latest; None if
    somebody else is in. Raises OSError."""
    lock = open(path, 'wb')
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock
