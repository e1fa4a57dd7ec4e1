"""The native library is compiled once per user, by one process, and is not needed."""

import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from dae_ros.learning.native import build, library

native = pytest.mark.skipif(library.chosen() is None, reason='the library cannot be compiled here, or is off')

ASK = 'from dae_ros.learning import kernels, policy; print(kernels.available(), policy.library.chosen() is not None)'
BUILD = 'import ctypes; from dae_ros.learning.native.build import library_path\nwith library_path() as p: ctypes.CDLL(str(p))'


def answer(code=ASK, **environment):
    """What a fresh process prints, by default whether learner and policy use the library, and what it warns of."""
    result = subprocess.run([sys.executable, '-c', code], env=os.environ | environment, capture_output=True, text=True,
                            timeout=180)
    return result.stdout.strip(), result.stderr


@pytest.fixture
def quick_compiler(tmp_path):
    """A C compiler that does not optimise, and writes down each call."""
    path = tmp_path / 'cc'
    path.write_text(f'#!/bin/sh\necho called >>{path}.log\nexec {shlex.join(build.compiler())} "$@" -O0\n')
    path.chmod(0o755)
    return str(path)


def test_the_library_can_be_switched_off():
    with ThreadPoolExecutor(2) as pool:
        off, unknown = pool.map(lambda choice: answer(DAE_ROS_KERNELS=choice), ('torch', 'fast'))
    assert off == ('False False', '')
    assert 'must be native or torch' in unknown[1]


def test_without_a_compiler_torch_and_numpy_take_over_with_one_warning(tmp_path):
    available, warnings = answer(DAE_ROS_KERNELS='native', CC='no-such-compiler', XDG_CACHE_HOME=str(tmp_path))
    assert available == 'False False'
    assert warnings.count('several times slower') == 1 and 'no C compiler' in warnings


@native
def test_of_processes_that_start_at_once_one_compiles_for_all(tmp_path, quick_compiler):
    with ThreadPoolExecutor(3) as pool:
        answers = list(pool.map(lambda _: answer(BUILD, XDG_CACHE_HOME=str(tmp_path), CC=quick_compiler), range(3)))
    assert answers == [('', '')] * 3
    assert len(list((tmp_path / 'dae_ros').iterdir())) == 1 and (tmp_path / 'cc.log').read_text() == 'called\n'
    assert answer(DAE_ROS_KERNELS='native', XDG_CACHE_HOME=str(tmp_path), CC=quick_compiler) == ('True True', '')


@native
def test_the_library_is_built_even_where_no_cache_can_be_kept(tmp_path, quick_compiler):
    (tmp_path / 'file').touch()
    assert answer(DAE_ROS_KERNELS='native', XDG_CACHE_HOME=str(tmp_path / 'file'), CC=quick_compiler) == ('True True', '')
