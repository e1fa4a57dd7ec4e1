"""The matching of robots and targets against SciPy's, and against what a matching is."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies
from scipy.optimize import linear_sum_assignment

from dae_ros.worlds import matching


def least_cost(cost):
    rows, columns = linear_sum_assignment(cost)
    return cost[rows, columns].sum()


@pytest.mark.parametrize('num_worlds', [1, 300])
@pytest.mark.parametrize('size', range(1, 9))
def test_every_world_gets_the_matching_of_the_hungarian_method(size, num_worlds):
    cost = np.random.default_rng(size).random((size, size, num_worlds))
    targets = matching.match(cost)
    for world in range(num_worlds):
        np.testing.assert_array_equal(targets[:, world], linear_sum_assignment(cost[:, :, world])[1])


@settings(max_examples=100, deadline=None)
@given(size=strategies.integers(1, 7), data=strategies.data())
def test_costs_with_ties_are_matched_one_to_one_at_the_least_total(size, data):
    costs = strategies.lists(strategies.integers(0, 3), min_size=size * size, max_size=size * size)
    cost = np.array(data.draw(costs), dtype=np.float64).reshape(size, size)
    targets = matching.match(cost[:, :, None])[:, 0]
    assert sorted(targets) == list(range(size))
    assert cost[np.arange(size), targets].sum() == least_cost(cost)
