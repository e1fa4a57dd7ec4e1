"""Reads the messages of an MCAP file front to back, as far as it goes: a file that was never finished has no index.

Records and their layout: https://mcap.dev/spec. What is damaged is counted and passed over where that is possible.
"""

from __future__ import annotations

import struct
import sys
from binascii import crc32
from collections import Counter
from typing import BinaryIO, Callable, Iterator, NamedTuple

import lz4.frame

from dae_ros.errors import BagError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b'\x89MCAP0\r\n'
LARGEST = 2**31  # bytes of a record
TRUNCATED, CORRUPT = 'truncated', 'corrupt'  # under which damage is counted

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_RECORD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_CHUNK_HEAD = struct.Struct('<QQQI')
_QOS = 'offered_qos_profiles'


class Message(NamedTuple):
    """One message of a bag, still serialized."""

    topic: str
    type: str
    time: int  # ns, when it was recorded
    data: memoryview
    qos: str = ''  # the profiles its topic was offered with, as YAML


Accept = Callable[[str, str, str], bool]
"""Whether messages of a type are wanted, given its name, the encoding of its definition and the definition."""


def messages(file: BinaryIO, size: int, accept: Accept, damage: Counter[str]) -> Iterator[Message]:
    """The wanted messages of a file of at most `size` bytes, in the order they were written. BagError if it is no MCAP file."""
    if file.read(len(MAGIC)) != MAGIC:
        raise BagError('not an MCAP file')
    channels = _Channels(accept, damage)
    while True:
        head = file.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (_CHUNK, LARGEST + 1)
        if opcode in (_DATA_END, _FOOTER):
            return
        record = memoryview(file.read(length)) if length <= min(size, LARGEST) else b''
        if len(record) < length:
            damage[TRUNCATED] += 1
            return
        if opcode == _CHUNK:
            try:
                content = _content(record)
            except (struct.error, ValueError, RuntimeError, zstd.ZstdError):  # RuntimeError: how lz4 complains
                damage[CORRUPT] += 1
                continue
            yield from channels.read(content)
        else:
            yield from channels.take(opcode, record)


class _Channels:
    """The channels met so far."""

    def __init__(self, accept: Accept, damage: Counter[str]):
        self._accept = accept
        self._damage = damage
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[str, str, str] | None] = {}  # topic, type, QoS; None where they are not wanted

    def read(self, records: memoryview) -> Iterator[Message]:
        """The wanted messages among the records of a chunk."""
        offset = 0
        while offset < len(records):
            start = offset + _RECORD.size
            opcode, length = _RECORD.unpack_from(records, offset) if start <= len(records) else (_CHUNK, LARGEST)
            offset = start + length
            if offset > len(records):
                self._damage[CORRUPT] += 1
                return
            yield from self.take(opcode, records[start:offset])

    def take(self, opcode: int, record: memoryview) -> Iterator[Message]:
        """What one record says, if it is understood."""
        try:
            if opcode == _MESSAGE:
                channel, _, time, _ = _MESSAGE_HEAD.unpack_from(record)
                known = self._channels[channel]
                if known is not None:
                    topic, kind, qos = known
                    yield Message(topic, kind, time, record[_MESSAGE_HEAD.size:], qos)
            elif opcode == _SCHEMA:
                (number,), rest = struct.unpack_from('<H', record), record[2:]
                name, rest = _text(rest)
                encoding, rest = _text(rest)
                self._schemas[number] = name, encoding, _text(rest)[0]
            elif opcode == _CHANNEL:
                (number, schema), rest = struct.unpack_from('<HH', record), record[4:]
                topic, rest = _text(rest)
                definition = self._schemas.get(schema, ('', '', ''))
                if number not in self._channels:
                    known = topic, definition[0], _map(_text(rest)[1]).get(_QOS, '')
                    self._channels[number] = known if self._accept(*definition) else None
        except (struct.error, ValueError, KeyError):  # KeyError: the channel's record is lost
            self._damage[CORRUPT] += 1


def _text(data: memoryview) -> tuple[str, memoryview]:
    """A length and so many bytes of UTF-8, and what follows."""
    (length,) = struct.unpack_from('<I', data)
    if length > len(data) - 4:
        raise ValueError('a text longer than its record')
    return bytes(data[4:4 + length]).decode(), data[4 + length:]


def _map(data: memoryview) -> dict[str, str]:
    """Texts by text, from a length in bytes and so many bytes of them."""
    (length,) = struct.unpack_from('<I', data)
    rest, found = data[4:4 + length], {}
    while rest:
        key, rest = _text(rest)
        found[key], rest = _text(rest)
    return found


def _content(chunk: memoryview) -> memoryview:
    """The records of a chunk. ValueError, RuntimeError or ZstdError if they are damaged."""
    _, _, size, checksum = _CHUNK_HEAD.unpack_from(chunk)
    compression, rest = _text(chunk[_CHUNK_HEAD.size:])
    (length,), packed = struct.unpack_from('<Q', rest), rest[8:]
    if length != len(packed) or size > LARGEST:
        raise ValueError('sizes that do not fit')
    content = decompressed(packed, compression, size)
    if len(content) != size or checksum and crc32(content) != checksum:
        raise ValueError('not what was written')
    return content


def decompressed(data: memoryview, compression: str, most: int) -> memoryview:
    """The data, at most so many bytes of them."""
    if compression == 'zstd':
        return memoryview(zstd.ZstdDecompressor().decompress(data, max_length=most))
    if compression == 'lz4':
        return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most))
    if compression:
        raise ValueError(f'compression {compression!r}')
    return data
