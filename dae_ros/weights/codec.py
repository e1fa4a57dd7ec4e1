"""Policies, reward networks and checkpoints as safetensors files: a schema in the metadata, a checksum, never pickle.

What comes in is trusted for nothing: size, schema, shapes and finiteness are checked before a tensor is used.
"""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any, Callable, Mapping, TypeVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from dae_ros.errors import Refused, SettingsError
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.types import PolicyWeights
from dae_ros.weights.signing import check_signature, sign

POLICY_FORMAT = 'dae_ros.policy/1'
CHECKPOINT_FORMAT = 'dae_ros.checkpoint/1'
REWARD_NETWORK_FORMAT = 'dae_ros.reward_network/1'
MAX_POLICY_BYTES = 64 * 2**20
_HEADER_LENGTH = struct.Struct('<Q')
_Decoded = TypeVar('_Decoded')


def sha256(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def tensors_sha256(tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes of all tensors: equal exactly where all weights are, bit for bit."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = np.asarray(tensors[name], order='C')
        digest.update(f'{name} {tensor.dtype.str} {tensor.shape}\n'.encode())
        digest.update(tensor.tobytes())
    return digest.hexdigest()


def read_file(path: Path, decode: Callable[[bytes], _Decoded], name: str, kind: str) -> _Decoded:
    """What `decode` makes of a file. SettingsError if it cannot be read or is no `kind`; `name` says who wanted it."""
    try:
        return decode(path.read_bytes())
    except OSError as error:
        raise SettingsError(f'cannot read {name} {path}: {error.strerror}') from error
    except Refused as refusal:
        raise SettingsError(f'{name} {path} is no {kind}: {refusal.detail}') from refusal


def encode_policy(policy: Policy) -> bytes:
    """The policy as a safetensors file; equal policies give equal bytes."""
    return _encode(POLICY_FORMAT, policy.tensors, policy.architecture._asdict())


def seal(run: int, version: int, data: bytes, key: bytes | None) -> PolicyWeights:
    """A policy's file as a message, with its checksum and, where the team has a key, its signature."""
    return sign(PolicyWeights(run, version, sha256(data), data), key)


def check_size(size: int) -> None:
    """Refuses weights of so many bytes where that is more than any policy has; to be asked before they are copied."""
    if size > MAX_POLICY_BYTES:
        raise Refused(Refused.OVERSIZED, f'{size} bytes of weights, at most {MAX_POLICY_BYTES} are taken')


def open_weights(weights: PolicyWeights, key: bytes | None) -> Policy:
    """The policy in a message. Raises Refused if it is too large, not signed with the team's key, damaged or something else."""
    check_size(len(weights.data))
    check_signature(weights, key)
    if sha256(weights.data) != weights.sha256:
        raise Refused(Refused.CORRUPT, f'the checksum of policy version {weights.version} does not match')
    return decode_policy(weights.data)


def decode_policy(data: bytes) -> Policy:
    """The policy in a safetensors file. Raises Refused if it is anything else."""
    tensors, schema = _decode(POLICY_FORMAT, data)
    try:
        architecture = PolicyArchitecture(**schema)
        sizes = architecture[:4]
        if (not all(type(size) is int and 0 < size < 2**16 for size in sizes) or architecture.mlp_layers > len(tensors)
                or architecture.activation not in ('relu', 'tanh')):
            raise ValueError('sizes that no policy has')
        policy = Policy(architecture, tensors)
    except (TypeError, ValueError) as error:
        raise Refused(Refused.WRONG_SHAPE, f'not a policy: {_short(error)}') from error
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32 or not np.isfinite(tensor).all():
            raise Refused(Refused.NOT_FINITE, f'{name} is not all finite 32-bit numbers')
    return policy


def encode_reward_network(tensors: Mapping[str, np.ndarray], schema: Mapping[str, Any]) -> bytes:
    """A file of reward networks: tensors by name, `<member>.<parameter>`, and what they are (JSON values)."""
    return _encode(REWARD_NETWORK_FORMAT, tensors, schema)


def decode_reward_network(data: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and schema of a file of reward networks. Raises Refused if it is anything else."""
    tensors, schema = _decode(REWARD_NETWORK_FORMAT, data)
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32 or not np.isfinite(tensor).all():
            raise Refused(Refused.NOT_FINITE, f'{name} is not all finite 32-bit numbers')
    return tensors, schema


def encode_checkpoint(tensors: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> bytes:
    """A checkpoint file: tensors by name, and facts (JSON values) about the run."""
    return _encode(CHECKPOINT_FORMAT, tensors, facts)


def decode_checkpoint(data: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and facts of a checkpoint file. Raises Refused if it is torn, corrupted or something else."""
    return _decode(CHECKPOINT_FORMAT, data)


def _checksum(tensors: Mapping[str, np.ndarray], schema: Mapping[str, Any]) -> str:
    return sha256(f'{tensors_sha256(tensors)} {json.dumps(schema, sort_keys=True)}'.encode())


def _encode(file_format: str, tensors: Mapping[str, np.ndarray], schema: Mapping[str, Any]) -> bytes:
    # One metadata key, because safetensors writes several in no fixed order.
    metadata = {'dae_ros': json.dumps({'format': file_format, **schema, 'sha256': _checksum(tensors, schema)}, sort_keys=True)}
    return save({name: np.asarray(tensor, order='C') for name, tensor in tensors.items()}, metadata=metadata)


def _decode(file_format: str, data: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    try:
        (length,) = _HEADER_LENGTH.unpack_from(data)
        header = json.loads(data[_HEADER_LENGTH.size:_HEADER_LENGTH.size + length])
        schema = json.loads(header['__metadata__']['dae_ros'])
        found = schema.pop('format')
        tensors = load(data)
    except (struct.error, ValueError, KeyError, TypeError, AttributeError, SafetensorError, RecursionError) as error:
        raise Refused(Refused.CORRUPT, f'not a {file_format} file: {_short(error)}') from error
    if found != file_format:
        raise Refused(Refused.CORRUPT, f'format {_short(found)}, expected {file_format}')
    if schema.pop('sha256', None) != _checksum(tensors, schema):
        raise Refused(Refused.CORRUPT, 'the checksum does not match')
    return tensors, schema


def _short(value: Any) -> str:
    """What a stranger's file made somebody say, fit for a line of a log."""
    return ascii(str(value))[:200]
