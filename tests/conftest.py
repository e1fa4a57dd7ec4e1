"""Puts the tests' process into the surroundings the nodes run in: one thread for each numerical library."""

import functools

import dae_ros_nodes  # noqa: F401  sets the variables; before numpy and torch are imported
import pytest

from dae_ros.learning.native import build


@pytest.fixture(scope='session')
def compiled(tmp_path_factory):
    """Compiles the kernels with more flags, once each; gives the library's path."""
    @functools.lru_cache(maxsize=None)
    def compiled_with(*flags):
        path = tmp_path_factory.mktemp('kernels') / 'kernels.so'
        build.build(path, *flags)
        return path

    return compiled_with
