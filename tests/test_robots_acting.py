"""An agent executes its last good policy alone; newer ones wait for an episode's start or for an order."""

import numpy as np
import pytest

from dae_ros.errors import Refused, SettingsError
from dae_ros.learning.policy import Policy, PolicyArchitecture, choose
from dae_ros.robots.acting import ActingEnd
from dae_ros.robots.setup import landmarks_in, make_pilot, task_frame
from dae_ros.types import Observation, Stamp

RUN, ROBOT, SEED = 5, 2, 11


def policy(seed, observation_size=4, num_actions=3):
    architecture = PolicyArchitecture(observation_size, num_actions, 8, 1, 'tanh')
    draw = np.random.default_rng(seed)
    return Policy(architecture, {name: draw.standard_normal(shape).astype(np.float32)
                                 for name, shape in architecture.shapes().items()})


def observation(step, rollout=0, start=False, robot=ROBOT, values=None):
    values = np.random.default_rng([rollout, step]).standard_normal((1, 4)).astype(np.float32) if values is None else values
    return Observation(Stamp(1, rollout, 0, step), robot, 0, np.array([start] * len(values)), values)


def agent(*versions, greedy=True):
    end = ActingEnd(ROBOT, greedy, SEED)
    for version in versions:
        end.on_policy(RUN, version, policy(version))
    return end


def test_it_acts_as_the_policy_with_its_own_recurrent_state_which_each_episode_begins_anew():
    end, state = agent(1), np.zeros((1, 8), np.float32)
    for rollout in range(2):
        for step in range(5):
            seen = observation(step, rollout, start=step == 0)
            probabilities, state = policy(1).act(seen.values, state, seen.episode_start)
            action = end.on_observation(seen)
            np.testing.assert_array_equal(action.probabilities, probabilities)
            assert action.actions[0] == probabilities.argmax() and action.stamp == seen.stamp
            assert (action.robot, action.policy_version) == (ROBOT, 1)


def test_sampling_draws_by_the_key_of_the_step():
    end = agent(1, greedy=False)
    for step in range(20):
        action = end.on_observation(observation(step, start=step == 0))
        assert action.actions[0] == choose(action.probabilities, False, SEED, 0, step, ROBOT)[0]


def test_without_a_policy_it_waits_and_with_its_first_one_it_begins_at_once():
    end = agent()
    assert end.on_observation(observation(0, start=True)) is None
    end.on_policy(RUN, 4, policy(4))
    assert end.on_observation(observation(1)).policy_version == 4


def test_a_newer_policy_waits_for_the_next_episode():
    end = agent(1)
    versions = []
    for rollout in range(2):
        for step in range(4):
            versions.append(end.on_observation(observation(step, rollout, start=step == 0)).policy_version)
            if (rollout, step) == (0, 1):
                end.on_policy(RUN, 2, policy(2))
                end.on_policy(RUN, 3, policy(3))
                assert end.waiting_version == 3
    assert versions == [1] * 4 + [3] * 4 and end.waiting_version is None


def test_when_told_it_takes_the_newer_policy_in_the_middle_of_an_episode_without_the_old_ones_memory():
    end = agent(1)
    end.on_observation(observation(0, start=True))
    end.on_policy(RUN, 2, policy(2))
    assert end.activate() == 2
    seen = observation(1)
    fresh, _ = policy(2).act(seen.values, np.zeros((1, 8), np.float32), seen.episode_start)
    np.testing.assert_array_equal(end.on_observation(seen).probabilities, fresh)


def test_told_so_without_a_newer_policy_it_goes_on_as_it_was():
    one, other = agent(1), agent(1)
    for step in range(5):
        one.activate()
        seen = observation(step, start=step == 0)
        np.testing.assert_array_equal(one.on_observation(seen).probabilities, other.on_observation(seen).probabilities)
    assert agent().activate() is None


@pytest.mark.parametrize('run, version, given, reason', [
    (RUN, 1, policy(1), Refused.DUPLICATE), (RUN, 0, policy(0), Refused.WRONG_VERSION), (6, 2, policy(2), Refused.WRONG_RUN),
    (0, 2, policy(2), Refused.WRONG_RUN), (RUN, 2, policy(2, observation_size=5), Refused.WRONG_SHAPE)])
def test_a_policy_that_does_not_belong_is_refused_and_the_last_good_one_stays(run, version, given, reason):
    end = agent(1)
    with pytest.raises(Refused) as refused:
        end.on_policy(run, version, given)
    assert refused.value.reason == reason
    assert end.on_observation(observation(0, start=True)).policy_version == 1


@pytest.mark.parametrize('wrong, reason', [
    (observation(1, robot=0), Refused.WRONG_ROBOT), (observation(0), Refused.DUPLICATE),
    (observation(1, values=np.zeros((2, 4), np.float32)), Refused.WRONG_SHAPE),
    (observation(1, values=np.zeros((1, 5), np.float32)), Refused.WRONG_SHAPE),
    (observation(1, values=np.full((1, 4), np.nan, np.float32)), Refused.NOT_FINITE)])
def test_an_observation_that_does_not_belong_is_refused_and_leaves_no_trace(wrong, reason):
    end, other = agent(1), agent(1)
    for one in (end, other):
        one.on_observation(observation(0, start=True))
    with pytest.raises(Refused) as refused:
        end.on_observation(wrong)
    assert refused.value.reason == reason
    np.testing.assert_array_equal(end.on_observation(observation(1)).probabilities,
                                  other.on_observation(observation(1)).probabilities)


def test_a_step_that_was_missed_does_not_stop_it():
    end = agent(1)
    assert end.on_observation(observation(0, start=True)) is not None
    assert end.on_observation(observation(3)) is not None


def test_landmarks_can_be_written_as_a_text():
    np.testing.assert_array_equal(landmarks_in('0.5 0.5, -1 2e-1'), [[0.5, 0.5], [-1.0, 0.2]])
    for text in ('0.5', '1 2, 3', 'a b'):
        with pytest.raises(SettingsError, match='x y, x y'):
            landmarks_in(text)


def test_a_slower_control_rate_lengthens_the_tasks_second():
    settings = {'scale': 2.0, 'origin_x': 1.0, 'origin_y': -1.0, 'control_rate': 5.0}
    assert task_frame(settings) == (2.0, (1.0, -1.0), pytest.approx(2.0))


def test_a_robot_the_team_does_not_have_is_refused_by_its_number():
    with pytest.raises(SettingsError, match='robot must lie in 0 .. 2'):
        make_pilot({'robot': 3, 'scale': 1.0, 'origin_x': 0.0, 'origin_y': 0.0, 'control_rate': 10.0})
