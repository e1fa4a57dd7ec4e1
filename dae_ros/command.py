"""How every command for people ends: with an exit code and, where something was wrong, with one sentence."""

from __future__ import annotations

import errno
import signal
import sys
from contextlib import contextmanager
from typing import Callable, Iterator

from dae_ros.errors import DaeRosError, FileError
from dae_ros.restarts import EXIT_REFUSED

DISK_TROUBLE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
EXIT_INTERRUPTED = 130  # as of a shell's command that was ended by Ctrl-C


def run_command(act: Callable[[], int], stopped: str) -> int:
    """The exit code that `act` gives; Ctrl-C ends it with the sentence `stopped`, a DaeRosError with what it says."""
    try:
        return act()
    except KeyboardInterrupt:
        print(stopped, file=sys.stderr)
        return EXIT_INTERRUPTED
    except (DaeRosError, OSError) as error:
        return refuse(error)


_interrupts = 0  # since `interrupt_once`
_put_off = False  # whether the first one is to wait


def interrupt_once() -> None:
    """From here on the first SIGINT or SIGTERM raises KeyboardInterrupt. Further ones, which must not break into the cleaning up
    that it begins, only have it hurry."""
    def interrupt(number: int, frame) -> None:
        global _interrupts
        _interrupts += 1
        if _interrupts == 1 and not _put_off:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as in a job that was started in the background
            signal.signal(number, interrupt)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Puts off what `interrupt_once` raises to the end of the block. A blocked signal would not do: another thread takes it, and
    Python still raises in this one."""
    global _put_off
    before, _put_off = _interrupts, True
    try:
        yield
    finally:
        _put_off = False
    if _interrupts and not before:
        raise KeyboardInterrupt


def hurried() -> bool:
    """Whether whoever asked this process to end has asked again."""
    return _interrupts > 1


def refuse(error: DaeRosError | OSError) -> int:
    """Tells the user what was wrong, in one sentence; the exit code. Raises an OSError on which the user has no bearing."""
    if isinstance(error, OSError):
        if error.errno not in DISK_TROUBLE:
            raise error
        error = FileError(f'cannot write {error.filename or "to the disk"}: {error.strerror}')
    try:
        print(f'error: {error}', file=sys.stderr, flush=True)
    except OSError:
        pass  # a log on that disk
    return EXIT_REFUSED


def interrupt_on_sigterm() -> None:
    """SIGTERM ends this process the way Ctrl-C does."""
    def interrupt(number: int, frame) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
