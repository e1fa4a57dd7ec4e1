"""Opens rosbag2 bags, MCAP or sqlite3, whole or left by a crash, and gives their messages in the order they were recorded."""

from __future__ import annotations

import functools
import glob
import re
import shutil
import sqlite3
import tempfile
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Iterator
from urllib.parse import quote

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from dae_ros.errors import BagError
from dae_ros.replay import mcap
from dae_ros.replay.cdr import MESSAGE_TYPES
from dae_ros.replay.mcap import Accept, Message, decompressed, zstd

SUFFIXES = ('.mcap', '.mcap.zstd', '.db3', '.db3.zstd')
MOST_BYTES = 2**30  # of a message that was compressed by itself
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_READ_ROWS = '''SELECT topics.name, topics.type, messages.timestamp, messages.data, topics.offered_qos_profiles
                FROM messages JOIN topics ON messages.topic_id = topics.id ORDER BY messages.id'''


def find_bags(*patterns: str | Path) -> list[Path]:
    """The bags that paths and glob patterns name: folders with storage files, or storage files. BagError if one names none."""
    bags: dict[Path, None] = {}
    for pattern in map(str, patterns):
        found = [pattern] if Path(pattern).exists() else glob.glob(pattern, recursive=True)
        if not found:
            raise BagError(f'there is no bag {pattern!r}')
        bags.update(dict.fromkeys(sorted(map(Path, found), key=_natural)))
    return list(bags)


class Bag:
    """One bag."""

    def __init__(self, path: Path, damage: Counter[str], accept: Accept | None = None):
        """`damage` is where what cannot be read of the bag is counted, by reason. BagError if there is nothing to read.

        `accept` chooses the types, and may raise BagError; without it they are those that rollouts are made of.
        """
        self._damage = damage
        self._accept = accept or _wanted
        files = sorted(path.iterdir(), key=_natural) if path.is_dir() else [path]
        self._files = [file for file in files if file.name.endswith(SUFFIXES)]
        if not self._files:
            raise BagError(f'{path} is not a rosbag2 bag: expected {", ".join(SUFFIXES)}')

    def messages(self) -> Iterator[Message]:
        """The wanted messages, in the order they were recorded; a bag larger than memory streams.

        Raises BagError, naming the bag, where it is not one, or where the messages are of another version than ours.
        """
        for file in self._files:
            try:
                yield from self._read(file)
            except BagError as error:
                raise BagError(f'{file}: {error}') from error
            except OSError as error:
                raise BagError(f'cannot read {file}: {error.strerror}') from error

    def _read(self, path: Path) -> Iterator[Message]:
        size = path.stat().st_size
        if not size:
            raise BagError('the file is empty')
        if path.suffix == '.zstd':
            try:
                yield from self._read_compressed(path)
            except (zstd.ZstdError, EOFError):
                self._damage[mcap.CORRUPT] += 1
        elif path.suffix == '.mcap':
            with open(path, 'rb') as file:
                yield from self._unpacked(mcap.messages(file, size, self._accept, self._damage))
        else:
            yield from self._unpacked(self._rows(path))

    def _read_compressed(self, path: Path) -> Iterator[Message]:
        """A file that was compressed as a whole; sqlite3 needs it unpacked."""
        with zstd.open(path, 'rb') as file:
            if path.stem.endswith('.mcap'):
                yield from self._unpacked(mcap.messages(file, mcap.LARGEST, self._accept, self._damage))
                return
            with tempfile.NamedTemporaryFile(suffix='.db3') as unpacked:
                shutil.copyfileobj(file, unpacked)
                unpacked.flush()
                yield from self._unpacked(self._rows(Path(unpacked.name)))

    def _rows(self, path: Path) -> Iterator[Message]:
        """The messages of an sqlite3 file."""
        # A recorder that was killed leaves a journal, which sqlite3 must take back before anything can be read.
        mode = 'rw' if path.with_name(f'{path.name}-journal').exists() else 'ro'
        begun = False
        try:
            with closing(sqlite3.connect(f'file:{quote(str(path.resolve()))}?mode={mode}', uri=True)) as database:
                wanted = {name for name, *definition in _definitions(database) if self._accept(name, *definition)}
                for topic, name, time, data, qos in database.execute(_READ_ROWS):
                    begun = True
                    if name in wanted:
                        if isinstance(data, bytes) and isinstance(topic, str) and isinstance(time, int):
                            yield Message(topic, name, time, memoryview(data), str(qos))
                        else:
                            self._damage[mcap.CORRUPT] += 1
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if not begun:
                raise BagError(f'not an sqlite3 bag: {ascii(str(error))[:200]}') from error
            self._damage[mcap.TRUNCATED] += 1

    def _unpacked(self, messages: Iterator[Message]) -> Iterator[Message]:
        """The messages, those that were compressed one by one as they were before."""
        for message in messages:
            if message.data[:4] == _ZSTD_MAGIC:
                try:
                    message = message._replace(data=decompressed(message.data, 'zstd', MOST_BYTES))
                except zstd.ZstdError:
                    self._damage[mcap.CORRUPT] += 1
                    continue
            yield message


def _natural(path: Path | str) -> list:
    """Sorts bag_2 before bag_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r'(\d+)', str(path))]


def _definitions(database: sqlite3.Connection) -> list[tuple[str, str, str]]:
    """The types in an sqlite3 bag with their definitions, '' where it has none."""
    types = {name: ('', '') for name, in database.execute('SELECT DISTINCT type FROM topics') if isinstance(name, str)}
    if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        rows = database.execute('SELECT topic_type, encoding, encoded_message_definition FROM message_definitions')
        types |= {name: definition for name, *definition in rows if name in types}
    return [(name, *map(str, definition)) for name, definition in types.items()]


def _wanted(name: str, encoding: str, definition: str) -> bool:
    """A `mcap.Accept`: our types, if their definitions are ours. Raises BagError if they are not."""
    if name not in MESSAGE_TYPES:
        return False
    if definition and rihs01(name, encoding, definition) != MESSAGE_TYPES[name].rihs01:
        raise BagError(f'it was recorded with another version of {name} than this package reads')
    return True


@functools.lru_cache
def rihs01(name: str, encoding: str, definition: str) -> str:
    """REP 2011's hash of a definition, '' of one that nobody understands."""
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_idl(definition) if 'idl' in encoding else get_types_from_msg(definition, name))
        return store.hash_rihs01(name)
    except (TypesysError, KeyError, ValueError):
        return ''
