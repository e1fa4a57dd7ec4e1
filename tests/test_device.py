"""Where the learner computes: as named, and on a GPU the same as on the processor, to rounding."""

import numpy as np
import pytest
import torch

from dae_ros import config
from dae_ros.errors import SettingsError
from dae_ros.learning.device import chosen_device
from dae_ros.learning.distributed import make_learner
from tests.test_distributed import SPEC, trajectory

with_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason='there is no CUDA device here')
SMALL = {'hidden_size': 16, 'reward_network.hidden_size': 12, 'chunk_length': 4, 'epochs': 1, 'reward_network.epochs': 1}


def test_the_processor_is_taken_where_it_is_named():
    assert chosen_device(SPEC, config.from_flat({'device': 'cpu'})) == torch.device('cpu')


@pytest.mark.skipif(torch.cuda.is_available(), reason='there is a CUDA device here')
def test_without_a_gpu_auto_takes_the_processor_and_naming_one_is_an_error():
    assert chosen_device(SPEC, config.from_flat({})) == torch.device('cpu')
    with pytest.raises(SettingsError, match='no CUDA device here; use cpu or auto'):
        make_learner(SPEC, config.from_flat({'device': 'cuda'}))


@with_gpu
@pytest.mark.parametrize('architecture', ['per_agent', 'shared_trunk'])
def test_a_gpu_learns_what_the_processor_learns(architecture):
    states = {}
    for device in ('cpu', 'cuda'):
        learner = make_learner(SPEC, config.from_flat(SMALL | {'device': device, 'reward_network.architecture': architecture}))
        learner.update(trajectory(), 0)
        states[device] = learner.state()
        learner.close()
    for name, expected in states['cpu'].items():
        np.testing.assert_allclose(states['cuda'][name], expected, rtol=1e-3, atol=1e-4, err_msg=name)


@with_gpu
def test_auto_takes_one_of_both():
    assert chosen_device(SPEC, config.from_flat(SMALL)).type in ('cpu', 'cuda')
