"""The commands and the Python of docs/bags.md work as they stand there, one after the other, only shorter."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from harness import REPOSITORY, Listener, end

from dae_ros.ros import names, qos

TEXT = (REPOSITORY / 'docs/bags.md').read_text()
SHORTER = '-p num_worlds:=8 -p total_steps:=2000 -p evaluation_episodes:=8 -p epochs:=1 -p reward_network.epochs:=1'


def shell(command: str) -> list[str]:
    """The command for this machine, where the packages may not be installed."""
    command = re.sub(r'install/dae_ros/lib/dae_ros/(\w+)', rf'{sys.executable} -m dae_ros_nodes.\1', command)
    return ['bash', '-c', f'exec {command}']


def finish(command: str, folder) -> str:
    done = subprocess.run(shell(command), cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow  # two trainings and five starts of Python with torch
def test_a_run_is_recorded_read_and_learnt_from_as_documented(domain, tmp_path):
    from diagnostic_msgs.msg import DiagnosticArray

    (tmp_path / 'config').symlink_to(REPOSITORY / 'config')
    record, train, play, learn, use = ''.join(re.findall(r'```bash\n(.*?)```', TEXT, re.DOTALL)).splitlines()
    recorder = subprocess.Popen(shell(record), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        with Listener() as listener:
            heard = []
            listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, heard.append, qos.EVENTS)
            listener.spin_until(lambda: heard)
        finish(f'{train} {SHORTER}', tmp_path)
    finally:
        (said, _), = end(recorder)
    assert recorder.returncode == 0 and 'messages in bags/navigation' in said

    assert 'messages played' in finish(play, tmp_path)
    code, = re.findall(r'```python\n(.*?)```', TEXT, re.DOTALL)
    output = finish(f"{sys.executable} -c '{code.replace(chr(39), chr(34))}'", tmp_path)
    assert '(25, 8, 3, 18)' in output  # the first rollouts of so short a run may be over before the recorder is found
    quick = '-p reward_network.hidden_size:=16 -p reward_network.trunk_size:=16'
    assert 'SHA-256' in finish(f'{learn} {quick} -p max_epochs:=1', tmp_path)
    assert (tmp_path / 'runs/reward/report.png').exists()
    finish(f'{use} {quick} {SHORTER}', tmp_path)
