"""The folder a run leaves: settings, metrics, checkpoints, policy, pictures and summary."""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Mapping

import numpy as np

from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.errors import Refused, RunFolderError
from dae_ros.files import hold, remove_unfinished, write_atomically
from dae_ros.weights.codec import decode_checkpoint, encode_checkpoint


def new_run(name: str) -> Path:
    """Where a run of this name goes when nobody says where."""
    return Path('runs') / f'{name}-{datetime.now():%Y%m%d-%H%M%S}'


class RunFolder:
    """`runs/<name>/`. A folder belongs to one set of settings; opening it again with the same ones resumes the run.

    `run` is the number that marks every message of the run.
    """

    def __init__(self, path: Path, settings: Settings):
        """Makes the folder or opens an earlier one. Raises RunFolderError if it holds another run or cannot be written."""
        self.path = path
        self.run = _identity(settings, path)
        self._keep = settings.run.keep_checkpoints
        self._keep_every = settings.run.keep_every
        text = settings_yaml.dump(settings)
        try:
            self.checkpoints.mkdir(parents=True, exist_ok=True)
            if self.settings_file.exists():
                if self.settings_file.read_text(encoding='utf-8') != text:
                    raise RunFolderError(f'{path} holds a run with other settings; choose another name or delete it')
            else:
                write_atomically(self.settings_file, text.encode())
        except OSError as error:
            raise RunFolderError(f'cannot write the run folder {path}: {error.strerror}') from error

    @property
    def settings_file(self) -> Path:
        return self.path / 'settings.yaml'

    @property
    def checkpoints(self) -> Path:
        return self.path / 'checkpoints'

    @property
    def policies(self) -> Path:
        """Versions of the policy, written by the parameter server."""
        return self.path / 'policies'

    @property
    def policy_file(self) -> Path:
        """The trained policy."""
        return self.path / 'policy.safetensors'

    @property
    def metrics_file(self) -> Path:
        return self.path / 'metrics.csv'

    @property
    def summary_file(self) -> Path:
        return self.path / 'summary.json'

    def claim(self) -> BinaryIO:
        """Keeps other trainings out of this folder until what this returns is closed, by the end of the process at the latest.

        Raises RunFolderError if there is one. Removes what one that was killed left half written.
        """
        try:
            lock = hold(self.path / 'trainer.lock')
        except OSError as error:
            raise RunFolderError(f'cannot write the run folder {self.path}: {error.strerror}') from error
        if lock is None:
            raise RunFolderError(f'another trainer is at work in {self.path}; stop it or choose another folder')
        for folder in (self.path, self.checkpoints):
            remove_unfinished(folder)
        return lock

    def next_attempt(self) -> int:
        """A number greater than all this gave before, from 0, also after a restart: on disk before it is returned."""
        file = self.path / 'attempts'
        try:
            attempt = int(file.read_text(encoding='ascii')) if file.exists() else 0
        except ValueError as error:
            raise RunFolderError(f'{file} should hold the number of attempts; stop all nodes of the run and delete it') from error
        write_atomically(file, f'{attempt + 1}\n'.encode())
        return attempt

    def save_checkpoint(self, update: int, tensors: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
        """Writes the checkpoint after `update` updates and deletes the oldest beyond those kept."""
        write_atomically(self._checkpoint(update), encode_checkpoint(tensors, facts))
        for old in self._updates()[:-self._keep]:
            if not self._keep_every or old % self._keep_every:
                self._checkpoint(old).unlink(missing_ok=True)

    def newest_checkpoint(self) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Tensors and facts of the newest whole checkpoint; torn or corrupted ones are passed over."""
        for update in reversed(self._updates()):
            try:
                return decode_checkpoint(self._checkpoint(update).read_bytes())
            except Refused:
                continue
        return None

    def _updates(self) -> list[int]:
        names = (path.stem.removeprefix('checkpoint_') for path in self.checkpoints.glob('checkpoint_*.safetensors'))
        return sorted(int(name) for name in names if name.isdecimal())

    def _checkpoint(self, update: int) -> Path:
        return self.checkpoints / f'checkpoint_{update:08d}.safetensors'


def _identity(settings: Settings, path: Path) -> int:
    """63 bits, never 0, from the settings and the folder's name: the same again when the run is resumed."""
    text = f'{path.name}/{config.digest(settings)}'
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), 'little') >> 1 or 1
