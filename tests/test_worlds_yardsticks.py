"""Yardsticks against the returns measured with an independent implementation, over 4,000 episodes each."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.worlds.yardsticks import yardstick_returns

# mean returns for N = 3, 4, 5
MEASURED = {
    'navigation': {'random': (-218.1, -320.8, -435.9), 'no-op': (-203.7, -296.4, -399.2),
                   'greedy': (-114.7, -164.9, -221.1)},
    'formation': {'random': (-19.35, -18.66, -18.03), 'no-op': (-16.96, -16.21, -15.61),
                  'greedy': (-4.47, -4.25, -4.05)},
    'line': {'random': (-22.85, -22.60, -22.19), 'no-op': (-20.97, -20.58, -20.22), 'greedy': (-5.34, -5.18, -5.04)},
}


@pytest.mark.parametrize('num_agents', [3, 4, 5])
@pytest.mark.parametrize('task', MEASURED)
def test_untrained_teams_return_what_was_measured(task, num_agents):
    episodes = 2000
    returns = yardstick_returns(TaskSettings(task=task, num_agents=num_agents), episodes, seed=1)
    for name in ('random', 'no-op'):
        mean, error = returns[name]
        of_both = error * np.sqrt(1.0 + episodes / 4000)
        assert abs(mean - MEASURED[task][name][num_agents - 3]) < 4.0 * of_both
    mean, _ = returns['greedy']
    assert mean == pytest.approx(MEASURED[task]['greedy'][num_agents - 3], rel=0.04)


def test_the_best_return_of_the_matrix_game_is_120_for_16_agents():
    returns = yardstick_returns(TaskSettings(task='matrix_game', num_agents=16), 500, seed=1)
    assert returns['best'] == (120.0, 0.0)
    assert returns['no-op'] == (-120.0, 0.0)
    mean, error = returns['random']
    assert abs(mean) < 4.0 * error


def test_a_yardstick_is_the_same_for_the_same_seed():
    task = TaskSettings(task='line')
    assert yardstick_returns(task, 40, seed=1) == yardstick_returns(task, 40, seed=1)
    assert yardstick_returns(task, 40, seed=1) != yardstick_returns(task, 40, seed=2)


def test_a_pettingzoo_environment_has_the_yardsticks_that_need_no_insight():
    task = TaskSettings(task='pettingzoo:mpe2.simple_spread_v3', num_worlds=4)
    returns = yardstick_returns(task, 10, seed=1)
    assert set(returns) == {'no-op', 'random'}
    assert all(mean < 0.0 < error for mean, error in returns.values())


def test_no_episodes_are_no_yardstick():
    with pytest.raises(ValueError, match='num_episodes'):
        yardstick_returns(TaskSettings(), 0, seed=1)
