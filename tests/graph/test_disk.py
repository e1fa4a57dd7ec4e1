"""A run folder on a disk that is full, or that may only be read: one sentence, nothing left behind, and the run goes on later."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from harness import SMALL, bringup, finish, oracle, processes_naming

from dae_ros.report.summary import Summary

VALUES = {**SMALL, 'total_steps': 8 * 8 * 25}
SIZE = 2 * 2**20  # bytes


def mount(*arguments: str) -> None:
    done = subprocess.run(['mount', *arguments], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f'it takes the right to mount: {done.stderr.strip()}')


@pytest.fixture
def disk(tmp_path):
    """A file system of two megabytes."""
    path = tmp_path / 'disk'
    path.mkdir()
    mount('-t', 'tmpfs', '-o', f'size={SIZE}', 'tmpfs', str(path))
    yield path
    subprocess.run(['umount', '--lazy', str(path)], check=True)


def assert_refused(process: subprocess.Popen, folder: Path) -> str:
    """The command ends with exit code 2, without a traceback anywhere and with no process left; what it said."""
    code, output, errors = finish(process)
    logs = ''.join(path.read_text() for path in (folder / 'logs').glob('*')) if (folder / 'logs').exists() else ''
    assert code == 2 and errors.startswith('error: '), output + errors
    assert 'Traceback' not in output + errors + logs
    assert not processes_naming(str(folder))
    return errors


@pytest.mark.parametrize('left, where', [(0, []), (400_000, []), (40_000, ['--in-process'])])
def test_a_full_disk_is_one_sentence_and_with_room_again_the_run_goes_on_to_the_same_weights(left, where, domain, disk, tmp_path):
    filler = disk / 'filler'
    filler.write_bytes(bytes(SIZE - left))
    errors = assert_refused(bringup(disk / 'run', VALUES, *where), disk / 'run')
    assert 'No space left on device' in errors or 'is full' in errors
    filler.unlink()
    code, _, errors = finish(bringup(disk / 'run', VALUES, *where))
    assert code == 0, errors
    summary = Summary.read(disk / 'run' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', VALUES)


@pytest.mark.parametrize('begun, where', [(False, []), (True, ['--in-process'])])
def test_a_disk_that_may_only_be_read_is_one_sentence(begun, where, domain, disk):
    if begun:
        assert finish(bringup(disk / 'run', {**VALUES, 'keep_checkpoints': 1}, '--in-process'))[0] == 0
        (disk / 'run' / 'summary.json').unlink()
    mount('-o', 'remount,ro', str(disk))
    errors = assert_refused(bringup(disk / 'run', {**VALUES, 'keep_checkpoints': 1}, *where), disk / 'run')
    assert 'Read-only file system' in errors
