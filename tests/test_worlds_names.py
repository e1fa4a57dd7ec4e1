"""Worlds by the name of their task."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError
from dae_ros.worlds import BUILT_IN, make_worlds, world_spec


@pytest.mark.parametrize('task', BUILT_IN)
def test_the_spec_tells_the_shapes_without_the_worlds(task):
    settings = TaskSettings(task=task, num_agents=4, num_worlds=6)
    worlds, spec = make_worlds(settings), world_spec(settings)
    assert worlds.spec == spec
    joint = worlds.reset(seed=1, rollout=0)
    transition = worlds.step(np.zeros((6, 4), dtype=np.int64))
    for shown in (joint, transition.next):
        assert shown.observations.shape == (6, spec.num_agents, spec.observation_size)
        assert shown.state.shape == (6, spec.state_size)
        assert shown.episode_start.shape == (6,)
    assert transition.reward.shape == transition.terminated.shape == transition.truncated.shape == (6,)


def test_an_unknown_task_is_answered_with_those_there_are():
    with pytest.raises(SettingsError, match="'navigate'; there are navigation, formation, line, matrix_game, particle:M"):
        make_worlds(TaskSettings(task='navigate'))
