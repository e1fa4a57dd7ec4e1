"""An agent's end of the lockstep: it acts once request, policy and observation are there, and refuses what does not belong."""

from __future__ import annotations

import numpy as np
import pytest

from dae_ros.errors import Refused
from dae_ros.rollout.lockstep import AgentEnd
from tests.played import (
    ACTIONS,
    OBSERVATIONS,
    POLICY,
    REQUEST,
    RUN,
    VERSION,
    Bad,
    T,
    W,
    agent_with,
    assert_same,
    make_policy,
    refused,
    stamped,
    wider,
    with_entry,
)


@pytest.mark.parametrize('order', ['rpo', 'pro', 'rop', 'por', 'orp', 'opr'])
def test_an_agent_acts_once_request_policy_and_observation_are_there_in_whatever_order(order):
    agent = AgentEnd(1)
    takes = {'r': lambda: agent.on_request(REQUEST), 'p': lambda: agent.on_policy(RUN, VERSION, POLICY),
             'o': lambda: agent.on_observation(OBSERVATIONS[1][0])}
    answers = [takes[what]() for what in order]
    assert answers[:2] == [None, None]
    assert_same(answers[2], ACTIONS[1][0])
    for step in range(1, T):
        assert_same(agent.on_observation(OBSERVATIONS[1][step]), ACTIONS[1][step])


def test_an_agent_acts_with_the_version_asked_for_and_with_no_other():
    agent = AgentEnd(0)
    agent.on_policy(RUN, VERSION - 1, make_policy(VERSION - 1))
    agent.on_request(REQUEST)
    assert agent.missing_version == VERSION and agent.newest_version == VERSION - 1
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    assert agent.on_policy(RUN, VERSION + 1, make_policy(VERSION + 1)) is None
    assert agent.missing_version == VERSION and agent.newest_version == VERSION + 1
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])
    assert agent.missing_version is None


def test_an_agent_keeps_the_version_in_use_however_many_newer_ones_come():
    agent = agent_with(0)
    for version in range(VERSION + 1, VERSION + 5):
        agent.on_policy(RUN, version, make_policy(version))
    for step in range(1, T):
        assert_same(agent.on_observation(OBSERVATIONS[0][step]), ACTIONS[0][step])


def test_an_agent_refuses_a_version_it_holds():
    agent = agent_with(0)
    refused('duplicate', agent.on_policy, RUN, VERSION, make_policy(1))
    assert_same(agent.on_observation(OBSERVATIONS[0][1]), ACTIONS[0][1])


def bad_for_the_agent(step):
    observation = OBSERVATIONS[0][step]
    values = observation.values
    return [
        Bad('wrong_run', stamped(observation, run=6)), Bad('wrong_run', stamped(observation, run=0)),
        Bad('wrong_run', stamped(observation, run=6, rollout=9)),
        Bad('stale', stamped(observation, rollout=2)), Bad('stale', stamped(observation, attempt=0)),
        Bad('wrong_robot', observation._replace(robot=1)),
        Bad('not_finite', observation._replace(values=with_entry(values, (2, 1), np.nan))),
        Bad('not_finite', observation._replace(values=with_entry(values, (0, 0), np.inf))),
        Bad('duplicate', stamped(observation, step=step - 1)), Bad('unexpected', stamped(observation, step=step + 1)),
        Bad('wrong_version', observation._replace(policy_version=VERSION + 1)),
        Bad('wrong_shape', observation._replace(values=wider(values))),
        Bad('wrong_shape', observation._replace(values=values[:-1], episode_start=observation.episode_start[:-1])),
    ]


@pytest.mark.parametrize('step', range(1, T))
def test_an_agent_refuses_observations_that_do_not_belong_and_nothing_changes(step):
    for bad in bad_for_the_agent(step):
        agent = agent_with(*range(step))
        refused(bad.reason, agent.on_observation, bad.datum)
        for later in range(step, T):
            assert_same(agent.on_observation(OBSERVATIONS[0][later]), ACTIONS[0][later])


def test_an_agent_acts_once_on_an_observation():
    agent = agent_with(0, 1)
    for step in (0, 1):
        refused('duplicate', agent.on_observation, OBSERVATIONS[0][step])


def test_an_agent_begins_anew_for_a_later_request_and_for_no_other():
    agent = agent_with(0, 1)
    for request in (REQUEST, REQUEST._replace(rollout=2), REQUEST._replace(rollout=4, attempt=0)):
        with pytest.raises(Refused) as caught:
            agent.on_request(request)
        assert caught.value.reason in ('stale', 'duplicate')
    for run in (0, 6):
        refused('wrong_run', agent.on_request, REQUEST._replace(run=run, rollout=9))
    assert_same(agent.on_observation(OBSERVATIONS[0][2]), ACTIONS[0][2])
    agent.on_request(REQUEST._replace(attempt=2))
    for step in range(T):  # from the first step, without the memory of the attempt before
        answer = agent.on_observation(stamped(OBSERVATIONS[0][step], attempt=2))
        assert_same(answer, stamped(ACTIONS[0][step], attempt=2))


def test_an_agent_begins_a_rollout_without_memory_also_where_no_episode_starts_with_it():
    agent = agent_with(0, 1)
    agent.on_request(REQUEST._replace(attempt=2))
    observation = stamped(OBSERVATIONS[0][2], attempt=2, step=0)._replace(episode_start=np.zeros(W, bool))
    answer = agent.on_observation(observation)
    probabilities, _ = POLICY.act(observation.values, POLICY.initial_state(W), observation.episode_start)
    np.testing.assert_array_equal(answer.probabilities, probabilities)


def test_an_agent_takes_another_number_of_worlds_with_a_new_rollout():
    agent = agent_with(0, 1)
    agent.on_request(REQUEST._replace(rollout=4))
    first = stamped(OBSERVATIONS[0][0], rollout=4)
    answer = agent.on_observation(first._replace(values=first.values[:2], episode_start=first.episode_start[:2]))
    assert answer.actions.shape == (2,)


def test_an_agent_that_waits_for_a_policy_forgets_the_observation_of_an_attempt_given_up():
    agent = AgentEnd(0)
    agent.on_request(REQUEST)
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    agent.on_request(REQUEST._replace(attempt=2))
    assert agent.on_policy(RUN, VERSION, POLICY) is None
    answer = agent.on_observation(stamped(OBSERVATIONS[0][0], attempt=2))
    assert_same(answer, stamped(ACTIONS[0][0], attempt=2))


def test_an_agent_keeps_an_observation_that_came_before_its_request_and_one_more_that_was_given_up():
    agent = AgentEnd(0)
    agent.on_policy(RUN, VERSION, POLICY)
    assert agent.on_observation(stamped(OBSERVATIONS[0][0], attempt=2)) is None
    assert agent.on_request(REQUEST) is None
    assert_same(agent.on_request(REQUEST._replace(attempt=2)), stamped(ACTIONS[0][0], attempt=2))


def test_an_agent_that_waits_for_a_policy_refuses_a_second_observation_of_the_step_whatever_it_holds():
    agent, genuine = AgentEnd(0), OBSERVATIONS[0][0]
    agent.on_request(REQUEST)
    assert agent.on_observation(genuine) is None
    for other in (genuine, genuine._replace(values=genuine.values + 1), genuine._replace(values=wider(genuine.values))):
        refused('duplicate', agent.on_observation, other)
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])


def test_an_agent_without_a_run_joins_that_of_its_first_request_and_one_with_a_run_keeps_it():
    agent = AgentEnd(0)
    agent.on_request(REQUEST)
    assert agent.run == 5
    bound = AgentEnd(0, run=6)
    refused('wrong_run', bound.on_request, REQUEST)
    refused('wrong_run', bound.on_observation, OBSERVATIONS[0][0])
    assert bound.request is None


def test_an_agent_without_a_run_acts_with_the_policy_of_the_run_that_asks_it_and_of_no_other():
    agent = AgentEnd(0)
    agent.on_policy(6, VERSION, make_policy(1))
    agent.on_observation(stamped(OBSERVATIONS[0][0], run=6))
    assert agent.on_request(REQUEST) is None and agent.missing_version == VERSION
    assert agent.on_observation(OBSERVATIONS[0][0]) is None
    assert_same(agent.on_policy(RUN, VERSION, POLICY), ACTIONS[0][0])
    refused('wrong_run', agent.on_policy, 6, VERSION + 1, POLICY)


def test_an_agent_without_a_run_keeps_policies_of_a_few_runs_until_one_asks_it():
    agent = AgentEnd(0)
    for run in (RUN, 6, 7, 8):
        for version in (VERSION - 2, VERSION - 1, VERSION):
            agent.on_policy(run, version, POLICY if run == RUN else make_policy(run))
    agent.on_request(REQUEST)
    assert_same(agent.on_observation(OBSERVATIONS[0][0]), ACTIONS[0][0])
    flooded = AgentEnd(0)
    for run in range(1, 1000):
        flooded.on_policy(run, VERSION, POLICY)
    flooded.on_request(REQUEST)
    assert flooded.missing_version == VERSION
