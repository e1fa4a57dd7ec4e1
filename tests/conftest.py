"""Puts the tests' process into the surroundings the nodes run in: one thread for each numerical library."""

import functools

import dae_ros_nodes  # noqa: F401  sets the variables; before numpy and torch are imported
import pytest

from dae_ros.learning.learner import Learner
from dae_ros.learning.native import build
from tests.learners import LEARNER, REWARD, SPEC


@pytest.fixture(scope='session')
def compiled(tmp_path_factory):
    """Compiles the kernels with more flags, once each; gives the library's path."""
    @functools.lru_cache(maxsize=None)
    def compiled_with(*flags):
        path = tmp_path_factory.mktemp('kernels') / 'kernels.so'
        build.build(path, *flags)
        return path

    return compiled_with


@pytest.fixture
def make_learner():
    """Makes learners and ends their threads."""
    made = []

    def make(settings=LEARNER, reward_settings=REWARD, spec=SPEC, seed=1):
        made.append(Learner(spec, settings, reward_settings, seed))
        return made[-1]

    yield make
    for learner in made:
        learner.close()
