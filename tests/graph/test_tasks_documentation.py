"""The commands of docs/tasks.md train the task of one's own and drive robots with what was learnt."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from functools import partial

from harness import REPOSITORY, TIMEOUT, finish, processes_naming
from robots import Stage, is_standing

SHORTER = '-p num_worlds:=8 -p total_steps:=400 -p evaluation_episodes:=8 -p epochs:=1 -p reward_network.epochs:=1'


def bringup(command: str, folder) -> subprocess.Popen:
    """A command of the documentation, started where its relative paths lead into `folder`."""
    path, executable, *arguments = command.split()
    assert path == 'PYTHONPATH=.:$PYTHONPATH' and executable == 'install/dae_ros/lib/dae_ros/bringup'
    (folder / 'examples').exists() or (folder / 'examples').symlink_to(REPOSITORY / 'examples')
    # Tests that were started in the background ignore SIGINT, and so would whatever they start.
    return subprocess.Popen([sys.executable, '-m', 'dae_ros_nodes.bringup', *arguments], cwd=folder, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            env={**os.environ, 'PYTHONPATH': f'.:{os.environ["PYTHONPATH"]}'},
                            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL))


def test_the_commands_of_the_documentation_train_the_escort_and_drive_robots_with_it(domain, tmp_path):
    text = (REPOSITORY / 'docs/tasks.md').read_text()
    train, execute = ''.join(re.findall(r'```bash\n(.*?)```', text, re.DOTALL)).splitlines()
    code, _, errors = finish(bringup(f'{train} {SHORTER}', tmp_path))
    assert code == 0, errors
    with Stage() as stage:
        driving = bringup(f'{execute} --run-folder {tmp_path}/driving', tmp_path)
        try:
            stage.spin_until(lambda: all(any(not is_standing(told) for told in stage.commands[robot]) for robot in range(3)),
                             lambda: str(dict(stage.diagnostics)))
            driving.send_signal(signal.SIGINT)
            _, errors = driving.communicate(timeout=TIMEOUT)
        finally:
            driving.kill()
    assert driving.returncode == 130, errors
    assert not processes_naming(str(tmp_path))
