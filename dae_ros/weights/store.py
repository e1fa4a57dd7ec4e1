"""Policy versions on disk, newest kept, so that a parameter server that comes back can serve at once."""

from __future__ import annotations

from pathlib import Path

from dae_ros.errors import Refused
from dae_ros.files import remove_unfinished, write_atomically
from dae_ros.weights.codec import decode_policy

_SUFFIX = '.safetensors'


class PolicyStore:
    """A folder of `policy_<version>.safetensors` files."""

    def __init__(self, folder: Path, keep: int):
        self._folder = folder
        self._keep = keep
        folder.mkdir(parents=True, exist_ok=True)
        remove_unfinished(folder)

    def versions(self) -> list[int]:
        """Versions on disk, oldest first."""
        names = (path.name.removeprefix('policy_').removesuffix(_SUFFIX) for path in self._folder.glob(f'policy_*{_SUFFIX}'))
        return sorted(int(name) for name in names if name.isdecimal())

    def save(self, version: int, data: bytes) -> None:
        """Writes one version and deletes the oldest others beyond those kept."""
        write_atomically(self._path(version), data)
        others = [other for other in self.versions() if other != version]
        for old in others[:max(0, len(others) - self._keep + 1)]:
            self._path(old).unlink(missing_ok=True)

    def load(self, version: int) -> bytes | None:
        """The file of one version, or None if it is not there or not a policy."""
        try:
            data = self._path(version).read_bytes()
            decode_policy(data)
        except (FileNotFoundError, Refused):
            return None
        return data

    def newest(self) -> tuple[int, bytes] | None:
        """The newest readable version and its file."""
        for version in reversed(self.versions()):
            data = self.load(version)
            if data is not None:
                return version, data
        return None

    def _path(self, version: int) -> Path:
        return self._folder / f'policy_{version:08d}{_SUFFIX}'
