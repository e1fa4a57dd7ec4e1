"""Corollary A.7: what one agent learns by the biased gradient, the others' policies fixed, and the bound on it."""

from __future__ import annotations

from itertools import product

import numpy as np

from tests import tabular
from tests.tabular import near


def agents_task(game, policies):
    """The first agent's own MDP: rewards [S, A], transitions [S, A, S]."""
    others = policies[1][game.observations[1]]
    return np.einsum('sb,sab->sa', others, game.rewards), np.einsum('sb,sabt->sat', others, game.transitions)


def q_and_v(rewards, transitions, policy, gamma):
    """Q [..., S, A] and V [..., S] of many tasks at once; gamma: [...]."""
    moves = np.einsum('...sa,...sat->...st', policy, transitions)
    system = np.eye(moves.shape[-1]) - gamma[..., None, None] * moves
    v = np.linalg.solve(system, (policy * rewards).sum(-1)[..., None])
    return rewards + gamma[..., None, None] * (transitions @ v[..., None, :, :])[..., 0], v[..., 0]


def visits(transitions, policy, gamma, start):
    """d [..., S]."""
    moves = np.einsum('...sa,...sat->...ts', policy, transitions)
    system = np.eye(moves.shape[-1]) - gamma[..., None, None] * moves
    return (1 - gamma[..., None]) * np.linalg.solve(system, np.broadcast_to(start, system.shape[:-1])[..., None])[..., 0]


def learned(rewards, transitions, gamma, beta, weight, entropy, logits):
    """Ascends eq. (30) plus the entropy's gradient, as in (35), until (31) holds in every task.

    The advantage is that of Q - weight * sum over t >= 1 of (beta gamma)^t E[r_t]: eq. (39) at weight 1, eq. (17) at beta.
    """
    states, actions = rewards.shape[-2:]
    for _ in range(5000):
        policy = tabular.softmax(logits)
        q, _ = q_and_v(rewards, transitions, policy, gamma)
        short, _ = q_and_v(rewards, transitions, policy, beta * gamma)
        biased = q - weight[:, None, None] * (short - rewards)
        advantage = biased - (policy * biased).sum(-1, keepdims=True)
        share = visits(transitions, policy, gamma, np.full(states, 1 / states)) / (1 - gamma[:, None])
        gradient = share[..., None] * policy * advantage + (entropy / states)[:, None, None] * (1 / actions - policy)
        if (np.linalg.norm(gradient, axis=(-2, -1)) <= entropy / (2 * states * actions)).all():
            return policy
        logits = logits + 5 * (1 - gamma[:, None, None]) * gradient
    raise AssertionError('no stationary point')


def extremes(rewards, transitions, gamma):
    """The best deterministic policy [B, S, A], its V and the worst V there is [B, S], by trying all."""
    states, actions = rewards.shape[-2:]
    tried = [np.eye(actions)[list(choice)] for choice in product(range(actions), repeat=states)]
    reached = np.array([q_and_v(rewards, transitions, np.broadcast_to(policy, rewards.shape), gamma)[1] for policy in tried])
    best = reached.sum(-1).argmax(0)
    return np.array(tried)[best], reached.max(0), reached.min(0)


def bounds(rewards, transitions, gamma, entropy, bias_term):
    """The right side of eq. (38) [B, S] for mu' in each single state and mu uniform, and the worst V."""
    states = rewards.shape[-2]
    best, optimal, worst = extremes(rewards, transitions, gamma)
    ratios = np.stack([states * visits(transitions, best, gamma, start).max(-1) for start in np.eye(states)], axis=-1)
    return optimal - 2 / (1 - gamma[:, None]) * (entropy[:, None] * ratios + bias_term[:, None]), worst


def random_tasks(seeds=4):
    """One row for each of seeds x gamma x beta x lambda x the two readings of eq. (39), from random games."""
    rows = list(product(range(seeds), (0.3, 0.6, 0.9), (0.0, 0.1, 0.3, 1.0), (0.01, 0.05), (False, True)))
    tasks = []
    for seed, *_ in rows:
        random = np.random.default_rng(seed)
        game = tabular.random_game(random, states=3)
        logits = tabular.random_logits(random, game)
        tasks.append((*agents_task(game, [tabular.softmax(table) for table in logits]), random.normal(size=(3, 2))))
    rewards, transitions, logits = map(np.array, zip(*tasks))
    _, gamma, beta, entropy, as_written = map(np.array, zip(*rows))
    return rewards, transitions, logits, gamma, beta, entropy, np.where(as_written, 1, beta)


def test_corollary_a_7_holds_and_says_something_for_small_beta_gamma_only():
    """A bound is vacuous where even the worst policy of the task meets it: about two thirds of these rows.

    Eq. (38) is vacuous wherever beta gamma > 1/3, for its last term alone is then more than the largest V, 1 / (1 - gamma).
    Half that term would do: E[r_t | s, a] and its mean over a both lie in [0, 1], so they differ by 1 at most, not by 2.
    """
    rewards, transitions, logits, gamma, beta, entropy, weight = random_tasks()
    policy = learned(rewards, transitions, gamma, beta, weight, entropy, logits)
    reached = q_and_v(rewards, transitions, policy, gamma)[1]
    bias_term = beta * gamma / (1 - beta * gamma)
    bound, worst = bounds(rewards, transitions, gamma, entropy, bias_term)
    sharper, _ = bounds(rewards, transitions, gamma, entropy, bias_term / 2)
    assert (reached >= bound).all() and (reached >= sharper).all()
    says_something = bound > worst
    assert 0.25 < says_something.mean() < 0.5
    assert says_something[(beta > 0)].mean() > 0.1
    assert not says_something[beta * gamma > 1 / 3].any()


def test_agents_that_learn_the_opposite_break_the_bound():
    rewards, transitions, logits, gamma, beta, entropy, weight = random_tasks(seeds=1)
    policy = learned(1 - rewards, transitions, gamma, beta, weight, entropy, logits)
    reached = q_and_v(rewards, transitions, policy, gamma)[1]
    bound, worst = bounds(rewards, transitions, gamma, entropy, beta * gamma / (1 - beta * gamma))
    assert (reached < bound)[bound > worst].mean() > 0.5


def test_the_bound_needs_its_last_term_at_beta_1_an_agent_takes_a_little_now_for_a_lot_later():
    # In state 0, action 0 pays 0.1 and leads to state 1, which pays nothing; action 1 leads to state 2, which pays 1.
    rewards = np.array([[[0.1, 0], [0, 0], [1, 1]]] * 2)
    transitions = np.array([[np.eye(3)[[1, 2]], np.eye(3)[[1, 1]], np.eye(3)[[2, 2]]]] * 2)
    gamma, beta, entropy = np.full(2, 0.6), np.array([0.0, 1.0]), np.full(2, 0.01)
    policy = learned(rewards, transitions, gamma, beta, beta, entropy, np.zeros(rewards.shape))
    reached = q_and_v(rewards, transitions, policy, gamma)[1]
    without, _ = bounds(rewards, transitions, gamma, entropy, np.zeros(2))
    assert (reached[0] >= without[0]).all()
    assert reached[1, 0] < without[1, 0]


def test_the_batched_ascent_has_the_gradient_of_the_enumerated_game():
    random = np.random.default_rng(3)
    game = tabular.random_game(random, states=3)
    game = game._replace(observations=np.array([np.arange(3), game.observations[1]]), start=np.full(3, 1 / 3))
    policies = [tabular.softmax(logits) for logits in tabular.random_logits(random, game)]
    rewards, transitions = (table[None] for table in agents_task(game, policies))
    gamma = np.array([game.gamma])
    q, v = q_and_v(rewards, transitions, policies[0][None], gamma)
    near(v[0], tabular.values(game, policies))
    near(visits(transitions, policies[0][None], gamma, game.start)[0], tabular.state_distribution(game, policies))
    short, _ = q_and_v(rewards, transitions, policies[0][None], 0.7 * gamma)
    biased = (q - 0.7 * (short - rewards))[0]
    near(tabular.policy_gradient(game, policies, 0, biased[:, :, None]),
         tabular.policy_gradient(game, policies, 0, tabular.beta_q(game, policies, 0.7, 0)))
