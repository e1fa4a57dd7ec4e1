"""Nodes that died are started again, ever later, and not for ever."""

import pytest

from dae_ros.restarts import EXIT_REFUSED, LONGEST_DELAY, Restarts, SignsOfLife, describe


def test_a_node_that_keeps_dying_is_started_again_ever_later_and_in_the_end_no_more():
    restarts = Restarts(10)
    delays = [restarts.delay('world', 1) for _ in range(10)]
    assert delays == sorted(delays) and delays[0] < delays[1] < delays[-1] == LONGEST_DELAY
    assert restarts.delay('world', -9) is None
    assert restarts.delay('trainer', -9) == delays[0]


def test_a_run_that_gets_on_forgives_the_nodes_that_died_before():
    restarts = Restarts(1)
    for _ in range(20):
        assert restarts.delay('world', -9) == restarts.delay('trainer', -9) < LONGEST_DELAY
        restarts.got_on()


def test_a_node_that_refuses_its_settings_is_not_started_again():
    assert Restarts(10).delay('world', EXIT_REFUSED) is None
    assert Restarts(0).delay('world', 1) is None


@pytest.mark.parametrize('code, words', [(1, 'ended with exit code 1'), (-9, 'was killed by SIGKILL'),
                                         (-77, 'was killed by signal 77')])
def test_an_exit_code_is_told_in_words(code, words):
    assert describe(code) == words


def test_a_node_is_silent_that_was_started_and_not_heard_for_long():
    signs = SignsOfLife(10)
    signs.heard('world', 0)
    assert signs.silent(100) == signs.deadlines() == []
    signs.started('world', 100)
    signs.started('trainer', 103)
    signs.heard('world', 105)
    assert signs.deadlines() == [115, 113] and signs.silent(112) == []
    assert signs.silent(113) == ['trainer'] and signs.silent(114) == []
    signs.forgive(150)
    assert signs.deadlines() == [160]
    signs.started('trainer', 155)
    assert signs.silent(160) == ['world'] and signs.silent(164) == []
    signs.ended('trainer')
    signs.heard('world', 164)
    assert signs.silent(200) == signs.deadlines() == []


def test_where_nobody_is_heard_it_is_the_listener_who_hears_nothing():
    signs = SignsOfLife(10)
    for name in ('world', 'trainer'):
        signs.started(name, 0)
    assert signs.silent(20) == [] and signs.deadlines() == [30, 30]
    signs.heard('world', 25)
    assert signs.silent(30) == ['trainer']
