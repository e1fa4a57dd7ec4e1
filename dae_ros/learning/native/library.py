"""The compiled library from Python: its structures and functions, and whether it is used. Imports neither torch nor numpy.

It is compiled where it is first needed, and not used where there is no C compiler or where the environment variable
DAE_ROS_KERNELS is `torch`: then the learner computes with torch, and the robots' policy with numpy.
"""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from typing import Iterable

from dae_ros.learning.native.build import BuildError, library_path

_KINDS = {'layer': 0, 'gru': 1, 'fan_out': 2}
_ACTIVATIONS = {'identity': 0, 'relu': 1, 'tanh': 2}
_CHOICE = os.environ.get('DAE_ROS_KERNELS', 'native')
if _CHOICE not in ('native', 'torch'):
    raise ValueError(f'DAE_ROS_KERNELS must be native or torch, not {_CHOICE!r}')


class CStep(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in ('kind', 'activation', 'inputs', 'outputs')]
    _fields_ += [('parameters', ctypes.c_void_p * 4), ('gradients', ctypes.c_void_p * 4)]


class CArray(ctypes.Structure):
    _fields_ = [('data', ctypes.c_void_p), ('step', ctypes.c_long), ('column', ctypes.c_long)]


class CBatch(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in ('length', 'columns', 'agents', 'rows')]
    _fields_ += [(name, CArray) for name in ('inputs', 'start', 'codes')]
    _fields_ += [(name, ctypes.c_void_p) for name in ('initial', 'table')]


class CLoss(ctypes.Structure):
    _fields_ = [('kind', ctypes.c_long), ('numbers', ctypes.c_double * 3), ('actions', CArray), ('data', CArray * 2),
                ('weights', CArray), ('available', CArray)]


def c_step(kind: str, activation: str, inputs: int, outputs: int, addresses: Iterable[int | None]) -> CStep:
    """A step of a network with parameters at these addresses (see kernels.c)."""
    return CStep(_KINDS[kind], _ACTIVATIONS[activation], inputs, outputs, (ctypes.c_void_p * 4)(*addresses))


@functools.cache
def chosen() -> ctypes.CDLL | None:
    """The library, loaded at the first call, or None where it is not used."""
    if _CHOICE == 'torch':
        return None
    try:
        with library_path() as path:
            return opened(path)
    except (BuildError, OSError) as error:
        warnings.warn(f'without its native kernels dae_ros learns and acts several times slower: {error}', stacklevel=2)
        return None


def opened(path: os.PathLike | str) -> ctypes.CDLL:
    """The library at `path`, ready to be called."""
    loaded = ctypes.CDLL(str(path))
    steps, count, batch, address = ctypes.POINTER(CStep), ctypes.c_long, ctypes.POINTER(CBatch), ctypes.c_void_p
    loaded.network_forward.argtypes = [steps, count, batch, address, address]
    loaded.network_gradient.argtypes = [steps, count, batch, ctypes.POINTER(CLoss), address, address]
    loaded.policy_pack.argtypes, loaded.policy_pack.restype = [steps, count, address], ctypes.c_long
    loaded.policy_act.argtypes = [address, count, address, ctypes.c_long, *[address] * 6]
    return loaded
