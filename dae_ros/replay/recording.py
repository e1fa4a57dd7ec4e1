"""Writes rosbag2 bags as messages come, so that a crash costs the last half second and no more."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from binascii import crc32
from collections import Counter
from pathlib import Path
from typing import Iterator, NamedTuple

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from dae_ros.errors import BagError

FLUSH_PERIOD = 500_000_000  # ns
_CHUNK_CHECKSUM = 9 + 24    # bytes from the beginning of a chunk's record
_COMPRESSION = {('mcap', 'none'): CompressionMode.NONE, ('mcap', 'zstd'): CompressionMode.STORAGE,
                ('sqlite3', 'none'): CompressionMode.NONE, ('sqlite3', 'zstd'): CompressionMode.MESSAGE}


class Topic(NamedTuple):
    """A topic to be recorded."""

    name: str
    type: str
    definition: str  # of the message and those within it, so that any tool reads the bag
    rihs01: str      # REP 2011's hash of it
    qos: Qos         # it was offered with


class Recording:
    """A bag, or where it is split several, being written. `messages` counts what they hold, by topic."""

    def __init__(self, path: Path, topics: list[Topic], storage: str = 'mcap', compression: str = 'none', split_bytes: int = 0,
                 split_time: int = 0):
        """`split_bytes` and `split_time` [ns]: when another bag is begun, 0 for never. BagError if it cannot be written."""
        self.messages: Counter[str] = Counter()
        self._path = path
        self._topics = topics
        self._storage = storage
        self._compression = compression
        self._split_bytes = split_bytes
        self._split_time = split_time
        self._bags = 0
        self._refused = False
        self._begin()

    @property
    def path(self) -> Path:
        """The bag being written now."""
        return self._writer.path

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Adds a serialized message that came at `time` [ns]. BagError if the disk does not take it."""
        self._began = self._began or time
        if 0 < self._split_bytes <= self._bytes or 0 < self._split_time <= time - self._began:
            self.close()
            self._begin()
            self._began = time
        with self._explained():
            self._writer.write(self._connections[topic], time, data)
        self._bytes += len(data)
        self.messages[topic] += 1
        self.flush_if_due(time)

    def flush_if_due(self, time: int) -> None:
        """Hands what was written to the system if the last time was long enough ago; nothing of it is lost from then on."""
        if time - self._flushed >= FLUSH_PERIOD:
            self._flushed = time
            with self._explained():
                self._writer.storage.flush()

    def close(self) -> None:
        """Completes the bag, unless the disk has refused it."""
        if not self._refused:
            with self._explained():
                self._writer.close()

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns what a full disk makes somebody raise into a BagError."""
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            self._refused = True
            raise BagError(f'cannot write the bag {self.path}: {getattr(error, "strerror", None) or error}') from error

    def _begin(self) -> None:
        split = self._split_bytes or self._split_time
        path = self._path.with_name(f'{self._path.name}_{self._bags}') if split else self._path
        try:
            self._writer = _CrashSafeWriter(path, version=9, storage_plugin=StoragePlugin[self._storage.upper()])
            self._writer.set_compression(_COMPRESSION[self._storage, self._compression], CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError as error:
            raise BagError(f'{path} exists already: choose another name or delete it') from error
        except OSError as error:
            raise BagError(f'cannot write the bag {path}: {error.strerror}') from error
        self._connections: dict[str, Connection] = {
            topic.name: self._writer.add_connection(topic.name, topic.type, msgdef=topic.definition, rihs01=topic.rihs01,
                                                    offered_qos_profiles=[topic.qos]) for topic in self._topics}
        self._bags += 1
        self._bytes = self._began = self._flushed = 0


def _as_rosbag2_names_it(file: Path) -> Path:
    """The file, renamed: `ros2 bag reindex` finds no others."""
    return file.rename(file.with_name(f'{file.stem}_0{file.suffix}'))


class _McapStorage(McapWriter):
    """MCAP whose chunks have checksums and reach the system as soon as they are complete."""

    def __init__(self, path: Path, compression: CompressionMode):
        super().__init__(path, compression)
        self.path = _as_rosbag2_names_it(self.path)

    def close_chunk(self) -> None:
        begin, checksum = self.bio.tell(), crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(begin + _CHUNK_CHECKSUM)
        self.bio.write(struct.pack('<I', checksum))
        self.bio.seek(end)
        self.bio.flush()

    def flush(self) -> None:
        if self.chunk.msgs:
            self.close_chunk()


class _Sqlite3Storage(Sqlite3Writer):
    """sqlite3 whose file changes only as a transaction ends: a crash before leaves the last state without any journal."""

    def __init__(self, path: Path, compression: CompressionMode):
        super().__init__(path, compression)
        self.conn.close()
        self.path = _as_rosbag2_names_it(self.path)
        self.conn = sqlite3.connect(self.path)
        self.cursor = self.conn.cursor()
        self.conn.execute('PRAGMA cache_spill = 0')

    def flush(self) -> None:
        self.conn.commit()


class _CrashSafeWriter(Writer):
    """rosbags' writer on these storages."""

    STORAGE_PLUGINS = {StoragePlugin.MCAP: _McapStorage, StoragePlugin.SQLITE3: _Sqlite3Storage}
