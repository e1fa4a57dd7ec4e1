"""Members that leave a team of robots and come back: the others go on, and nothing is learnt from who is not there."""

import numpy as np
import pytest

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning.learner import Learner
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.rollout.streaming import StreamAssembler
from dae_ros.types import Action, JointState, Observation, SharedReward
from tests.learners import assert_same_bits, state_of
from tests.test_streaming import FIRST, RUN, STEPS, TASK, Team

HALVES = 2 * STEPS  # ticks of an episode
LEAVES, STILL_GONE, COMES_BACK, IS_BACK = range(FIRST + 1, FIRST + 5)  # what robot 1 does in these episodes


@pytest.fixture(scope='module')
def team():
    """Robot 1 falls silent in the middle of an episode and is heard of again in the middle of another."""
    team = Team(go_on=True)
    team.run(1)
    for _ in range(2):
        team.tick()
    team.left_at = team.bodies.pose(1, team.now).position
    for _ in range(2 * HALVES):
        team.tick(silent={1})
    team.run(3)
    return team


def said(team, kind, episode):
    return [datum for datum in team.log if isinstance(datum, kind) and datum.stamp.rollout == episode]


def test_a_team_goes_on_without_a_member_which_is_present_again_when_an_episode_begins(team):
    gone = {}
    for episode in range(LEAVES, IS_BACK + 1):
        joints = [joint for joint in said(team, JointState, episode) if joint.stamp.step < STEPS]
        present = np.array([[True, True] if joint.present is None else joint.present[0] for joint in joints])
        assert present[:, 0].all() and [joint.stamp.step for joint in joints] == list(range(STEPS))
        gone[episode] = np.flatnonzero(~present[:, 1]).tolist()
        assert sorted(action.stamp.step for action in said(team, Action, episode) if action.robot == 0) == list(range(STEPS))
    everything = list(range(STEPS))
    assert gone == {LEAVES: [4], STILL_GONE: everything, COMES_BACK: everything, IS_BACK: []}
    assert any(action.robot == 1 for action in said(team, Action, COMES_BACK))  # it drives, but an episode it began late
    assert team.assembler.left == 3 and team.assembler.holed == 1  # the first had no beginning


def test_who_is_heard_of_no_more_counts_as_standing_where_it_was_last(team):
    last = said(team, JointState, STILL_GONE)[-1]
    np.testing.assert_allclose(last.observations[0, 1, :4], [0.0, 0.0, *team.left_at], atol=1e-6)
    seen = [datum for datum in said(team, Observation, STILL_GONE) if datum.stamp.step == STEPS - 1]
    assert [datum.robot for datum in seen] == [0]
    np.testing.assert_allclose(seen[0].values[0, 8:10] + seen[0].values[0, 2:4], team.left_at, atol=1e-6)


def assemble(data, episodes):
    """The episodes in these data, as whoever learns has them."""
    assembler = StreamAssembler(TaskMonitor(TASK).spec, episodes, STEPS, RUN, max_staleness=1)
    takes = {Action: assembler.on_action, Observation: assembler.on_observation, JointState: assembler.on_joint_state,
             SharedReward: assembler.on_reward}
    for datum in data:
        takes[type(datum)](datum)
    return assembler


def test_what_an_absent_member_observes_and_does_changes_no_bit_of_an_update(team):
    data = [datum for datum in team.log if LEAVES <= datum.stamp.rollout <= IS_BACK]
    gone = {datum.stamp for datum in data if isinstance(datum, JointState) and datum.present is not None}
    draw, disturbed = np.random.default_rng(3), []
    for datum in data:
        if datum.stamp not in gone or getattr(datum, 'robot', 1) == 0:
            pass
        elif isinstance(datum, JointState):
            datum = datum._replace(observations=datum.observations.copy())
            datum.observations[0, 1] = draw.normal(size=datum.observations.shape[2])
        elif isinstance(datum, Observation):
            datum = datum._replace(values=draw.normal(size=datum.values.shape).astype(np.float32))
        elif isinstance(datum, Action):
            chosen, probabilities = draw.integers(5, size=1).astype(np.uint16), draw.dirichlet(np.ones(5), 1).astype(np.float32)
            datum = datum._replace(actions=chosen, probabilities=probabilities)
        disturbed.append(datum)
    trajectories = [assemble(one, 4).trajectory() for one in (data, disturbed)]
    assert (trajectories[0].observations != trajectories[1].observations).any()
    after = []
    for trajectory in trajectories:
        learner = Learner(TaskMonitor(TASK).spec, LearnerSettings(hidden_size=8, epochs=2, learner_threads=1),
                          RewardNetworkSettings(hidden_size=8, epochs=2), 1)
        learner.update(trajectory, 0)
        after.append(state_of(learner))
        learner.close()
    assert_same_bits(*after)
    assert all(np.isfinite(values).all() for values in after[0].values())


@pytest.mark.parametrize('missing, left_at', [(lambda step: step >= 3, 3), (lambda step: step == STEPS - 1, STEPS - 1),
                                              (lambda step: True, 0)])
def test_a_member_of_which_nothing_more_comes_has_left_though_its_odometry_goes_on(missing, left_at):
    team = Team()
    team.run(6, lambda datum: getattr(datum, 'robot', 0) == 1 and datum.stamp.rollout == LEAVES and missing(datum.stamp.step))
    assert team.assembler.left == 1 and team.assembler.holed == 1
    trajectory = team.assembler.trajectory()
    np.testing.assert_array_equal(trajectory.present[:, 0, 1], np.arange(STEPS) < left_at)
    assert trajectory.present[:, 0, 0].all() and trajectory.present[:, 1].all()
    assert not trajectory.actions[left_at:, 0, 1].any() and (trajectory.probabilities[left_at:, 0, 1, 0] == 1).all()


@pytest.mark.parametrize('lost_steps', [(), (2,)])
def test_a_member_that_begins_anew_in_the_middle_of_an_episode_is_back_with_the_next_one(lost_steps):
    team = Team()
    team.run(1)
    for _ in range(4 * HALVES):
        if team.pilots[1]._seen is not None and team.pilots[1]._seen[1::2] == (LEAVES, 2):
            team.pilots[1]._moving = False  # as a bridge that was just started
        team.tick(lambda datum: getattr(datum, 'robot', 0) == 1 and datum.stamp[1::2] in [(LEAVES, step) for step in lost_steps])
    assert team.assembler.left == 1
    gone = team.assembler.trajectory().present[:, :, 1]
    assert gone[:, 0].tolist() == [step < (lost_steps or (3,))[0] for step in range(STEPS)] and gone[:, 1].all()


def test_an_episode_in_which_nobody_is_left_is_dropped():
    team = Team()
    team.run(6, lambda datum: hasattr(datum, 'robot') and datum.stamp.rollout == LEAVES and datum.stamp.step >= 3)
    assert team.assembler.left == 0 and team.assembler.holed == 2
