"""Learning from robots that act at their own rate: what they did is joined by the clock's stamps, and holes are not guessed."""

import numpy as np
import pytest

from dae_ros import config
from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.robots.acting import ActingEnd
from dae_ros.robots.bodies import Bodies
from dae_ros.robots.geometry import Pose, TaskFrame
from dae_ros.robots.motion import Limits, Motion
from dae_ros.robots.pilot import Pilot, stamp_at
from dae_ros.robots.safety import Bounds, Safety
from dae_ros.robots.task_monitor import TaskMonitor
from dae_ros.robots.watch import Watch
from dae_ros.rollout.streaming import StreamAssembler
from dae_ros.types import JointState, SharedReward

RUN, STEPS, EPISODES, PERIOD = 9, 5, 2, 0.1
TASK = config.from_flat({'num_agents': 2, 'episode_steps': STEPS, 'num_worlds': 1}).task
LIMITS, BOUNDS = Limits(2.0, 5.0, 3.0, 10.0), Bounds(0.15, 1.0, 0.25, 10.0, 5.0)


def policy():
    architecture = PolicyArchitecture(12, 5, 8, 1, 'tanh')
    draw = np.random.default_rng(0)
    return Policy(architecture, {name: draw.standard_normal(shape).astype(np.float32)
                                 for name, shape in architecture.shapes().items()})


class Team:
    """Two simulated robots with their bridges and agents, who watches them, and the trainer's end, without ROS."""

    def __init__(self, max_staleness=1, go_on=False):
        spec = TaskMonitor(TASK).spec
        self.bodies = Bodies(TASK, TaskFrame(), LIMITS, False, seed=1)
        self.pilots = [Pilot(robot, RUN, TaskMonitor(TASK), Motion(False, LIMITS, TaskFrame()), TaskFrame(), PERIOD,
                             Safety(robot, 2, BOUNDS, enabled=True, go_on=go_on)) for robot in range(2)]
        self.agents = [ActingEnd(robot, False, 1, RUN) for robot in range(2)]
        self.watch = Watch(RUN, TaskMonitor(TASK), TaskFrame(), PERIOD, BOUNDS, go_on)
        self.assembler = StreamAssembler(spec, EPISODES, STEPS, RUN, max_staleness)
        self.assembler.begin(0)
        for agent in self.agents:
            agent.on_policy(RUN, 0, policy())
        for one in (*self.pilots, self.watch):
            one.on_landmarks(self.bodies.landmarks)
        self.now, self.log = 100.1, []  # in the middle of an episode

    def tick(self, lost=lambda datum: False, silent=()):
        """Half a control period; data for which `lost` holds never arrive, and no odometry of robots that are `silent`."""
        self.now = round(self.now + PERIOD / 2, 6)
        self.bodies.move(self.now, PERIOD / 2)
        for robot in {0, 1}.difference(silent):
            pose = self.bodies.pose(robot, self.now)
            for track in (self.watch.tracks[robot], *(pilot._safety.tracks[robot] for pilot in self.pilots)):
                track.take(pose, self.now)
        for pilot, agent in zip(self.pilots, self.agents):
            observation = pilot.look(self.now).observation
            if observation is not None:
                action = agent.on_observation(observation)
                self.bodies.obey(observation.robot, pilot.on_action(action), self.now)
                self.send(observation, self.assembler.on_observation, lost)
                self.send(action, self.assembler.on_action, lost)
        for seen in self.watch.look(self.now):
            self.send(seen, self.assembler.on_joint_state if isinstance(seen, JointState) else self.assembler.on_reward, lost)

    def send(self, datum, take, lost):
        self.log.append(datum)
        if not lost(datum):
            take(datum)

    def run(self, episodes, lost=lambda datum: False):
        for _ in range(2 * STEPS * episodes):
            self.tick(lost)

    def said(self, kind, episode):
        return [datum for datum in self.log if isinstance(datum, kind) and datum.stamp.rollout == episode]


FIRST = stamp_at(100.0, PERIOD, STEPS, RUN).rollout


def test_whole_episodes_become_a_trajectory_of_what_each_robot_saw_and_did():
    team = Team()
    team.run(4)
    trajectory = team.assembler.trajectory()
    assert trajectory.observations.shape == (STEPS, EPISODES, 2, 12) and trajectory.rewards.shape == (STEPS, EPISODES)
    assert trajectory.terminated[-1].all() and not trajectory.terminated[:-1].any() and not trajectory.truncated.any()
    assert trajectory.episode_start[0].all() and not trajectory.episode_start[1:-1].any()
    for world, episode in enumerate((FIRST + 1, FIRST + 2)):  # the first began before the team did
        by_place = {(datum.stamp.step, datum.robot): datum for datum in team.log
                    if hasattr(datum, 'probabilities') and datum.stamp.rollout == episode}
        for (step, robot), action in by_place.items():
            assert trajectory.actions[step, world, robot] == action.actions[0]
            np.testing.assert_array_equal(trajectory.probabilities[step, world, robot], action.probabilities[0])
        seen = {(datum.stamp.step, datum.robot): datum.values[0] for datum in team.log
                if hasattr(datum, 'values') and datum.stamp.rollout == episode}
        for (step, robot), values in seen.items():
            np.testing.assert_array_equal(trajectory.observations[step, world, robot], values)
        rewards = [shared.reward[0] for shared in team.said(SharedReward, episode)]
        np.testing.assert_array_equal(trajectory.rewards[:, world], rewards)
        assert len(by_place) == len(seen) == 2 * STEPS


def test_an_episode_with_a_hole_is_dropped_and_counted_and_the_others_stay():
    for kind in ('probabilities', 'values', 'state', 'reward'):
        team = Team()
        team.run(5, lambda datum: hasattr(datum, kind) and datum.stamp[1::2] == (FIRST + 2, 3))
        assert team.assembler.complete and team.assembler.holed == 2  # and the first, which had no beginning
        trajectory = team.assembler.trajectory()
        wanted = [team.said(SharedReward, episode)[0].reward[0] for episode in (FIRST + 1, FIRST + 3)]
        np.testing.assert_array_equal(trajectory.rewards[0], wanted)


def test_a_reward_is_what_the_team_had_reached_when_the_next_step_began_also_when_everybody_is_put_elsewhere_then():
    monitor, watch = TaskMonitor(TASK), Watch(RUN, TaskMonitor(TASK), TaskFrame(), PERIOD, BOUNDS)
    landmarks = np.array([[0.5, 0.0], [0.0, 0.5]])
    watch.on_landmarks(landmarks)
    rewards, reached = [], []
    for half_step in range(2 * STEPS + 1):
        now = 100.0 + PERIOD / 2 * half_step
        places = np.array([[0.02 * half_step, 0.0], [0.0, -0.03 * half_step]]) + (5.0 if half_step == 2 * STEPS else 0.0)
        for track, place in zip(watch.tracks, places):
            track.take(Pose(tuple(place), 0.0, (0.0, 0.0), now), now)
        rewards += [datum for datum in watch.look(now) if isinstance(datum, SharedReward)]
        reached.append(monitor.see(places, np.zeros((2, 2)), landmarks).reward)
    wanted = [reached[2 * step] for step in range(1, STEPS)] + [reached[2 * STEPS - 1]]
    np.testing.assert_allclose([shared.reward[0] for shared in rewards], wanted, rtol=1e-6)
    assert [shared.terminated[0] for shared in rewards] == [False] * (STEPS - 1) + [True]


def test_whoever_watches_says_nothing_while_somebodys_odometry_is_missing():
    watch = Watch(RUN, TaskMonitor(TASK), TaskFrame(), PERIOD, BOUNDS)
    assert watch.look(100.0) == [] and watch.blind_for(100.0) == 'the odometry of robot 0, 1'
    for track in watch.tracks:
        track.take(Pose((0.0, 0.0), 0.0, (0.0, 0.0), 100.0), 100.0)
    assert watch.blind_for(100.0) == 'the landmarks'
    watch.on_landmarks(np.zeros((2, 2)))
    assert len(watch.look(100.0)) == 1
    assert watch.look(100.3) == []


def test_what_was_acted_with_too_old_a_policy_is_refused_and_what_grew_too_old_is_dropped():
    team = Team(max_staleness=1)
    team.run(4)
    assert team.assembler.complete
    team.assembler.begin(1)
    assert team.assembler.complete and team.assembler.stale == 0
    team.assembler.begin(2)
    assert not team.assembler.complete and team.assembler.stale == 3
    with pytest.raises(Refused, match='wrong_version|stale'):
        team.run(1)


def test_mixed_policy_versions_are_fine_within_the_bound():
    team = Team(max_staleness=1)
    team.agents[1].on_policy(RUN, 1, policy())
    team.assembler.begin(1)
    team.run(4)
    versions = {datum.policy_version for datum in team.log if hasattr(datum, 'probabilities')}
    assert versions == {0, 1} and team.assembler.complete


def test_data_of_another_run_and_of_episodes_long_gone_are_refused():
    team = Team()
    team.run(5)
    old = next(datum for datum in team.log if isinstance(datum, SharedReward))
    for wrong, reason in ((old, Refused.STALE), (old._replace(stamp=old.stamp._replace(run=4)), Refused.WRONG_RUN)):
        with pytest.raises(Refused) as refused:
            team.assembler.on_reward(wrong)
        assert refused.value.reason == reason
