"""Signatures of policies with a key that trainer, parameter server and agents share: nobody else's weights are taken."""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
import struct
from pathlib import Path

from dae_ros.errors import Refused, SettingsError
from dae_ros.types import PolicyWeights

SHORTEST_KEY, LONGEST_KEY = 32, 4096  # bytes
_CONTEXT = b'dae_ros policy'
_RUN_AND_VERSION = struct.Struct('<QQ')


def read_key(path: Path) -> bytes:
    """The bytes of a key file, as they are. SettingsError if it cannot be read, is too short or open to other users."""
    try:
        with open(path, 'rb') as file:
            status = os.fstat(file.fileno())
            key = file.read(LONGEST_KEY + 1) if stat.S_ISREG(status.st_mode) else b''
    except OSError as error:
        raise SettingsError(f'cannot read key_file {path}: {error.strerror}') from error
    if not SHORTEST_KEY <= len(key) <= LONGEST_KEY:
        raise SettingsError(f'key_file {path} must be a file of {SHORTEST_KEY} to {LONGEST_KEY} bytes that nobody can guess, '
                            f'made for example with: (umask 077; head -c 32 /dev/urandom > {path})')
    if status.st_mode & 0o077:
        raise SettingsError(f'key_file {path} is open to other users of this machine: chmod 600 {path}')
    return key


def sign(weights: PolicyWeights, key: bytes | None) -> PolicyWeights:
    """The weights with their signature; without a key as they are."""
    return weights if key is None else weights._replace(signature=_signature(weights, key))


def check_signature(weights: PolicyWeights, key: bytes | None) -> None:
    """Refuses weights that were not signed with `key` for their run and their version; without a key none."""
    if key is not None and not hmac.compare_digest(weights.signature.encode(errors='replace'), _signature(weights, key).encode()):
        fault = 'is signed with another key or for another version' if weights.signature else 'is not signed'
        raise Refused(Refused.FORGED, f'policy version {weights.version} {fault}')


def _signature(weights: PolicyWeights, key: bytes) -> str:
    message = hmac.new(key, _CONTEXT + _RUN_AND_VERSION.pack(weights.run, weights.version), hashlib.sha256)
    message.update(weights.data)
    return message.hexdigest()
