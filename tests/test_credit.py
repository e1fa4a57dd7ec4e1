"""Who earns what: the difference rewards of the learner and of a reward-network file, step by step."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dae_ros import config
from dae_ros.errors import Refused, SettingsError
from dae_ros.learning.advantages import credit_baselines
from dae_ros.learning.credit import CreditMeter
from dae_ros.learning.learner import Learner
from dae_ros.learning.networks import make_reward_network
from dae_ros.learning.reward_files import encode, load, read
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.types import Action, JointState, RolloutRequest, SharedReward, Stamp
from dae_ros.worlds import make_worlds

VALUES = {'num_agents': 3, 'num_worlds': 4, 'num_steps': 12, 'episode_steps': 6, 'epochs': 1, 'hidden_size': 16,
          'reward_network.epochs': 1, 'reward_network.hidden_size': 16, 'reward_network.trunk_size': 12}
NETWORKS = [{'reward_network.architecture': 'per_agent'}, {'reward_network.architecture': 'shared_trunk'},
            {'reward_network.recurrent': False, 'reward_network.ensemble_size': 2}]
WORLD = 2


def network_file(path, values):
    """Reward networks in a file, and the settings and sizes they are for."""
    settings = config.from_flat({**VALUES, **values, 'reward_network.path': str(path)})
    spec, reward = make_worlds(settings.task).spec, settings.reward_network
    path.write_bytes(encode([make_reward_network(spec, reward, 5, member) for member in range(reward.ensemble_size)], spec,
                            reward))
    return settings, spec


def some_rollout(settings, learner):
    request = RolloutRequest(7, 0, 0, 0, 1, settings.run.num_steps, False)
    return InProcessCollector(make_worlds(settings.task)).collect(request, learner.policy)


def said(trajectory):
    """What a team says of each step of a rollout: a stamp, the state, the reward, and everybody's action."""
    for step in range(len(trajectory.rewards)):
        stamp = Stamp(7, 0, 0, step)
        joint = JointState(stamp, trajectory.episode_start[step], trajectory.observations[step], trajectory.states[step])
        flags = trajectory.terminated[step], trajectory.truncated[step]
        reward = SharedReward(stamp, trajectory.rewards[step], *flags, np.empty((0, trajectory.states.shape[2]), np.float32))
        yield stamp, joint, reward, [Action(stamp, robot, 0, trajectory.actions[step, :, robot].astype(np.uint16),
                                            trajectory.probabilities[step, :, robot]) for robot in range(3)]


@pytest.mark.parametrize('values', NETWORKS, ids=['per agent', 'shared trunk', 'no memory, two'])
def test_a_file_of_reward_networks_tells_step_by_step_what_the_learner_says_of_the_whole_rollout(values, tmp_path):
    settings, spec = network_file(tmp_path / 'networks', values)
    learner = Learner(spec, settings.learner, settings.reward_network, 1)
    learner.begin_with(read(spec, settings.reward_network))
    trajectory = some_rollout(settings, learner)
    expected = trajectory.rewards[:, WORLD, None] - learner.expected_rewards(trajectory)[:, WORLD]
    learner.close()
    meter, told = CreditMeter(load(tmp_path / 'networks'), WORLD), []
    for _, joint, reward, actions in said(trajectory):
        assert meter.on_reward(reward) is None and all(meter.on_action(action) is None for action in actions)
        told.append(meter.on_joint_state(joint))
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(np.concatenate([credit.differences for credit in told]), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal([credit.rewards[0] for credit in told], trajectory.rewards[:, WORLD])
    assert all(credit.advantages is None for credit in told)


def test_after_a_hole_nothing_is_told_until_an_episode_begins(tmp_path):
    settings, spec = network_file(tmp_path / 'networks', NETWORKS[0])
    learner = Learner(spec, settings.learner, settings.reward_network, 1)
    trajectory = some_rollout(settings, learner)
    learner.close()
    meter, told = CreditMeter(load(tmp_path / 'networks'), WORLD), []
    for stamp, joint, reward, actions in said(trajectory):
        for action in actions if stamp.step != 2 else actions[1:]:
            meter.on_action(action)
        meter.on_joint_state(joint)
        told += [stamp.step] if meter.on_reward(reward) else []
    assert told == [0, 1, *range(6, 12)] and (meter.steps, meter.holes) == (8, 3)


def test_what_cannot_be_of_the_team_is_refused(tmp_path):
    settings, spec = network_file(tmp_path / 'networks', NETWORKS[0])
    learner = Learner(spec, settings.learner, settings.reward_network, 1)
    _, joint, reward, actions = next(said(some_rollout(settings, learner)))
    learner.close()
    meter = CreditMeter(load(tmp_path / 'networks'), WORLD)
    for take, datum in ((meter.on_joint_state, joint._replace(state=joint.state[:, 1:])),
                        (meter.on_joint_state, joint._replace(state=joint.state[:1])),
                        (meter.on_joint_state, joint._replace(state=np.full_like(joint.state, np.nan))),
                        (meter.on_reward, reward._replace(reward=np.full_like(reward.reward, np.inf))),
                        (meter.on_action, actions[0]._replace(robot=3)),
                        (meter.on_action, actions[0]._replace(probabilities=2 * actions[0].probabilities))):
        with pytest.raises(Refused):
            take(datum)


@pytest.mark.parametrize('values', [{}, {'beta': 0.0}], ids=['dae', 'beta 0'])
def test_a_training_keeps_the_credit_of_the_watched_world_and_its_weights_do_not_depend_on_it(values, tmp_path):
    settings = config.from_flat({**VALUES, **values, 'total_steps': 2 * 4 * 12, 'evaluation_episodes': 0})
    worlds = make_worlds(settings.task)
    weights = []
    for watching in (True, False):
        training = Training(settings, worlds.spec, RunFolder(tmp_path / str(watching), settings))
        collector = InProcessCollector(worlds)
        if watching:
            training.watch(WORLD)
        while not training.finished:
            trajectory = collector.collect(training.request(), training.policy)
            baselines = np.zeros((12, 3))  # what tells the robots' advantages apart
            if not values:
                expected = training.expected_rewards(trajectory)
                goes_on = torch.from_numpy(~trajectory.terminated[:, [WORLD]]).float()
                given = settings.learner.beta, settings.learner.gamma, settings.learner.gae_lambda
                baselines = credit_baselines(torch.from_numpy(expected[:, [WORLD]]), goes_on, *given)[:, 0].numpy()
            training.consume(trajectory)
            if not watching:
                assert training.credit is None
                continue
            np.testing.assert_array_equal(training.credit.rewards, trajectory.rewards[:, WORLD])
            team = training.credit.advantages[:, :1] + baselines[:, :1]
            np.testing.assert_allclose(training.credit.advantages, team - baselines, atol=1e-5)
            assert np.ptp(team) > 0.0
            if values:
                assert training.credit.differences is None
            else:
                differences = trajectory.rewards[..., None] - expected
                np.testing.assert_array_equal(training.credit.differences, differences[:, WORLD])
        training.close()
        weights.append(training.weights_sha256())
    assert weights[0] == weights[1]


def test_a_file_that_holds_something_else_is_named(tmp_path):
    (tmp_path / 'text').write_text('nothing')
    for path, sentence in ((tmp_path / 'nowhere', 'cannot read reward_network_file .*nowhere: No such file'),
                           (tmp_path / 'text', 'text is no file of train_reward')):
        with pytest.raises(SettingsError, match=sentence):
            load(path)
