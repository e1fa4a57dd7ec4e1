"""The paper's sections 3.1 to 3.3 and A.3 in exact numbers: what shaping does to returns, gradients and learned policies."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies

from dae_ros.learning import advantages, shaping
from tests import tabular
from tests.tabular import near

UNIT = strategies.one_of(strategies.sampled_from([0.0, 1.0]), strategies.floats(0, 1))
EPISODES = given(steps=strategies.integers(1, 9), shape=strategies.sampled_from([(), (3,), (2, 2)]),
                 agents=strategies.integers(1, 3), seed=strategies.integers(0, 2**32), gamma=UNIT, beta=UNIT)
HYPOTHESIS = settings(max_examples=30, deadline=None, derandomize=True)


def episode(steps, shape, agents, seed):
    random = np.random.default_rng(seed)
    return random.normal(0, 3, (steps, *shape)), random.normal(0, 3, (steps, *shape, agents))


def apply(function, *arrays_and_numbers):
    return function(*(torch.tensor(x) if isinstance(x, np.ndarray) else x for x in arrays_and_numbers)).numpy()


def returns_of(rewards, gamma):
    """The discounted sums, one step after another."""
    result = np.zeros((len(rewards) + 1, *rewards.shape[1:]))
    for t in reversed(range(len(rewards))):
        result[t] = rewards[t] + gamma * result[t + 1]
    return result[:-1]


# Rewards and returns of finite episodes.

def test_the_shaped_rewards_are_right_on_numbers_one_can_check():
    rewards, expected = np.array([1.0, 2.0, 3.0]), np.array([[4.0], [8.0], [16.0]])
    near(apply(shaping.k_step_rewards, rewards, expected, 1, 0.5)[:, 0], [1 + 4 - 4, 2 + 8 - 8, 3 - 16])
    near(apply(shaping.k_step_rewards, rewards, expected, 2, 0.5)[:, 0], [1 + 4 - 4, 2 - 8, 3 - 16])
    near(apply(shaping.k_step_returns, rewards, expected, 2, 0.5)[:, 0], [2.75 - 4 - 4, 3.5 - 8 - 8, 3 - 16])
    near(apply(shaping.beta_rewards, rewards, expected, 0.5, 0.5)[:, 0], [1 - 4 + 7 / 2, 2 - 8 + 12 / 2, 3 - 16 + 8])
    near(apply(shaping.beta_returns, rewards, expected, 0.5, 0.5)[:, 0], [2.75 - 7 / 2, 3.5 - 12 / 2, 3 - 8])


@HYPOTHESIS
@EPISODES
def test_eq_15_is_the_return_of_eq_14_for_every_k(steps, shape, agents, seed, gamma, beta):
    data = episode(steps, shape, agents, seed)
    for k in range(steps + 2):
        near(apply(shaping.k_step_returns, *data, k, gamma),
             returns_of(apply(shaping.k_step_rewards, *data, k, gamma), gamma))


@HYPOTHESIS
@EPISODES
def test_eq_17_is_the_return_of_eq_16(steps, shape, agents, seed, gamma, beta):
    data = episode(steps, shape, agents, seed)
    near(apply(shaping.beta_returns, *data, beta, gamma), returns_of(apply(shaping.beta_rewards, *data, beta, gamma), gamma))


@HYPOTHESIS
@EPISODES
def test_eq_16_is_the_weighted_average_over_k_from_0(steps, shape, agents, seed, gamma, beta):
    data = episode(steps, shape, agents, seed)
    shaped = [apply(shaping.k_step_rewards, *data, k, gamma) for k in range(steps + 1)]
    average = sum((1 - beta) * beta**k * shaped[k] for k in range(steps)) + beta**steps * shaped[steps]  # and all after
    near(apply(shaping.beta_rewards, *data, beta, gamma), average)


@HYPOTHESIS
@EPISODES
def test_the_second_line_of_eq_16_is_the_average_over_k_from_1_and_belongs_to_another_return(
        steps, shape, agents, seed, gamma, beta):
    rewards, expected = episode(steps, shape, agents, seed)
    after = np.zeros_like(expected)
    after[:-1] = returns_of(expected, gamma * beta)[1:]
    second_line = rewards[..., None] + (1 - beta) * gamma * after - expected
    shaped = [apply(shaping.k_step_rewards, rewards, expected, k, gamma) for k in range(1, steps + 1)]
    weights = [(1 - beta) * beta**k for k in range(steps - 1)] + [beta**(steps - 1)]
    near(second_line, sum(weight * reward for weight, reward in zip(weights, shaped)))
    near(returns_of(second_line, gamma), returns_of(rewards, gamma)[..., None] - returns_of(expected, gamma * beta))


def test_beta_0_is_the_reward_and_beta_1_the_difference_reward():
    rewards, expected = episode(7, (3,), 2, seed=1)
    for function in (shaping.beta_rewards, shaping.beta_returns):
        team, difference = rewards[..., None] + 0 * expected, rewards[..., None] - expected
        if function is shaping.beta_returns:
            team, difference = returns_of(team, 0.9), returns_of(difference, 0.9)
        near(apply(function, rewards, expected, 0.0, 0.9), team)
        near(apply(function, rewards, expected, 1.0, 0.9), difference)
    near(apply(shaping.k_step_rewards, rewards, expected, 0, 0.9), rewards[..., None] + 0 * expected)
    near(apply(shaping.k_step_rewards, rewards, expected, 7, 0.9), rewards[..., None] - expected)


@HYPOTHESIS
@EPISODES
def test_dae_at_lambda_1_is_eq_17_less_the_value_whatever_the_values(steps, shape, agents, seed, gamma, beta):
    rewards, expected = episode(steps, (3,), agents, seed)
    values = np.random.default_rng(seed).normal(size=(steps + 1, 3))
    values[-1] = 0
    near(difference_advantages(rewards, expected, values, beta, gamma),
         apply(shaping.beta_returns, rewards, expected, beta, gamma) - values[:-1, :, None])


def difference_advantages(rewards, expected, values, beta, gamma):
    """What training computes, at lambda = 1, for one episode [T] in each world W."""
    continues = np.ones(rewards.shape)
    continues[-1] = 0
    team = apply(advantages.generalized_advantages, rewards, values[:-1], values[1:], continues, gamma, 1.0)
    return team[..., None] - apply(advantages.credit_baselines, expected, continues, beta, gamma, 1.0)


# Policy gradients of small Dec-POMDPs, exact.

def games(count, seed=0, **shape):
    for number in range(count):
        random = np.random.default_rng((seed, number))
        game = tabular.random_game(random, actions=[(2, 3), (3, 2), (2, 2, 2)][number % 3], gamma=random.uniform(0.3, 0.8),
                                   **shape)
        yield game, [tabular.softmax(logits) for logits in tabular.random_logits(random, game)]


def gradients(game, policies, q_of_agent):
    """All agents' gradients, one after the other, each with its own Q."""
    return np.concatenate([tabular.policy_gradient(game, policies, agent, q_of_agent(agent)).ravel()
                           for agent in range(len(policies))])


def true_gradients(game, policies):
    q = tabular.q_values(game, policies, game.rewards)
    return gradients(game, policies, lambda agent: q)


def bias(game, policies, q_of_agent):
    return np.linalg.norm(gradients(game, policies, q_of_agent) - true_gradients(game, policies))


def steps_on(game, policies, table, steps):
    """E[f(s_t, a_t) | s_0, a_0] for t = steps."""
    for _ in range(steps):
        table = tabular.next_step(game, policies, table)
    return table


def later_rewards(game, policies, gamma, steps):
    """The sum over t = 1 ... steps of gamma^t E[r_t | s_0, a_0], the last step first."""
    total = np.zeros_like(game.rewards)
    for _ in range(steps):
        total = gamma * tabular.next_step(game, policies, game.rewards + total)
    return total


def shaped_once(game, policies, rewards, potential):
    """r + gamma E[phi(s', a')] - phi: the mean, given s and a, of a reward that also depends on s' and a'."""
    return rewards + game.gamma * tabular.next_step(game, policies, potential) - potential


def k_step_q(game, policies, k, agent):
    """The Q-function of eq. (14)'s rewards, by solving their chain."""
    expected = tabular.expected_over_own(game, policies, agent, game.rewards)
    return tabular.q_values(
        game, policies, game.rewards + game.gamma**k * steps_on(game, policies, expected, k) - expected)


def test_the_enumerated_gradient_is_the_derivative_of_the_value():
    for number in range(10):
        random = np.random.default_rng(number)
        game = tabular.random_game(random)
        logits = tabular.random_logits(random, game)
        policies = [tabular.softmax(table) for table in logits]
        q = tabular.q_values(game, policies, game.rewards)
        for agent in range(2):
            near(tabular.policy_gradient(game, policies, agent, q), tabular.derivative(
                lambda stepped: game.start @ tabular.values(game, [tabular.softmax(x) for x in stepped]), logits, agent))


def test_proposition_3_1_one_step_of_shaping_leaves_every_agent_s_gradient_as_it_is():
    for game, policies in games(60):
        def shaped(agent):
            potential = tabular.expected_over_own(game, policies, agent, game.rewards)
            return tabular.q_values(game, policies, shaped_once(game, policies, game.rewards, potential))
        near(gradients(game, policies, shaped), true_gradients(game, policies))


def test_any_potential_blind_to_the_agent_s_own_action_will_do_so_a_wrong_reward_network_does_no_harm():
    random = np.random.default_rng(1)
    for game, policies in games(20):
        potential = random.normal(0, 10, game.rewards.shape)
        near(gradients(game, policies, lambda agent: tabular.q_values(game, policies, shaped_once(
            game, policies, game.rewards, potential.take([0], 1 + agent)))), true_gradients(game, policies), 1e-9)


def test_a_potential_that_sees_the_agent_s_own_action_does_change_the_gradient():
    for game, policies in games(20):
        q = tabular.q_values(game, policies, shaped_once(game, policies, game.rewards, game.rewards))
        assert bias(game, policies, lambda agent: q) > 1e-3


def test_eq_28_is_the_q_function_of_k_step_rewards():
    for game, policies in games(20):
        q = tabular.q_values(game, policies, game.rewards)
        for agent, k in product(range(2), range(6)):
            expected = tabular.expected_over_own(game, policies, agent, game.rewards)
            later = later_rewards(game, policies, game.gamma, k - 1)
            near(k_step_q(game, policies, k, agent), q - later - (expected if k else 0))


def test_two_steps_and_more_bias_the_gradient_though_not_always_more_with_every_step():
    """The paper says "generally" of the growth: here k = 3 is more biased than k = 2 in about half of the games."""
    grew = []
    for game, policies in games(30):
        biases = [bias(game, policies, lambda agent: k_step_q(game, policies, k, agent)) for k in (0, 1, 2, 3)]
        near(biases[:2], 0)
        assert min(biases[2:]) > 1e-5
        grew.append(biases[3] > biases[2])
    assert 0.3 < np.mean(grew) < 0.7


def test_shaping_repeated_to_the_letter_is_never_biased_and_ends_in_coma_s_advantage():
    """Where the bias comes from: how eq. (13) reads E_{a_i}.

    Eq. (10) applied to r^(1)(s, a), its mean over the next step included, averages all that a_i changes: the next state
    too. That is a potential blind to a_i, so Proposition 3.1 holds again, for any k, and k -> infinity gives
    Q - E_{a_i}[Q]. Eq. (13)'s second line instead averages only the action of the step that is paid, E_{a_i}[r_{t+1}] at
    the state that was reached. This needs no model of the transitions, but that state depends on a_{i,t}.
    """
    for game, policies in games(6):
        def repeated(agent, times):
            rewards = game.rewards
            for _ in range(times):
                rewards = shaped_once(game, policies, rewards, tabular.expected_over_own(game, policies, agent, rewards))
            return tabular.q_values(game, policies, rewards)
        for times in (2, 3, 8):
            near(gradients(game, policies, lambda agent: repeated(agent, times)), true_gradients(game, policies))
        q = tabular.q_values(game, policies, game.rewards)
        near(repeated(0, 130), q - tabular.expected_over_own(game, policies, 0, q))


def test_the_q_function_of_eq_17_has_one_beta_more_than_eq_39_which_is_that_of_eq_16_s_second_line():
    for game, policies in games(4):
        q = tabular.q_values(game, policies, game.rewards)
        for agent, beta in product(range(2), (0.0, 0.3, 0.95, 1.0)):
            expected = tabular.expected_over_own(game, policies, agent, game.rewards)
            later = later_rewards(game, policies, game.gamma * beta, 130)
            near(tabular.beta_q(game, policies, beta, agent), q - beta * (later + expected))
            series = tabular.q_values(game._replace(gamma=game.gamma * beta), policies, expected + 0 * game.rewards)
            second_line = (game.rewards - expected
                           + (1 - beta) * game.gamma * tabular.next_step(game, policies, series))
            near(tabular.q_values(game, policies, second_line), q - later - expected)


def test_the_bias_of_beta_is_0_at_0_and_grows_with_it():
    """It grows in nearly all games, not in all: terms of different steps may cancel."""
    grew = []
    for game, policies in games(30):
        biases = [bias(game, policies, lambda agent: tabular.beta_q(game, policies, beta, agent))
                  for beta in (0, 0.01, 0.3, 0.6, 1)]
        near(biases[0], 0)
        assert 1e-8 < biases[1] < 2e-3 * biases[-1]  # of second order: beta times beta gamma
        grew.append((np.diff(biases) > 0).all())
    assert np.mean(grew) > 0.9


def test_the_bias_of_beta_is_what_an_agent_with_discount_beta_gamma_expects_from_later_steps():
    """Hence at beta = 1 nothing but the reward of the step itself is left: difference rewards make agents myopic."""
    for game, policies in games(20):
        for beta in (0.3, 0.95, 1.0):
            short = tabular.q_values(game._replace(gamma=game.gamma * beta), policies, game.rewards) - game.rewards
            q = tabular.q_values(game, policies, game.rewards) - beta * short
            near(gradients(game, policies, lambda agent: tabular.beta_q(game, policies, beta, agent)),
                 gradients(game, policies, lambda agent: q))
        near(gradients(game, policies, lambda agent: tabular.beta_q(game, policies, 1.0, agent)),
             gradients(game, policies, lambda agent: game.rewards))


def test_an_agent_that_cannot_move_the_state_is_not_biased_even_if_the_others_can():
    """The end of A.3 asks that nobody's actions move the state; that the agent's own do not is enough."""
    for movers in ((), (1,)):
        for game, policies in games(20, movers=movers):
            for agent in range(len(policies)):
                q = tabular.q_values(game, policies, game.rewards)
                true = tabular.policy_gradient(game, policies, agent, q)
                for shaped in (k_step_q(game, policies, 3, agent), tabular.beta_q(game, policies, 0.9, agent)):
                    difference = np.abs(tabular.policy_gradient(game, policies, agent, shaped) - true).max()
                    assert difference > 1e-5 if agent in movers else difference < 1e-10


def test_over_all_episodes_the_estimators_have_the_gradients_that_the_theory_gives_them():
    """No Q-functions: the mean over every possible episode of three steps of what would be estimated from each."""
    gamma, steps, changed = 0.8, 3, []
    for number in range(5):
        random = np.random.default_rng(number)
        game = tabular.random_game(random, states=2, actions=(2, 2), gamma=gamma)
        logits = tabular.random_logits(random, game)

        def value(stepped):
            states, actions, chances = tabular.all_episodes(game, [tabular.softmax(x) for x in stepped], steps)
            return chances @ (gamma**np.arange(steps) @ game.rewards[(states, *np.moveaxis(actions, -1, 0))])

        policies = [tabular.softmax(table) for table in logits]
        states, actions, chances = tabular.all_episodes(game, policies, steps)
        met = (states, *np.moveaxis(actions, -1, 0))
        rewards = game.rewards[met]
        expected = np.stack([np.broadcast_to(tabular.expected_over_own(game, policies, agent, game.rewards),
                                             game.rewards.shape)[met] for agent in range(2)], axis=-1)
        assert chances.sum() == pytest.approx(1)

        def estimated(estimates):
            """E[sum over t of gamma^t grad log pi_i(a_t | o_t) times the agent's estimate at t], all agents' in one row."""
            result = []
            for agent, policy in enumerate(policies):
                seen = game.observations[agent][states]
                scores = ((actions[..., agent, None] == np.arange(2)) - policy[seen])[..., None, :]
                scores = scores * (seen[..., None, None] == np.arange(len(policy))[:, None])
                result.append(np.einsum('w,t,tw,twoa->oa', chances, gamma**np.arange(steps), estimates[..., agent], scores))
            return np.concatenate([gradient.ravel() for gradient in result])

        true = np.concatenate([tabular.derivative(value, logits, agent).ravel() for agent in range(2)])
        for k in (0, 1):
            near(estimated(apply(shaping.k_step_returns, rewards, expected, k, gamma)), true)
        values = np.concatenate([random.normal(size=2)[states], np.zeros((1, len(chances)))])
        for beta in (0.0, 0.5, 1.0):
            near(estimated(difference_advantages(rewards, expected, values, beta, gamma)),
                 estimated(apply(shaping.beta_returns, rewards, expected, beta, gamma)))
        near(estimated(difference_advantages(rewards, expected, values, 0.0, gamma)), true)
        near(estimated(apply(shaping.beta_returns, rewards, expected, 1.0, gamma)),
             estimated(rewards[..., None] + 0 * expected))  # myopic
        changed += [np.abs(estimated(apply(shaping.k_step_returns, rewards, expected, k, gamma)) - true).max() for k in (2, 3)]
    assert min(changed) > 1e-5
