"""A robot that drops out of a team and comes back, by real nodes: the others drive and learn on."""

from __future__ import annotations

import numpy as np
import pytest
from dae_ros_msgs import msg
from robots import Stage, is_standing

from dae_ros.ros import convert, names, qos
from dae_ros.ros.execution import streaming_graph

STEPS, LOST = 10, 3
PLACES = np.array([[0.0, 0.0], [0.9, -0.2], [-0.3, 0.8], [-0.9, -0.9], [0.8, 0.9]])
LANDMARKS = 0.5 * PLACES[::-1]
OTHERS = tuple(robot for robot in range(5) if robot != LOST)
EVERYBODY = range(5)
VALUES = {'num_agents': 5, 'episode_steps': STEPS, 'num_steps': STEPS, 'num_worlds': 2, 'total_steps': 10**6, 'epochs': 1,
          'hidden_size': 16, 'reward_network.epochs': 1, 'reward_network.hidden_size': 16, 'evaluation_greedy': False,
          'robots_per_process': 1}
ON_ROBOTS = {'real_time_factor': 2.0, 'drive': 'holonomic', 'on_lost_team_mate': 'go_on', 'max_staleness': 5}


@pytest.fixture
def graph(make_graph, tmp_path):
    """A team that learns in a stream, a process for each robot; the clock and the bodies are the test's."""
    graph = make_graph(tmp_path / 'run', VALUES)
    processes = streaming_graph(graph.settings, {**VALUES, **ON_ROBOTS}, graph.folder, simulate=True)
    graph.processes = {process.name: process for process in processes if process.name != 'world'}
    return graph


class Told:
    """What the trainer and who watches the team say."""

    def __init__(self, stage):
        self.version, self.absent = 0, None
        stage.node.create_subscription(msg.TrainingStatus, names.TRAINING_STATUS, self._on_status, qos.LATCHED_INPUT)
        stage.node.create_subscription(msg.JointState, names.JOINT_STATE, self._on_joint_state, qos.ROLLOUT)

    def _on_status(self, message):
        self.version = message.policy_version

    def _on_joint_state(self, message):
        joint = convert.joint_state(message)
        if joint.stamp.step < STEPS:
            self.absent = set() if joint.present is None else set(np.flatnonzero(~joint.present[0]).tolist())


def drive_on(stage, acting, shown, until):
    """Ticks in which all act who are acting, until that holds; at least two episodes."""
    ticks = 0
    while ticks < 2 * STEPS or not until():
        assert ticks < 60 * STEPS, dict(stage.diagnostics)
        stage.step(acting, *shown)
        ticks += 1


def test_four_of_five_robots_drive_and_learn_on_when_one_is_killed_and_it_is_taken_back(graph):
    with Stage(places=PLACES) as stage:
        told = Told(stage)
        graph.start(*graph.names)
        stage.wait_for_bridges(5, LANDMARKS)
        stage.tick_until(lambda: all(stage.actions[robot] for robot in EVERYBODY), *EVERYBODY)
        drive_on(stage, EVERYBODY, EVERYBODY, lambda: told.version >= 1)
        assert told.absent == set()

        while convert.action(stage.actions[0][-1]).stamp.step != STEPS // 2:  # in the middle of an episode
            stage.drive(0, *EVERYBODY)
        graph.kill(f'robots_{LOST}-{LOST}')
        version = told.version
        drive_on(stage, OTHERS, OTHERS, lambda: told.version >= version + 2)
        assert not any(is_standing(stage.commands[robot][-1]) for robot in OTHERS)
        assert told.absent == {LOST}
        seen = convert.observation(stage.observations[0][-1]).values[0]
        np.testing.assert_allclose(seen[14:22].reshape(4, 2)[LOST - 1], PLACES[LOST] - PLACES[0], atol=1e-6)
        stage.spin_until(lambda: any(f'without robot {LOST}' in line for line in stage.diagnostics['bridge_0']))

        version = told.version  # its odometry is there again, its bridge and its agent are not
        drive_on(stage, OTHERS, EVERYBODY, lambda: told.version >= version + 2)
        assert told.absent == set()

        graph.start(f'robots_{LOST}-{LOST}')
        acted = len(stage.actions[LOST])
        stage.tick_until(lambda: len(stage.actions[LOST]) > acted, *EVERYBODY)
        version = told.version
        drive_on(stage, EVERYBODY, EVERYBODY, lambda: told.version >= version + 2)
        assert not is_standing(stage.commands[LOST][-1])
    for name in ('task_monitor', 'trainer', 'robots_0-0'):
        assert 'Traceback' not in graph.log(name), graph.log(name)
