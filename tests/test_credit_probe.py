"""The measures of credit on known cases, and the truth they are taken against."""

import math

import numpy as np
import pytest

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.credit_probe import accuracy, probe
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest
from dae_ros.worlds import BUILT_IN, make_worlds

TASKS = pytest.mark.parametrize('task', BUILT_IN)
T, W, N = 9, 40, 3


def some_worlds(task, **settings):
    return make_worlds(TaskSettings(task=task, num_agents=N, num_worlds=W, **settings))


def some_policy(worlds):
    """One whose probabilities differ clearly between actions and observations."""
    sizes = PolicyArchitecture(worlds.spec.observation_size, worlds.spec.num_actions, 8, mlp_layers=1, activation='relu')
    draw = np.random.default_rng(3)
    return Policy(sizes, {name: draw.normal(size=shape).astype(np.float32) for name, shape in sizes.shapes().items()})


def run_probe(task, rollout=0, predict=lambda trajectory: np.zeros((T, W, N)), **settings):
    worlds = some_worlds(task, **settings)
    return probe(worlds, some_policy(worlds), predict, seed=1, rollout=rollout, num_steps=T)


def some_case(seed=0):
    """Rewards [T, W] and their expectation [T, W, N], as far as `accuracy` can tell."""
    draw = np.random.default_rng(seed)
    rewards = draw.normal(-3.0, 2.0, (T, W))
    return rewards, rewards[..., None] + draw.normal(size=(T, W, N))


def test_a_perfect_prediction_explains_everything_without_error():
    rewards, expected = some_case()
    assert accuracy(rewards, expected, expected) == pytest.approx((0.0, 1.0, 1.0, 1.0))


def test_predicting_the_mean_explains_none_of_the_variance():
    rewards, expected = some_case()
    measured = accuracy(rewards, expected, np.full_like(expected, expected.mean()))
    assert measured.error == pytest.approx(expected.std())
    assert measured.explained == pytest.approx(0.0)


def test_predicting_the_reward_itself_explains_variance_and_no_credit():
    rewards, expected = some_case()
    measured = accuracy(rewards, expected, np.broadcast_to(rewards[..., None], expected.shape))
    assert measured.explained > 0.5
    assert measured.credit_explained == pytest.approx(0.0)
    assert math.isnan(measured.credit_correlation)


def test_half_the_credit_explains_three_quarters_of_it_and_correlates_fully():
    rewards, expected = some_case()
    half = rewards[..., None] - 0.5 * (rewards[..., None] - expected)
    measured = accuracy(rewards, expected, half)
    assert (measured.credit_explained, measured.credit_correlation) == pytest.approx((0.75, 1.0))


def test_where_no_agent_has_credit_there_is_none_to_explain():
    rewards = np.full((T, W), -1.0)
    measured = accuracy(rewards, np.full((T, W, N), -1.0), np.zeros((T, W, N)))
    assert measured.error == 1.0
    assert all(math.isnan(value) for value in measured[1:])


def test_the_truth_of_the_matrix_game_is_the_mean_action_on_turn_and_the_reward_itself_off_turn():
    trajectory, expected, _ = run_probe('matrix_game')
    on_turn = np.arange(T) % N
    for step, agent in enumerate(on_turn):
        pi = trajectory.probabilities[step, :, agent]
        np.testing.assert_allclose(expected[step, :, agent], pi @ (np.arange(1, N + 1) - (N + 1) / 2), atol=1e-6)
        others = np.delete(expected[step], agent, axis=1)
        np.testing.assert_allclose(others, np.repeat(trajectory.rewards[step, :, None], N - 1, axis=1), atol=1e-6)


@TASKS
def test_the_truth_is_the_mean_over_the_rewards_of_all_actions_weighted_as_the_policy_draws_them(task):
    worlds = some_worlds(task)
    trajectory, expected, _ = probe(worlds, some_policy(worlds), lambda _: np.empty(0), seed=1, rollout=0, num_steps=1)
    mean = np.zeros((W, N))
    for agent in range(N):
        for action in range(worlds.spec.num_actions):
            worlds.reset(draws.key(1, 'probe'), 0)
            actions = trajectory.actions[0].copy()
            actions[:, agent] = action
            mean[:, agent] += trajectory.probabilities[0, :, agent, action] * worlds.step(actions).reward
    np.testing.assert_allclose(expected[0], mean, rtol=1e-6, atol=1e-6)


@TASKS
def test_credit_is_zero_on_average_under_the_policy(task):
    trajectory, expected, _ = run_probe(task)
    credit = trajectory.rewards[..., None] - expected
    assert credit.std() > 0.001
    assert abs(credit.mean()) < 5.0 * credit.std() / np.sqrt(T * W)


def test_no_credit_is_left_where_rewards_are_paid_later():
    trajectory, expected, _ = run_probe('navigation', reward_delay=2)
    np.testing.assert_allclose(expected, np.repeat(trajectory.rewards[..., None], N, axis=2), rtol=1e-6)


def test_the_prediction_is_that_for_the_rollout_played():
    trajectory, _, predicted = run_probe('formation', predict=lambda trajectory: trajectory.actions * 2.0)
    np.testing.assert_array_equal(predicted, 2.0 * trajectory.actions)


def test_a_probe_is_the_same_for_the_same_rollout_and_differs_from_any_rollout_of_a_training():
    first, again, other = (run_probe('line', rollout).trajectory for rollout in (4, 4, 5))
    worlds = some_worlds('line')
    request = RolloutRequest(run=1, rollout=4, attempt=0, policy_version=0, seed=1, num_steps=T, greedy=False)
    of_training = InProcessCollector(worlds).collect(request, some_policy(worlds))
    for field in ('states', 'actions', 'rewards'):
        np.testing.assert_array_equal(getattr(again, field), getattr(first, field))
        for different in (other, of_training):
            assert not np.array_equal(getattr(different, field), getattr(first, field))


def test_a_probe_between_the_rollouts_of_a_training_changes_none_of_them():
    def rollouts(probing):
        worlds = some_worlds('navigation')
        policy, collector = some_policy(worlds), InProcessCollector(worlds)
        for rollout in range(3):
            request = RolloutRequest(1, rollout, attempt=0, policy_version=0, seed=1, num_steps=T, greedy=False)
            yield collector.collect(request, policy)
            if probing:
                probe(worlds, policy, lambda _: np.empty(0), seed=1, rollout=rollout, num_steps=T)

    for probed, alone in zip(rollouts(probing=True), rollouts(probing=False), strict=True):
        for ours, expected in zip(probed, alone):
            np.testing.assert_array_equal(ours, expected)
