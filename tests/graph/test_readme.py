"""Every command of the README works: run here as it stands there, only shorter, or by continuous integration."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess

import pytest
from harness import REPOSITORY, TIMEOUT, end

README = (REPOSITORY / 'README.md').read_text()
SHORTER = '-p num_worlds:=8 -p total_steps:=400 -p evaluation_episodes:=8 -p epochs:=1 -p reward_network.epochs:=1'
REPRODUCE = 'make reproduce'  # tests/test_reproduce.py runs every figure in its short mode
EXECUTABLES = 'install/dae_ros/lib/dae_ros/'

BY_CONTINUOUS_INTEGRATION = {'make demo', 'make test', '. scripts/env.sh'}
WITH_ROS_INSTALLED = {'source /opt/ros/jazzy/setup.bash', 'make build && . scripts/env.sh',
                      'colcon build --base-paths src/dae_ros src/dae_ros/msg_schemas'}


def blocks(language: str) -> list[list[str]]:
    """The README's code blocks in one language, line by line."""
    return [block.splitlines() for block in re.findall(rf'```{language}\n(.*?)```', README, re.DOTALL)]


COMMANDS = [line for block in blocks('bash') for line in block]
BRINGUPS = [line for line in COMMANDS if 'bringup' in line and not line.startswith('ros2 ')]
ONE_BY_ONE = [[line for line in block if '--ros-args' in line or line.endswith('/parameter_server')] for block in blocks('bash')]
ONE_TEAM, GROUP_0, GROUP_1 = (block for block in ONE_BY_ONE if block)


@pytest.fixture
def folder(tmp_path, domain):
    """A folder in which the README's relative paths mean what they mean in the repository, and runs go elsewhere."""
    for name in ('install', 'config', 'examples'):
        if not (REPOSITORY / name).exists():
            pytest.skip('the packages are not built in this folder: make build')
        (tmp_path / name).symlink_to(REPOSITORY / name)
    return tmp_path


def run(command: str, folder) -> None:
    done = subprocess.run(['bash', '-c', command], cwd=folder, capture_output=True, text=True, timeout=TIMEOUT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_command_of_the_readme_is_forgotten():
    others = set(COMMANDS) - set(BRINGUPS) - {*ONE_TEAM, *GROUP_0, *GROUP_1} - BY_CONTINUOUS_INTEGRATION - WITH_ROS_INSTALLED
    assert all(line.startswith(('ros2 ', REPRODUCE)) for line in others), others


@pytest.mark.parametrize('command', BRINGUPS)
def test_a_bringup_command_of_the_readme_trains_and_leaves_its_run(command, folder):
    run(f'{command} {SHORTER}', folder)
    summary, = folder.glob('runs/*/summary.json')
    assert summary.stat().st_size > 0


@pytest.mark.parametrize('nodes', [ONE_TEAM, GROUP_1 + GROUP_0], ids=['one group', 'two groups'])
def test_the_nodes_start_one_by_one_as_the_readme_says(nodes, folder):
    commands = [f'{line} {SHORTER}' if '--params-file' in line else line for line in nodes]
    *others, trainer = commands
    processes = [subprocess.Popen(shlex.split(command), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
                 for command in others]
    try:
        run(trainer, folder)
        assert list(folder.glob('runs/*/summary.json'))
    finally:
        said = end(*processes)
    assert [process.returncode for process in processes] == [0] * len(processes), said


@pytest.mark.parametrize('command', [line for line in COMMANDS if line.startswith('ros2 ')])
@pytest.mark.skipif(not shutil.which('ros2'), reason='ros2 run and ros2 launch come with a ROS 2 installation')
def test_the_ros2_commands_of_the_readme_work(command, folder):
    if 'ros2 launch' in command:
        command = command.replace('parameters:="', f'parameters:="{SHORTER.replace("-p ", "")} ')
    else:
        command = f'{command} {SHORTER}'
    run(command, folder)
    assert list(folder.glob('runs/*/summary.json'))


def test_the_python_of_the_readme_trains(folder):
    code, = ('\n'.join(block) for block in blocks('python'))
    assert '50_000' in code
    run(f'python -c {shlex.quote(code.replace("50_000", "4_000"))}', folder)
    assert (folder / 'runs' / 'in_python' / 'policy.safetensors').exists()


def test_the_relative_links_of_the_readme_lead_somewhere():
    for target in re.findall(r'\]\(([^)#:]+)\)', README):
        assert os.path.exists(REPOSITORY / target), target
