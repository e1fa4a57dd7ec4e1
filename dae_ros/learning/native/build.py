"""Compiles kernels.c for this processor, once per user and machine.

The library is built where it is first needed, so every way of installing the package gives the same speed, and
the instructions are always those of the processor that runs them.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Iterator

SOURCE = Path(__file__).with_name('kernels.c')
_FLAGS = ('-std=gnu11', '-O3', '-ffp-contract=fast', '-fno-math-errno', '-fno-trapping-math', '-Wno-psabi', '-fPIC',
          '-shared')


class BuildError(Exception):
    """The library could not be compiled; says why."""


def build(target: Path, *flags: str) -> None:
    """Compiles the library to `target`, with more flags if given; it appears whole or not at all. Raises BuildError."""
    command = compiler()
    tuning = '-march=native' if platform.machine() in ('x86_64', 'AMD64', 'i686') else '-mcpu=native'
    temporary = target.with_name(f'.{target.name}.{os.getpid()}')
    command += [*_FLAGS, tuning, *flags, str(SOURCE), '-o', str(temporary), '-lm']
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
        if result.returncode:
            raise BuildError(f'{shlex.join(command)} failed: {result.stderr.strip()[:500]}')
        os.replace(temporary, target)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f'{command[0]}: {error}') from error
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def library_path() -> Iterator[Path]:
    """Path of the compiled library while the block runs; compiled now if this user has none for processor and source.

    It is kept in $XDG_CACHE_HOME/dae_ros (~/.cache/dae_ros), or, if nothing can be written there, in a folder that is
    removed again. Of processes that start at once, one compiles and the others wait for it. Raises BuildError.
    """
    name = f'kernels-{_key()}.so'
    folder = Path(os.environ.get('XDG_CACHE_HOME') or Path('~/.cache').expanduser()) / 'dae_ros'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        usable = os.access(folder, os.W_OK) or (folder / name).exists()
    except OSError:
        usable = False
    with contextlib.nullcontext(folder) if usable else tempfile.TemporaryDirectory() as chosen:
        path = Path(chosen) / name
        if not path.exists():
            with _locked(path.parent):
                if not path.exists():
                    build(path)
        yield path


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One process at a time, if the file system can lock a folder; else several compile, each a whole file."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def compiler() -> list[str]:
    """Command of the C compiler: $CC, or the first there is. Raises BuildError."""
    named = shlex.split(os.environ.get('CC', ''))
    for candidate in [named] if named else [['cc'], ['gcc'], ['clang']]:
        if shutil.which(candidate[0]):
            return candidate
    raise BuildError('there is no C compiler (set CC, or install gcc or clang)')


def _key() -> str:
    """What the compiled library depends on: source, flags, compiler's name, processor."""
    processor = {platform.machine(), platform.processor()}
    with contextlib.suppress(OSError):
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
        processor |= {line for line in lines if line.startswith(('flags', 'Features', 'model name', 'CPU part'))}
    parts = [SOURCE.read_text(encoding='utf-8'), *_FLAGS, os.environ.get('CC', ''), *sorted(processor)]
    return hashlib.sha256('\0'.join(parts).encode()).hexdigest()[:16]
