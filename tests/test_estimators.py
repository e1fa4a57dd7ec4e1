"""COMA's advantages and targets against their definitions, and the replay of the reward network."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros import config
from dae_ros.config import RewardNetworkSettings
from dae_ros.learning import advantages
from dae_ros.learning.chunks import ActionChunks
from dae_ros.learning.estimators import ensemble_prediction
from dae_ros.learning.learner import Learner
from dae_ros.learning.reward_replay import RewardReplay
from dae_ros.rollout.in_process import train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds
from tests.learners import COMA, LEARNER, REPLAY, REWARD, SPEC, parameters, random_trajectory, state_of

UNIT = strategies.one_of(strategies.sampled_from([0.0, 1.0]), strategies.floats(0, 1))


def rollout(steps, worlds, agents, seed, ends):
    """Rewards and ends [T, W], and action values of what was done [T, W, N]; some episodes terminate, some are cut off."""
    random = np.random.default_rng(seed)
    terminated = random.random((steps, worlds)) < ends
    truncated = ~terminated & (random.random((steps, worlds)) < ends)
    return random.normal(size=(steps, worlds)), terminated, truncated, random.normal(size=(steps, worlds, agents))


def flags(terminated, truncated):
    """What the functions under test are told: c_t, and where the next joint action is unknown."""
    cut_off = truncated.copy()
    cut_off[-1] |= ~terminated[-1]
    return torch.tensor(1.0 - (terminated | truncated)), torch.tensor(cut_off)


def n_rewards_then_q(rewards, terminated, truncated, q, gamma, n, t):
    """r_t + gamma r_{t+1} + ... + gamma^n Q_{t+n} of one world, as far as its episode and the rollout are known."""
    total = 0.0
    for l in range(n):
        if truncated[t + l] or (t + l == len(rewards) - 1 and not terminated[t + l]):
            return total + gamma**l * q[t + l]
        total += gamma**l * rewards[t + l]
        if terminated[t + l]:
            return total
    return total + gamma**n * q[t + n]


CASES = {'steps': strategies.integers(1, 9), 'worlds': strategies.integers(1, 3), 'seed': strategies.integers(0, 2**32),
         'gamma': UNIT, 'ends': strategies.sampled_from([0, 0.15, 0.5])}


@settings(max_examples=60, deadline=None, derandomize=True)
@given(n=strategies.integers(0, 10), **CASES)
def test_n_step_returns_are_n_rewards_and_then_the_action_value(steps, worlds, seed, gamma, ends, n):
    rewards, terminated, truncated, q = rollout(steps, worlds, 2, seed, ends)
    returns = advantages.n_step_returns(torch.tensor(rewards), torch.tensor(q), *flags(terminated, truncated), gamma, n)
    for t, world, agent in np.ndindex(*q.shape):
        expected = n_rewards_then_q(rewards[:, world], terminated[:, world], truncated[:, world], q[:, world, agent], gamma, n, t)
        assert float(returns[t, world, agent]) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(gae_lambda=UNIT, **CASES)
def test_lambda_returns_are_the_weighted_average_of_n_step_returns(steps, worlds, seed, gamma, ends, gae_lambda):
    """y_t = (1 - lambda) sum_n lambda^(n-1) R^n_t; beyond the known end all R^n are the same."""
    rewards, terminated, truncated, q = rollout(steps, worlds, 1, seed, ends)
    q = q[..., 0]
    returns = advantages.lambda_returns(torch.tensor(rewards), torch.tensor(q), *flags(terminated, truncated), gamma, gae_lambda)
    for t, world in np.ndindex(*q.shape):
        one = rewards[:, world], terminated[:, world], truncated[:, world], q[:, world], gamma
        expected = sum((1 - gae_lambda) * gae_lambda**(n - 1) * n_rewards_then_q(*one, n, t) for n in range(1, steps + 1))
        expected += gae_lambda**steps * n_rewards_then_q(*one, steps + 1, t)
        assert float(returns[t, world]) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.fixture
def learner():
    made = []

    def make(*arguments):
        made.append(Learner(SPEC, *arguments, 1))
        return made[-1]

    yield make
    for one in made:
        one.close()


def estimate(learner, trajectory):
    """The estimator's advantages [T, W, N] of a rollout."""
    return learner._estimator.estimate(learner._tensors(trajectory), 0).advantages


def action_values(learner, trajectory):
    """Q for all actions [T, W, N, A], in the reward's scale."""
    data, network = learner._tensors(trajectory), learner._estimator._action_value
    return learner._estimator._value_norm.denormalize(network.predict(network.inputs(data), data)[0])


def test_the_advantage_of_coma_is_the_action_value_less_its_average_over_the_own_action(learner):
    coma, trajectory = learner(COMA, REWARD), random_trajectory()
    coma.update(random_trajectory(seed=1), 0)
    values = action_values(coma, trajectory)
    taken = values.gather(-1, torch.tensor(trajectory.actions)[..., None])[..., 0]
    expected = taken - (values * torch.tensor(trajectory.probabilities)).sum(-1)
    torch.testing.assert_close(estimate(coma, trajectory), expected)
    assert (expected[..., 0] - expected[..., 1]).abs().max() > 1e-3  # each agent has its own


def test_n_step_coma_puts_the_first_rewards_in_the_place_of_the_action_value(learner):
    settings = replace(COMA, estimator='coma_nstep', coma_steps=2)
    trajectory = random_trajectory(terminations=0, truncations=0)
    coma = learner(settings, REWARD)
    values = action_values(coma, trajectory)
    taken = values.gather(-1, torch.tensor(trajectory.actions)[..., None])[..., 0]
    average = (values * torch.tensor(trajectory.probabilities)).sum(-1)
    rewards, gamma = torch.tensor(trajectory.rewards)[..., None], settings.gamma
    expected = rewards[0] + gamma * rewards[1] + gamma**2 * taken[2] - average[0]
    torch.testing.assert_close(estimate(coma, trajectory)[0], expected)


def test_with_coma_the_action_value_learns_the_lambda_returns_and_there_is_no_other_critic(learner):
    """With one agent, lambda = 1 and one-step episodes, Q is to be the reward of the action."""
    coma = learner(replace(COMA, gae_lambda=1.0, epochs=1), replace(REWARD, hidden_size=32, epochs=30, learning_rate=3e-3))
    trajectory = random_trajectory(steps=12, worlds=40, terminations=1.0, truncations=0)
    payoff = np.random.default_rng(4).normal(0, 3, (3, 4))
    trajectory = trajectory._replace(rewards=payoff[np.arange(3), trajectory.actions].sum(-1).astype(np.float32))
    for number in range(30):
        metrics = coma.update(trajectory, number)
    assert metrics['action_value/explained_variance'] > 0.9
    values = action_values(coma, trajectory).numpy()
    true = trajectory.rewards[..., None] - payoff[np.arange(3), trajectory.actions]
    error = values - (true[..., None] + payoff)
    assert np.square(error).mean() < 0.1 * np.square(true[..., None] + payoff).mean()
    assert {name.split('.')[0] for name in coma.state()} == {'actor', 'action_value', 'value_norm'}


def test_bootstrapping_uses_what_is_known_at_a_cut_off_episode_s_last_step(learner):
    coma = learner(replace(COMA, estimator='coma_nstep', coma_steps=50), REWARD)
    trajectory = random_trajectory(steps=1, terminations=0, truncations=1.0)
    values = action_values(coma, trajectory)
    taken = values.gather(-1, torch.tensor(trajectory.actions)[..., None])[..., 0]
    torch.testing.assert_close(estimate(coma, trajectory), taken - (values * torch.tensor(trajectory.probabilities)).sum(-1))


@pytest.mark.parametrize('changes', [{'estimator': 'coma'}, {'estimator': 'coma_nstep', 'coma_steps': 2},
                                     {'reward_network.replay_rollouts': 3, 'reward_network.replay_steps': 20}],
                         ids=['coma', 'coma n-step', 'replay'])
def test_a_team_learns_the_matrix_game(changes, tmp_path):
    given_settings = config.from_flat({
        'task': 'matrix_game', 'num_agents': 3, 'num_worlds': 32, 'num_steps': 3, 'total_steps': 32 * 3 * 40, 'epochs': 5,
        'reward_network.epochs': 5, 'hidden_size': 16, 'reward_network.hidden_size': 32, 'learning_rate': 5e-3,
        'reward_network.learning_rate': 5e-3, 'evaluation_episodes': 32, 'learner_threads': 1, **changes})
    worlds = make_worlds(given_settings.task)
    training = Training(given_settings, worlds.spec, RunFolder(tmp_path / 'run', given_settings))
    train(training, worlds, lambda: None)
    training.close()
    assert training.evaluation.mean() >= 2  # of 3; drawn at random it is 0


# The replay.


def chunk(number, length=2, count=3):
    """A rollout's chunks, all full of its number."""
    full = torch.full((length, count, SPEC.num_agents), number)
    return ActionChunks(full[..., :1, None].float(), full[..., 0] > 0, full, full[..., 0].float(),
                        torch.ones(length, count, SPEC.num_agents)), [torch.full((count, 1, 2), float(number))]


def test_the_replay_draws_from_the_newest_rollouts_and_keeps_their_parts_together():
    replay = RewardReplay(RewardNetworkSettings(replay_rollouts=3, replay_steps=20, replay_chunks=5), seed=1)
    for newest in range(1, 8):
        replay.add(*chunk(newest))
        drawn = set()
        for chunks, first in replay.batches(0, newest):
            assert chunks.actions.shape == (2, 5, SPEC.num_agents)
            numbers = chunks.actions[0, :, 0]
            drawn |= set(numbers.tolist())
            assert (chunks.targets == numbers).all() and (chunks.actions == numbers[:, None]).all()
            assert (first[:, 0, 0] == numbers).all()
        assert drawn == set(range(max(1, newest - 2), newest + 1))


def test_draws_of_the_replay_are_keyed_by_update_and_member():
    def draws(seed, member, number):
        replay = RewardReplay(RewardNetworkSettings(replay_rollouts=3, replay_steps=4, replay_chunks=8), seed)
        for rollout in range(3):
            chunks, (first,) = chunk(rollout)
            replay.add(chunks, [first, first])
        return torch.stack([chunks.targets for chunks, _ in replay.batches(member, number)])

    assert torch.equal(draws(1, 0, 5), draws(1, 0, 5))
    for other in (draws(2, 0, 5), draws(1, 1, 5), draws(1, 0, 6)):
        assert not torch.equal(draws(1, 0, 5), other)


def test_with_a_replay_the_reward_network_alone_learns_otherwise(learner):
    plain, replayed = learner(LEARNER, REWARD), learner(LEARNER, REPLAY)
    for one in (plain, replayed):
        one.update(random_trajectory(), 0)
    one, other = state_of(plain), state_of(replayed)
    for network, same in (('actor', True), ('critic', True), ('reward_network.0', False)):
        for name, tensor in parameters(one, network).items():
            assert np.array_equal(tensor, parameters(other, network)[name]) == same, name


def test_the_reward_network_says_what_it_expects_of_a_rollout_and_others_say_that_they_cannot(learner):
    dae, trajectory = learner(LEARNER, REWARD), random_trajectory()
    expected = dae.expected_rewards(trajectory)
    data = dae._tensors(trajectory)
    predicted = ensemble_prediction(dae._estimator._reward, data)[0].numpy()
    np.testing.assert_allclose(expected, (predicted * trajectory.probabilities).sum(-1), rtol=1e-6)
    with pytest.raises(ValueError, match='at beta = 0 there is no reward network'):
        learner(replace(LEARNER, beta=0.0), REWARD).expected_rewards(trajectory)
    with pytest.raises(ValueError, match='estimator = coma there is no reward network'):
        learner(COMA, REWARD).expected_rewards(trajectory)


@pytest.mark.parametrize('architecture', ['per_agent', 'shared_trunk'])
@pytest.mark.parametrize('recurrent', [True, False])
def test_a_reward_network_without_memory_forgets_earlier_steps(recurrent, architecture, learner):
    dae = learner(LEARNER, replace(REWARD, recurrent=recurrent, architecture=architecture))
    one = random_trajectory(terminations=0, truncations=0)
    other = one._replace(states=one.states.copy(), actions=one.actions.copy())
    other.states[0] += 1
    other.actions[0] = (other.actions[0] + 1) % SPEC.num_actions
    dae.update(one, 0)
    differs = (dae.expected_rewards(one) != dae.expected_rewards(other)).any(axis=(1, 2))
    assert differs[0] and (differs[1:] == recurrent).all()


def test_with_exact_rewards_dae_subtracts_those_and_learns_no_reward_network():
    trajectory = random_trajectory()
    truth = np.random.default_rng(9).normal(size=trajectory.actions.shape)
    told = []

    def exact_rewards(rollout):
        told.append(rollout)
        return truth

    learners = [Learner(SPEC, LEARNER, REWARD, 1, exact_rewards=exact_rewards),
                Learner(SPEC, replace(LEARNER, beta=0.0), REWARD, 1)]
    dae, gae = (estimate(one, trajectory) for one in learners)
    continues = torch.tensor(1.0 - (trajectory.terminated | trajectory.truncated)).float()
    baselines = advantages.credit_baselines(torch.tensor(truth).float(), continues, LEARNER.beta, LEARNER.gamma,
                                            LEARNER.gae_lambda)
    torch.testing.assert_close(dae, gae - baselines)
    np.testing.assert_array_equal(told[0].actions, trajectory.actions)
    assert not any('reward_network' in name for name in learners[0].state())
    for one in learners:
        one.close()
