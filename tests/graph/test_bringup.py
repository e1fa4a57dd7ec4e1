"""What bringup does when things go wrong: it says so, stops what it started, and exits with a code that tells."""

from __future__ import annotations

import os
import select
import signal
import time
from pathlib import Path

import pytest
from harness import LASTING, SMALL, TIMEOUT, Listener, bringup, finish, oracle, pid_of, processes_naming

from dae_ros.report.metrics import read_metrics
from dae_ros.report.summary import Summary
from dae_ros.ros.supervisor import catches

LONG = {**SMALL, 'total_steps': 10**7}


@pytest.fixture
def long_run(request, domain, tmp_path):
    """A run that would take hours, seen to be learning; with other settings by indirect parameters."""
    process = bringup(tmp_path / 'run', {**LONG, **getattr(request, 'param', {})})
    try:
        with Listener() as listener:
            listener.wait_for_status(lambda status: status.policy_version >= 1)
        yield process
    finally:
        process.kill()
        process.communicate(timeout=TIMEOUT)


@pytest.mark.parametrize('long_run', [{'max_restarts': 0}], indirect=True)
@pytest.mark.parametrize('node', ['world', 'agents_0-2', 'parameter_server', 'trainer'])
def test_a_node_that_dies_too_often_ends_the_run_with_its_name_and_no_process_left(node, long_run, tmp_path):
    pid = pid_of(node, tmp_path / 'run')
    os.kill(pid, signal.SIGKILL)
    code, _, errors = finish(long_run)
    assert code == 2
    assert f'{node} was killed by SIGKILL' in errors
    assert 'Traceback' not in errors
    assert not processes_naming(str(tmp_path))


@pytest.mark.parametrize('long_run', [{'max_restarts': 2}], indirect=True)
def test_a_node_that_is_started_again_and_refuses_to_run_ends_the_run_with_what_it_said(long_run, tmp_path):
    (tmp_path / 'run' / 'attempts').write_text('damaged')
    os.kill(pid_of('trainer', tmp_path / 'run'), signal.SIGKILL)
    code, output, errors = finish(long_run)
    assert code == 2
    assert 'trainer was killed by SIGKILL and is started again' in output
    assert 'trainer ended with exit code 2' in errors and 'attempts should hold the number of attempts' in errors
    assert 'Traceback' not in output + errors
    assert not processes_naming(str(tmp_path))


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_stops_every_process(number, long_run, tmp_path):
    long_run.send_signal(number)
    code, output, errors = finish(long_run)
    assert code == 130
    assert 'Traceback' not in output + errors
    assert not processes_naming(str(tmp_path))
    logs = [path.read_text() for path in (tmp_path / 'run' / 'logs').iterdir()]
    assert len(logs) == 4 and not any('Traceback' in log for log in logs), logs


def test_an_interrupted_run_goes_on_from_its_checkpoint_to_the_same_weights(domain, tmp_path):
    values = {**LASTING, 'total_steps': 60 * 8 * 25, 'checkpoint_interval': 5}
    process = bringup(tmp_path / 'run', values)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 7)
    process.send_signal(signal.SIGINT)
    assert finish(process)[0] == 130
    assert not (tmp_path / 'run' / 'summary.json').exists()
    code, _, errors = finish(bringup(tmp_path / 'run', values))
    assert code == 0, errors
    summary = Summary.read(tmp_path / 'run' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', values)
    steps = read_metrics(tmp_path / 'run' / 'metrics.csv')['environment_steps']
    assert list(steps) == [200 * (update + 1) for update in range(60)]


def test_nodes_end_when_bringup_itself_is_killed(long_run, tmp_path):
    pids = [pid_of(node, tmp_path / 'run') for node in ('world', 'agents_0-2', 'parameter_server', 'trainer')]
    long_run.kill()
    long_run.wait(TIMEOUT)
    for pid in pids:
        wait_until_gone(pid)


@pytest.mark.parametrize('arguments, sentence', [
    (['-p', 'betta:=1'], "unknown setting 'betta'; did you mean 'beta'?"),
    (['-p', 'beta:=high'], "beta must be a number, not 'high'"),
    (['-p', 'beta:=2'], 'beta must lie in 0.0 .. 1.0, not 2.0'),
    (['-p', 'task:=soccer'], "unknown task 'soccer'"),
    (['missing.yaml'], 'cannot read the task file missing.yaml'),
    (['no_such_task'], "there is no task file 'no_such_task'"),
])
def test_a_wrong_setting_is_one_sentence_before_anything_starts(arguments, sentence, domain, tmp_path):
    code, _, errors = finish(bringup(tmp_path / 'run', {}, *arguments))
    assert code == 2
    assert sentence in errors and len(errors.strip().splitlines()) == 1
    assert not (tmp_path / 'run').exists()


def wait_until_gone(pid: int) -> None:
    """Waits for a process that is not a child of ours."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    assert select.select([descriptor], [], [], TIMEOUT)[0], f'process {pid} is still there'
    os.close(descriptor)


def runs(executable: str, folder: Path) -> bool:
    """Whether a process of the run that lies below `folder` runs it."""
    return any(f'dae_ros_nodes.{executable} ' in line for line in processes_naming(str(folder)))


MOMENTS = {
    'as soon as it can hear': lambda process, folder: catches(process.pid, signal.SIGTERM),
    'while nodes are started': lambda process, folder: runs('agent', folder),
    'when the last node has begun': lambda process, folder: runs('trainer', folder),
}


@pytest.mark.parametrize('times', [1, 2], ids=['once', 'twice at once'])
@pytest.mark.parametrize('moment', MOMENTS)
def test_ctrl_c_at_any_time_stops_every_process_without_a_traceback(moment, times, domain, tmp_path):
    process = bringup(tmp_path / 'run', LONG)
    try:
        while not MOMENTS[moment](process, tmp_path):
            assert process.poll() is None
            time.sleep(0.005)
        for _ in range(times):
            process.send_signal(signal.SIGINT)
        code, output, errors = finish(process)
    finally:
        process.kill()
    logs = [path.read_text() for path in (tmp_path / 'run' / 'logs').glob('*')]
    assert code == 130 and errors.strip().splitlines()[-1] == 'stopped; every process is down'
    assert not any('Traceback' in text for text in (output, errors, *logs)), [output, errors, *logs]
    assert not processes_naming(str(tmp_path))
