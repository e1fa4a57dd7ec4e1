"""Draws named by what they are for: the same name gives the same numbers, another name others."""

import math

import numpy as np
from hypothesis import given, settings, strategies

from dae_ros import draws

NAMES = strategies.tuples(strategies.integers(0, 2**63 - 1), strategies.sampled_from(['reset', 'action', 'a', 'b c']),
                          strategies.lists(strategies.integers(0, 2**40), max_size=4).map(tuple))


def numbers(seed, purpose, *indices):
    return draws.generator(seed, purpose, *indices).random(8)


def test_a_draw_is_the_same_in_every_release_and_on_every_machine():
    assert draws.key(1, 'action', 2, 3, 4) == 334999427404600227123179590672675611371
    drawn = draws.generator(1, 'action', 2, 3, 4).random(2)
    np.testing.assert_array_equal(drawn, [0.7744402349571989, 0.32825394736971747])


@settings(max_examples=200, deadline=None, derandomize=True)
@given(NAMES, NAMES)
def test_the_same_name_gives_the_same_key_and_another_name_another(one, other):
    key, same = (draws.key(seed, purpose, *indices) for seed, purpose, indices in (one, (*one[:2], tuple(one[2]))))
    assert key == same and 0 <= key < 2**128
    assert (key == draws.key(other[0], other[1], *other[2])) == (one == other)


def test_every_part_of_the_name_changes_the_numbers():
    drawn = numbers(1, 'action', 2, 3, 4)
    for other in [(2, 'action', 2, 3, 4), (1, 'reset', 2, 3, 4), (1, 'action', 3, 3, 4), (1, 'action', 2, 4, 4),
                  (1, 'action', 2, 3, 5), (1, 'action', 2, 3), (1, 'action', 2, 3, 4, 0), (1, 'action', 23, 4),
                  (1, 'action', 2, 34)]:
        assert not np.isin(numbers(*other), drawn).any(), other


def test_indices_may_be_integers_of_numpy():
    np.testing.assert_array_equal(numbers(np.int64(1), 'action', np.uint16(2), np.int32(3)), numbers(1, 'action', 2, 3))


def test_a_draw_does_not_depend_on_what_was_drawn_before():
    expected = numbers(1, 'action', 0)
    np.random.seed(5)
    np.random.random(3)
    numbers(1, 'action', 1)
    other = draws.generator(1, 'action', 0)
    other.random(3)
    np.testing.assert_array_equal(numbers(1, 'action', 0), expected)


def test_draws_of_neighbouring_names_are_uniform_and_independent():
    drawn = np.array([[draws.generator(1, 'action', rollout, robot).random() for robot in range(4)]
                      for rollout in range(500)])
    standard_error = math.sqrt(1 / 12 / drawn.size)
    assert abs(drawn.mean() - 0.5) < 4 * standard_error
    assert abs(drawn.var() - 1 / 12) < 4 * math.sqrt(1 / 180 / drawn.size)
    correlations = np.corrcoef(np.concatenate([drawn[1:], drawn[:-1]], axis=1).T)
    np.fill_diagonal(correlations, 0)
    assert np.abs(correlations).max() < 4.5 / math.sqrt(len(drawn))
