"""Teams whose members leave, and actions that cannot be chosen: nobody waits for them and nothing is learnt from them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dae_ros import draws
from dae_ros.errors import Refused
from dae_ros.learning import advantages
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.types import Action, JointState, Observation, SharedReward
from tests.learners import COMA, LEARNER, REWARD, SHARED_TRUNK, SPEC, assert_same_bits, parameters, random_trajectory, state_of
from tests.played import POLICY, REQUEST, RUN, VERSION, A, Drifting, N, W, assert_same, play, refused, stamped

LONG = REQUEST._replace(num_steps=24)


class Thinning(Drifting):
    """Worlds that robot 1 leaves at times, and where some actions cannot be chosen."""

    def reset(self, seed, rollout):
        self._here = np.ones((W, N), bool)
        return super().reset(seed, rollout)

    def step(self, actions):
        assert np.take_along_axis(self._available(), actions[..., None], -1).all()
        drawn = draws.generator(self._name[0], 'leaves', self._name[1], self._step).random(W)
        self._here[:, 1] &= drawn > 0.4
        transition = super().step(actions)
        ended = transition.terminated | transition.truncated
        return transition._replace(won=transition.terminated & (drawn > 0.7)) if ended.any() else transition

    def _available(self):
        available = (np.arange(A) + self._step + np.arange(N)[:, None]) % 3 > 0
        return np.where(self._here[..., None], available, np.arange(A) == 0)

    def _show(self, episode_start):
        self._here[episode_start] = True
        return super()._show(episode_start)._replace(available=self._available(), present=self._here.copy())


DATA = play(LONG, Thinning)
TRAJECTORY = InProcessCollector(Thinning()).collect(LONG, POLICY)


def test_the_rollout_these_tests_play_has_members_that_leave_in_one_world_in_all_and_come_back():
    absent = ~TRAJECTORY.present[:, :, 1]
    everywhere = absent.all(axis=1)
    assert (absent.any(axis=1) & ~everywhere).any() and everywhere.any() and not everywhere[np.argmax(everywhere):].all()
    assert TRAJECTORY.present[:, :, 0].all() and TRAJECTORY.won.any() and not TRAJECTORY.available.all()


def test_who_has_left_everywhere_is_asked_nothing_and_counts_as_doing_nothing():
    asked = {(datum.stamp.step, datum.robot) for datum in DATA if isinstance(datum, Observation)}
    for step, robot in np.ndindex(LONG.num_steps, N):
        assert ((step, robot) in asked) == TRAJECTORY.present[step, :, robot].any()
    absent = ~TRAJECTORY.present
    assert (TRAJECTORY.actions[absent] == 0).all()
    np.testing.assert_array_equal(TRAJECTORY.probabilities[absent], np.tile(np.eye(A, dtype=np.float32)[0], (absent.sum(), 1)))


def test_what_cannot_be_chosen_has_probability_0_and_the_rest_sums_to_1():
    assert not TRAJECTORY.probabilities[~TRAJECTORY.available].any()
    assert (TRAJECTORY.probabilities[TRAJECTORY.available] > 0).all()
    np.testing.assert_allclose(TRAJECTORY.probabilities.sum(-1), 1, atol=1e-6)


def test_the_order_of_messages_does_not_matter_and_an_answer_nobody_waits_for_changes_nothing():
    random = np.random.default_rng(1)
    for _ in range(20):
        assembler = Assembler(Thinning.spec, W)
        assembler.begin(LONG)
        for index in random.permutation(len(DATA)):
            datum = DATA[index]
            if isinstance(datum, JointState):
                assembler.on_joint_state(datum)
            elif isinstance(datum, SharedReward):
                assembler.on_reward(datum)
            elif isinstance(datum, Action):
                assembler.on_action(datum)
        assert assembler.complete, assembler.missing()
        assert_same(assembler.trajectory(), TRAJECTORY)


def test_an_agent_that_missed_a_step_at_which_it_was_present_does_not_go_on():
    agent = AgentEnd(0)
    agent.on_request(LONG)
    agent.on_policy(RUN, VERSION, POLICY)
    observations = [datum for datum in DATA if isinstance(datum, Observation) and datum.robot == 0]
    agent.on_observation(observations[0])
    later = next(datum for datum in observations[2:] if not datum.episode_start.all())
    refused(Refused.UNEXPECTED, agent.on_observation, later)


@pytest.mark.parametrize('probabilities', [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5]])
def test_a_world_refuses_an_action_that_is_not_available(probabilities):
    world = WorldEnd(Thinning())
    world.on_request(LONG)
    unavailable = ~TRAJECTORY.available[0, 0, 0]
    honest = next(datum for datum in DATA if isinstance(datum, Action) and datum.robot == 0)
    forged = honest._replace(probabilities=np.tile(np.float32(probabilities), (W, 1)), actions=np.ones(W, np.uint16))
    assert unavailable.tolist() == [True, False, False]
    if probabilities[0]:
        refused(Refused.OUT_OF_RANGE, world.on_action, forged)
    else:
        world.on_action(forged)


def test_flags_that_leave_a_robot_nothing_to_do_and_flags_of_other_sizes_are_refused():
    joint = next(datum for datum in DATA if isinstance(datum, JointState))
    observation = next(datum for datum in DATA if isinstance(datum, Observation))
    reward = next(datum for datum in DATA if isinstance(datum, SharedReward))
    assembler, agent = Assembler(Thinning.spec, W), AgentEnd(observation.robot)
    assembler.begin(LONG)
    agent.on_request(LONG)
    agent.on_policy(RUN, VERSION, POLICY)
    refused(Refused.OUT_OF_RANGE, assembler.on_joint_state, joint._replace(available=np.zeros_like(joint.available)))
    refused(Refused.OUT_OF_RANGE, agent.on_observation, observation._replace(available=np.zeros_like(observation.available)))
    refused(Refused.WRONG_SHAPE, assembler.on_joint_state, joint._replace(available=joint.available[..., 1:]))
    refused(Refused.WRONG_SHAPE, assembler.on_joint_state, joint._replace(present=joint.present[1:]))
    refused(Refused.WRONG_SHAPE, assembler.on_reward, reward._replace(won=np.ones(W + 1, bool)))
    refused(Refused.WRONG_SHAPE, agent.on_observation, observation._replace(available=np.ones((W, A + 1), bool)))
    refused(Refused.STALE, assembler.on_joint_state, stamped(joint, attempt=0))
    assembler.on_joint_state(joint)
    assert agent.on_observation(observation) is not None


# Learning.


def thinned_trajectory(seed=0):
    """A rollout of noise in which agents leave, each until its episode ends, and many actions cannot be chosen."""
    random, trajectory = np.random.default_rng(seed), random_trajectory(seed=seed)
    present = random.random(trajectory.actions.shape) < 0.8
    present[..., 0] = True
    for before, now, starts in zip(present, present[1:], trajectory.episode_start[1:]):
        now &= before | starts[:, None]
    available = random.random(trajectory.probabilities.shape) < 0.7
    actions = np.where(present, trajectory.actions, 0)
    np.put_along_axis(available, actions[..., None], True, -1)
    available[~present] = np.eye(SPEC.num_actions, dtype=bool)[0]
    probabilities = np.where(available, trajectory.probabilities, 0)
    probabilities /= probabilities.sum(-1, keepdims=True)
    return trajectory._replace(actions=actions, probabilities=probabilities, available=available, present=present)


@pytest.mark.parametrize('learner, reward', [(LEARNER, REWARD), (LEARNER, SHARED_TRUNK), (replace(LEARNER, beta=0.0), REWARD),
                                             (COMA, REWARD), (replace(COMA, estimator='coma_nstep', coma_steps=3), REWARD)],
                         ids=['dae', 'shared trunk', 'gae', 'coma', 'n-step coma'])
def test_what_agents_that_have_left_observe_changes_no_bit_of_an_update(make_learner, learner, reward):
    trajectory = thinned_trajectory()
    assert 0.1 < 1 - trajectory.present.mean() < 0.9
    noise = np.random.default_rng(9).normal(size=trajectory.observations.shape).astype(np.float32)
    disturbed = trajectory._replace(observations=np.where(trajectory.present[..., None], trajectory.observations, noise))
    after = []
    for rollout in (trajectory, disturbed):
        made = make_learner(learner, reward)
        made.update(rollout, 0)
        after.append(state_of(made))
    assert all(np.isfinite(values).all() for values in after[0].values())
    assert_same_bits(*after)


def test_the_reward_that_agents_that_have_left_expect_is_the_one_that_came(make_learner):
    trajectory = thinned_trajectory()
    expected = make_learner().expected_rewards(trajectory)
    rewards = np.broadcast_to(trajectory.rewards[..., None], expected.shape)
    np.testing.assert_array_equal(expected[~trajectory.present], rewards[~trajectory.present])
    assert (expected[trajectory.present] != rewards[trajectory.present]).all()


def test_means_and_deviations_are_of_those_present():
    numbers = torch.tensor([[[1.0, 100.0, 3.0]], [[5.0, 2.0, -100.0]]])
    present = torch.tensor([[[True, False, True]], [[True, True, False]]])
    assert advantages.mean_over_agents(numbers, present).flatten().tolist() == [2.0, 3.5]
    normal = advantages.normalized(numbers, present)[present]
    assert float(normal.mean()) == pytest.approx(0, abs=1e-6) and float(normal.std(correction=0)) == pytest.approx(1, abs=1e-4)
    assert advantages.mean_over_agents(numbers, torch.zeros_like(present)).flatten().tolist() == [0.0, 0.0]


def test_masks_that_mask_nothing_change_an_update_by_rounding_at_most(make_learner):
    trajectory, after = random_trajectory(), []
    everything = np.ones(trajectory.probabilities.shape, bool)
    for rollout in (trajectory, trajectory._replace(available=everything, present=everything[..., 0])):
        made = make_learner()
        made.update(rollout, 0)
        after.append(parameters(state_of(made), 'actor'))
    for name, values in after[0].items():
        np.testing.assert_allclose(values, after[1][name], atol=1e-6, err_msg=name)


# Values of each agent's own state.

OWN = SPEC._replace(state_size=3 * 7, states_per_agent=True)
PLAIN_MAPPO = replace(LEARNER, beta=0.0)


def updated(make_learner, spec, data, settings=PLAIN_MAPPO):
    """The state of a learner after one update."""
    learner = make_learner(settings, spec=spec)
    metrics = learner.update(data, 0)
    return state_of(learner), metrics


def with_own_states(data, change=lambda states: states):
    """The rollout with a copy of the state for each agent, changed [..., N, S]."""
    copies = [change(np.repeat(states[..., None, :], 3, axis=-2)) for states in (data.states, data.final_states)]
    return data._replace(states=copies[0].reshape(*data.states.shape[:2], -1), final_states=copies[1].reshape(-1, 3 * 7))


def test_agents_that_all_have_the_teams_state_are_valued_as_the_team_is(make_learner):
    data = random_trajectory(steps=12)
    team, team_metrics = updated(make_learner, SPEC, data)
    own, own_metrics = updated(make_learner, OWN, with_own_states(data))
    assert own.keys() == team.keys() and own_metrics.keys() == team_metrics.keys()
    for name in team:
        np.testing.assert_allclose(own[name], team[name], rtol=1e-3, atol=1e-5, err_msg=name)


@pytest.mark.parametrize('beta', [0.0, 0.9])
def test_an_agents_advantages_depend_on_its_own_state_and_not_on_that_of_another(beta, make_learner):
    def estimated(data):
        learner = make_learner(replace(LEARNER, beta=beta), spec=OWN)
        return learner._estimator.estimate(learner._tensors(data), 0).advantages.numpy().copy()

    def other(states):
        states = states.copy()
        states[..., 2, :] += 1.0
        return states

    data = random_trajectory(steps=12)
    before, after = estimated(with_own_states(data)), estimated(with_own_states(data, other))
    assert not np.array_equal(before[..., 2], after[..., 2])
    if beta == 0:  # with credit, the reward network sees the states of all
        np.testing.assert_array_equal(before[..., :2], after[..., :2])


def test_what_is_said_of_the_own_state_of_one_who_has_left_changes_no_weight(make_learner):
    data = random_trajectory(steps=12)
    present = np.ones(data.actions.shape, bool)
    left = np.zeros(len(data.states) - 1, bool)
    left[5:] = True
    ended = np.cumsum(data.episode_start[:-1], axis=0)
    present[..., 1] = ~(left[:, None] & (ended == ended[5]))
    data = data._replace(present=present)
    gone = np.concatenate([~present[..., 1], np.zeros((1, present.shape[1]), bool)])

    def perturbed(states):
        states = states.copy()
        if states.shape[:2] == gone.shape:
            states[gone, 1] += 7.0
        return states

    assert gone.any()
    quiet, loud = (updated(make_learner, OWN, with_own_states(data, change))[0]
                   for change in (lambda states: states, perturbed))
    assert_same_bits(quiet, loud)
