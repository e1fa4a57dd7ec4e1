"""Makes the peers' environments in `.peers/`, once, from the pinned lists in `requirements/`, without GPU parts."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

from benchmarks.machine import ROOT

FOLDER = ROOT / '.peers'
LISTS = Path(__file__).with_name('requirements')
TORCH = ROOT / 'requirements/torch.txt'
OLDEST_PYTHON = {'jaxmarl': (3, 11)}  # where it is not ours
NEEDS_TORCH = {'benchmarl'}
CERTIFICATES = Path('/etc/ssl/certs/ca-certificates.crt')


class CannotInstall(Exception):
    """Says in a sentence why there is no environment for a peer."""


def prepare(name: str) -> Path:
    """The Python of the environment called `name`, which is made unless it is there already. Raises CannotInstall."""
    oldest = OLDEST_PYTHON.get(name, sys.version_info[:2])
    if sys.version_info < oldest:
        raise CannotInstall(f'{name} needs Python {oldest[0]}.{oldest[1]}, and .venv has {sys.version_info[0]}.'
                            f'{sys.version_info[1]}: PYTHON=/path/to/a/newer/python make build changes that')
    folder = FOLDER / name
    python, record = folder / 'bin/python', folder / '.dae_ros'
    packages, torch = LISTS / f'{name}.txt', TORCH.read_text().strip() if name in NEEDS_TORCH else ''
    # Written last, so that an interrupted installation is begun anew.
    wanted = hashlib.sha256(f'{sys.version} {torch} {packages.read_text()}'.encode()).hexdigest()
    if not record.exists() or record.read_text() != wanted:
        print(f'Installing {name} into {folder.relative_to(ROOT)}', file=sys.stderr, flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        venv.create(folder, with_pip=True)
        if torch:
            _install_torch(python, torch)
        _install(python, name, '-r', str(packages))
        record.write_text(wanted)
    return python


def _install(python: Path, name: str, *what: str) -> None:
    """With uv, which needs a tenth of pip's time, or else with pip, which may know a mirror."""
    for command in (_uv(python, *what), _pip(python, *what)):
        if command:
            answer = _run(command)
            if not answer.returncode:
                return
    raise CannotInstall(f'{name} could not be installed: {(answer.stderr.strip() or "no reason given").splitlines()[-1]}')


def _install_torch(python: Path, pin: str) -> None:
    """As scripts/setup.sh does, but never the general build."""
    # A local version is matched exactly: pip finds a CPU build where it is configured for one, or nothing.
    for command in (_pip(python, f'{pin}+cpu'), _uv(python, '--torch-backend', 'cpu', pin)):
        if command and not _run(command).returncode:
            return
    raise CannotInstall(f'no CPU build of {pin} can be reached from here, and the general one brings gigabytes of CUDA packages')


def _pip(python: Path, *what: str) -> list[str]:
    return [str(python), '-m', 'pip', '--disable-pip-version-check', '-qq', 'install', '--no-deps', *what]


def _uv(python: Path, *what: str) -> list[str]:
    uv = Path(sys.prefix) / 'bin/uv'
    return [str(uv), 'pip', 'install', '--quiet', '--python', str(python), '--no-deps', *what] if uv.exists() else []


def _run(command: list[str]) -> subprocess.CompletedProcess:
    environment = clean_environment()
    if CERTIFICATES.exists():  # uv then trusts whom the machine trusts, as pip does
        environment.setdefault('UV_SYSTEM_CERTS', 'true')
    return subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True)


def clean_environment() -> dict[str, str]:
    """This process's environment without the paths on which our own packages and ROS lie."""
    return {name: value for name, value in os.environ.items() if name not in ('PYTHONPATH', 'VIRTUAL_ENV', 'LD_LIBRARY_PATH')}
