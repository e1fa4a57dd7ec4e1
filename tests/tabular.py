"""Small Dec-POMDPs solved exactly, by enumeration in float64: what the paper's statements are checked on.

S states; N agents of A_1, ..., A_N actions. A function of state and joint action is a table [S, A_1, ..., A_N]; one of
the state and the others' actions has length 1 on agent i's axis. A policy [O_i, A_i] has a row for each observation.
"""

from typing import NamedTuple

import numpy as np


class Game(NamedTuple):
    """transitions: [S, A_1, ..., A_N, S]. observations: [N, S], what each agent sees of a state. start: [S], mu."""
    rewards: np.ndarray
    transitions: np.ndarray
    observations: np.ndarray
    start: np.ndarray
    gamma: float


def random_game(random, states=4, actions=(2, 3), seen=2, gamma=0.8, movers=None):
    """Rewards uniform in [0, 1]; each agent tells `seen` groups of states apart; only `movers` move the state (all)."""
    transitions = random.dirichlet(np.full(states, 0.3), (states, *actions))
    for agent in set(range(len(actions))) - set(range(len(actions)) if movers is None else movers):
        transitions = np.repeat(transitions.take([0], 1 + agent), actions[agent], 1 + agent)
    observations = np.array([random.permutation(np.arange(states) % seen) for _ in actions])
    return Game(random.random((states, *actions)), transitions, observations, random.dirichlet(np.ones(states)), gamma)


def random_logits(random, game, scale=1.0):
    return [random.normal(0, scale, (seen.max() + 1, actions))
            for seen, actions in zip(game.observations, game.rewards.shape[1:])]


def softmax(logits):
    weights = np.exp(logits)
    return weights / weights.sum(-1, keepdims=True)


def own_policy(game, policies, agent):
    """pi_i(a_i | o_i(s)), a table with length 1 on the others' axes."""
    table = policies[agent][game.observations[agent]]
    return np.expand_dims(table, [1 + other for other in range(len(policies)) if other != agent])


def joint_policy(game, policies):
    return np.prod(np.broadcast_arrays(*(own_policy(game, policies, i) for i in range(len(policies)))), axis=0)


def expected_over_own(game, policies, agent, table):
    """E over a_i ~ pi_i: a function of the state and the others' actions."""
    return (own_policy(game, policies, agent) * table).sum(1 + agent, keepdims=True)


def next_step(game, policies, table):
    """E[f(s', a') | s, a] of a table f, its broadcast axes included."""
    values = (joint_policy(game, policies) * table).reshape(len(table), -1).sum(-1)
    return game.transitions @ values


def q_values(game, policies, rewards):
    """The joint Q of the given rewards, a table: the chain over (s, a) solved as a linear system."""
    size = game.rewards.size
    chain = game.transitions[..., None] * joint_policy(game, policies).reshape(len(game.start), -1)
    solved = np.linalg.solve(np.eye(size) - game.gamma * chain.reshape(size, size), rewards.reshape(size))
    return solved.reshape(game.rewards.shape)


def beta_q(game, policies, beta, agent):
    """The Q-function of eq. (16)'s rewards, by solving their chain; the series in gamma beta is a chain of its own."""
    expected = expected_over_own(game, policies, agent, game.rewards)
    series = q_values(game._replace(gamma=game.gamma * beta), policies, expected + 0 * game.rewards)
    return q_values(game, policies, game.rewards - expected + (1 - beta) * series)


def values(game, policies):
    """V [S], from the chain over states alone."""
    joint = joint_policy(game, policies)
    agents = tuple(range(1, joint.ndim))
    moves = (joint[..., None] * game.transitions).sum(agents)
    return np.linalg.solve(np.eye(len(moves)) - game.gamma * moves, (joint * game.rewards).sum(agents))


def state_distribution(game, policies):
    """d [S], the discounted share of time in each state from the start on."""
    joint = joint_policy(game, policies)
    moves = (joint[..., None] * game.transitions).sum(tuple(range(1, joint.ndim)))
    return (1 - game.gamma) * np.linalg.solve(np.eye(len(moves)) - game.gamma * moves.T, game.start)


def policy_gradient(game, policies, agent, q):
    """[O_i, A_i], with respect to the agent's logits: 1 / (1 - gamma) E[grad log pi_i(a_i | o_i) Q(s, a)], eq. (22)."""
    shares = state_distribution(game, policies).reshape(-1, *[1] * len(policies)) * joint_policy(game, policies)
    others = tuple(1 + other for other in range(len(policies)) if other != agent)
    of_action = (shares * q).sum(others)
    scored = of_action - policies[agent][game.observations[agent]] * of_action.sum(-1, keepdims=True)
    gradient = np.zeros(policies[agent].shape)
    np.add.at(gradient, game.observations[agent], scored)
    return gradient / (1 - game.gamma)


def derivative(function, logits, agent):
    """The gradient of a real function of all agents' logits in one agent's, exact: by imaginary steps of 1e-30."""
    gradient = np.empty(logits[agent].shape)
    for index in np.ndindex(*gradient.shape):
        stepped = [table.astype(complex) for table in logits]
        stepped[agent][index] += 1e-30j
        gradient[index] = function(stepped).imag / 1e-30
    return gradient


def all_episodes(game, policies, steps):
    """Every course of that many steps: states [T, W], actions [T, W, N], probabilities [W]."""
    shape = game.rewards.shape
    courses = np.indices(shape * steps).reshape(steps, len(shape), -1)
    joint = joint_policy(game, policies)
    probabilities = game.start[courses[0, 0]] * np.prod([joint[tuple(course)] for course in courses], axis=0)
    for course, following in zip(courses, courses[1:]):
        probabilities = probabilities * game.transitions[(*course, following[0])]
    return courses[:, 0], courses[:, 1:].swapaxes(1, 2), probabilities


def near(actual, desired, tolerance=1e-10):
    np.testing.assert_allclose(actual, desired, rtol=0, atol=tolerance)
