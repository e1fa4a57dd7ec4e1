"""Errors that name what was wrong, what was expected and what to do.

`Refused` is bad input from outside: it is counted by reason and the run goes on. `DaeRosError` and its other
subclasses end what the user asked for, with one sentence. A bug inside raises whatever Python raises.
"""

from __future__ import annotations


class DaeRosError(Exception):
    """Base of every error whose text is meant for the user."""


class SettingsError(DaeRosError):
    """A setting is unknown, of the wrong type or out of range."""


class WorldError(DaeRosError):
    """A task cannot be simulated as asked."""


class FileError(DaeRosError):
    """A file cannot be written: the disk is full, or it may not be."""


class RunFolderError(DaeRosError):
    """A run's folder cannot be used: it holds another run, or cannot be written."""


class StalledError(DaeRosError):
    """A run cannot go on: nobody answers, however often they are asked."""


class BagError(DaeRosError):
    """A bag cannot be read or written: it is not there, not a bag, or of messages that are not ours."""


class Refused(DaeRosError):
    """A message from outside that is not acted on.

    `reason` is one of the constants below: short, stable words under which diagnostics count refusals.
    """

    WRONG_RUN = 'wrong_run'
    STALE = 'stale'
    UNEXPECTED = 'unexpected'
    DUPLICATE = 'duplicate'
    WRONG_ROBOT = 'wrong_robot'
    WRONG_VERSION = 'wrong_version'
    WRONG_SHAPE = 'wrong_shape'
    NOT_FINITE = 'not_finite'
    OUT_OF_RANGE = 'out_of_range'
    OVERSIZED = 'oversized'
    CORRUPT = 'corrupt'
    FORGED = 'forged'
    WRONG_FRAME = 'wrong_frame'
    JUMP = 'jump'

    def __init__(self, reason: str, detail: str):
        super().__init__(f'{reason}: {detail}')
        self.reason = reason
        self.detail = detail
