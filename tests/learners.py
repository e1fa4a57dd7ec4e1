"""Settings of small learners, rollouts of noise for them, and what they have learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.types import Trajectory, WorldSpec

SPEC = WorldSpec(num_agents=3, num_actions=4, observation_size=5, state_size=7, state_is_observations=False)
LEARNER = LearnerSettings(hidden_size=8, epochs=2, beta=0.9, learner_threads=1)
REWARD = RewardNetworkSettings('per_agent', hidden_size=12, trunk_size=10, epochs=2)
SHARED_TRUNK = replace(REWARD, architecture='shared_trunk')
COMA = replace(LEARNER, estimator='coma')
REPLAY = replace(REWARD, replay_rollouts=2, replay_steps=5, replay_chunks=3)
REWARDS = pytest.mark.parametrize('reward_settings', [REWARD, SHARED_TRUNK], ids=['per agent', 'shared trunk'])

# Adam's first step is learning_rate * g / (|g| + epsilon): with an epsilon of 1 the weights show the gradient itself.
PLAIN = replace(LEARNER, epochs=1, adam_epsilon=1.0, learning_rate=1.0)
PLAIN_REWARD = replace(REWARD, epochs=1, learning_rate=1.0)


def random_trajectory(steps=7, worlds=3, spec=SPEC, seed=0, terminations=0.15, truncations=0.15):
    """A rollout of noise, with episodes that end for good and others that are cut off in its middle."""
    random = np.random.default_rng(seed)
    T, W, (N, A, O, S, *_) = steps, worlds, spec
    terminated = random.random((T, W)) < terminations
    truncated = ~terminated & (random.random((T, W)) < truncations)
    probabilities = random.dirichlet(np.ones(A), (T, W, N)).astype(np.float32)
    actions = (probabilities.cumsum(-1) < random.random((T, W, N, 1))).sum(-1).clip(max=A - 1)
    return Trajectory(
        observations=random.normal(size=(T, W, N, O)).astype(np.float32),
        states=random.normal(size=(T + 1, W, S)).astype(np.float32),
        episode_start=np.concatenate([np.ones((1, W), bool), terminated | truncated]),
        actions=actions.astype(np.int64), probabilities=probabilities,
        rewards=random.normal(-1, 2, (T, W)).astype(np.float32), terminated=terminated, truncated=truncated,
        final_states=random.normal(size=(int(truncated.sum()), S)).astype(np.float32))


def state_of(learner):
    """A copy of all that the learner learnt."""
    return {name: tensor.copy() for name, tensor in learner.state().items()}


def assert_same_bits(one, other):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


def parameters(state, network):
    prefix = f'{network}.parameters.'
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def same_weights(one, other, network):
    one, other = parameters(one, network), parameters(other, network)
    return bool(one) and all(np.array_equal(one[name], other[name]) for name in one)
