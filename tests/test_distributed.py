"""The learner on two real processes, started by torchrun: the same gradients as one, to rounding, and a clean end."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from dae_ros import config, torchrun
from dae_ros.learning.learner import Learner
from dae_ros.learning.optimizer import FlatAdam
from dae_ros.types import Trajectory, WorldSpec

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {'GLOO_SOCKET_IFNAME': 'lo', 'PYTHONPATH': f'{ROOT}{os.pathsep}{os.environ.get("PYTHONPATH", "")}'}
SPEC = WorldSpec(num_agents=3, num_actions=4, observation_size=5, state_size=9, state_is_observations=False)

SCRIPT = '''
import sys
from tests.test_distributed import learn
learn(sys.argv[1])
'''


def settings(**changes):
    return config.from_flat({'hidden_size': 16, 'reward_network.hidden_size': 12, 'chunk_length': 4, 'epochs': 2,
                             'reward_network.epochs': 3, 'learner_threads': 1, **changes})


def trajectory(steps=6, worlds=7):
    random = np.random.default_rng(0)
    T, W, N, A = steps, worlds, SPEC.num_agents, SPEC.num_actions
    ended = random.random((T, W)) < 0.1
    start = np.concatenate([np.ones((1, W), bool), ended])
    return Trajectory(random.standard_normal((T, W, N, SPEC.observation_size), np.float32),
                      random.standard_normal((T + 1, W, SPEC.state_size), np.float32), start,
                      random.integers(A, size=(T, W, N)), random.dirichlet(np.ones(A), (T, W, N)).astype(np.float32),
                      random.standard_normal((T, W), np.float32), ended, np.zeros((T, W), bool),
                      np.zeros((0, SPEC.state_size), np.float32))


def gradients_of(learner):
    """By network, the gradients of every step of one update; learns nothing, so that all are comparable."""
    names = {adam: name for name, adam in learner._networks().items()}
    taken = {name: [] for name in names.values()}

    def step(adam, gradient):
        taken[names[adam]].append(gradient.clone())
        return 0.0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlatAdam, 'step', step)
        learner.update(trajectory(), 0)
    return taken


def learn(changes):
    """One of torchrun's processes."""
    changes = json.loads(changes)
    from dae_ros.learning.distributed import help_to_learn, make_learner

    if torchrun.rank():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(FlatAdam, 'step', lambda *_: 0.0)
            return help_to_learn()
    learner = make_learner(SPEC, settings(**changes))
    single = Learner(SPEC, *(getattr(settings(**changes), group) for group in ('learner', 'reward_network')), 1)
    together, alone = gradients_of(learner), gradients_of(single)
    for name in alone:
        for ours, expected in zip(together[name], alone[name], strict=True):
            assert expected.abs().max() > 0
            torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()) + 1e-8)
    learner.close()
    single.close()
    print('the gradients agree')


def free_port():
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        return listener.getsockname()[1]


def torchrun_command(*arguments):
    return [sys.executable, '-m', 'torch.distributed.run', '--nproc-per-node', '2', '--master-addr', '127.0.0.1',
            '--master-port', str(free_port()), *arguments]


def run_in_two(*arguments):
    return subprocess.run(torchrun_command(*arguments), capture_output=True, text=True, timeout=240,
                          env=ENVIRONMENT)


@pytest.mark.parametrize('changes', [{'beta': 0.0}, {'num_mini_batches': 3, 'reward_network.architecture': 'shared_trunk',
                                                     'reward_network.ensemble_size': 2},
                                     {'estimator': 'coma', 'reward_network.epochs': 2},
                                     {'reward_network.replay_rollouts': 2, 'reward_network.learns_first': True}],
                         ids=str)
def test_the_gradients_of_two_processes_are_those_of_one(changes, tmp_path):
    script = tmp_path / 'script.py'
    script.write_text(SCRIPT)
    result = run_in_two(str(script), json.dumps(changes))
    assert result.returncode == 0, result.stderr
    assert 'the gradients agree' in result.stdout


def test_a_training_by_two_processes_ends_cleanly_with_nearly_the_weights_of_one(tmp_path):
    own = [f'-p{name}:={value}' for name, value in {
        'num_worlds': 8, 'total_steps': 200, 'epochs': 1, 'reward_network.epochs': 1, 'evaluation_episodes': 8}.items()]
    arguments = ['-m', 'dae_ros_nodes.bringup', '--in-process', *own]
    result = run_in_two(*arguments, '--run-folder', str(tmp_path / 'two'))
    assert result.returncode == 0, result.stderr
    subprocess.run([sys.executable, *arguments, '--run-folder', str(tmp_path / 'one')], check=True, capture_output=True,
                   timeout=120)
    two, one = (load_file(tmp_path / name / 'policy.safetensors') for name in ('two', 'one'))
    for name, tensor in one.items():
        np.testing.assert_allclose(two[name], tensor, atol=2e-5)  # one step of 7e-4 each


def test_a_helper_whose_leader_dies_says_so_and_fails(tmp_path):
    script = tmp_path / 'script.py'
    script.write_text('''
import os, signal, sys
from tests.test_distributed import SPEC, settings
from dae_ros import torchrun
from dae_ros.errors import DaeRosError
from dae_ros.learning.distributed import help_to_learn, make_learner
if torchrun.rank() == 0:
    make_learner(SPEC, settings())
    os.kill(os.getpid(), signal.SIGKILL)
try:
    help_to_learn()
except DaeRosError as error:
    print(error)
    sys.exit(3)
''')
    environment = ENVIRONMENT | {'WORLD_SIZE': '2', 'MASTER_ADDR': '127.0.0.1', 'MASTER_PORT': str(free_port())}
    leader, helper = (subprocess.Popen([sys.executable, str(script)], env=environment | {'RANK': rank},
                                       stdout=subprocess.PIPE, text=True) for rank in '01')
    leader.communicate(timeout=120)
    said, _ = helper.communicate(timeout=120)
    assert helper.returncode == 3
    assert said.startswith('lost the leading learner: ')
