"""Who earns what, on topics: from the trainer for the world that is watched, and from a file of reward networks without it."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from dae_ros_msgs import msg
from geometry_msgs.msg import Vector3Stamped
from harness import REPOSITORY, SMALL, Listener, begin_alone, bringup, finish, network_file, result_of
from numpy.lib.stride_tricks import sliding_window_view
from robots import FRAME, PERIOD, PLACES, Processes, Stage
from visualization_msgs.msg import MarkerArray

from dae_ros.learning.credit import Credit, CreditMeter
from dae_ros.learning.reward_files import load
from dae_ros.robots import standard_messages
from dae_ros.robots.pilot import stamp_at
from dae_ros.robots.setup import RUN
from dae_ros.rollout.in_process import train
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.ros.graph import watching
from dae_ros.types import Action

WORLD, STEPS, UPDATES, EVALUATIONS = 3, 25, 5, 1


def documented(executable, file=''):
    """Module and arguments of a command in the documentation, for these reward networks."""
    text = (REPOSITORY / 'docs/robots.md').read_text()
    path, *arguments = re.search(rf'^install/\S+/{executable} .*$', text, re.MULTILINE)[0].split()
    return f'dae_ros_nodes.{Path(path).name}', *(word.replace('runs/reward_network.safetensors', str(file)) for word in arguments)


def watched_alone(folder, values):
    """What the same run in this process ends with, and the credit of all its steps."""
    training, worlds = begin_alone(folder, values)
    training.watch(WORLD)
    credits = []
    train(training, worlds, lambda: credits.append(training.credit))
    of_all = Credit(*map(np.concatenate, zip(*credits[:UPDATES])))  # and of the last update once more, after the evaluation
    return result_of(training), of_all


def test_the_trainer_and_a_node_with_its_reward_networks_tell_the_same_difference_rewards(make_graph, tmp_path):
    """What is told of who earns what changes no weight. Who finds the others late misses the first steps."""
    file = network_file(tmp_path / 'networks.safetensors')
    values = {**SMALL, 'reward_network.path': str(file), 'reward_network.freeze': True}
    result, credit = watched_alone(tmp_path / 'alone', values)
    steps = {reward: step for step, reward in enumerate(credit.rewards.tolist())}
    assert len(steps) == STEPS * UPDATES and np.ptp(credit.differences) > 0.1 and np.ptp(credit.advantages) > 0.1
    by_trainer, by_node, of_evaluation = ([[] for _ in range(3)] for _ in range(3))

    def hear(robot: int, message: Vector3Stamped) -> None:
        told, step = message.vector, steps.get(message.vector.x)
        by = of_evaluation if step is None else by_node if np.isnan(told.z) else by_trainer
        by[robot].append((step, told.y, told.z, standard_messages.seconds(message.header.stamp)))

    def is_all_told() -> bool:
        return (all(said and said[-1][0] == STEPS * UPDATES - 1 for said in by_trainer + by_node)
                and all(len(said) == STEPS * EVALUATIONS for said in of_evaluation))

    graph, processes = make_graph(tmp_path / 'graph', values), Processes(tmp_path)
    graph.processes = {process.name: process for process in watching(list(graph.processes.values()), WORLD)}
    try:
        with Listener() as listener:
            for robot in range(3):
                listener.node.create_subscription(Vector3Stamped, names.CREDIT.format(robot), partial(hear, robot), qos.ROLLOUT)
            processes.python('credit', *documented('credit', file), '-p', f'world:={WORLD}')
            graph.start(*(name for name in graph.names if name != 'parameter_server'))  # for which all wait
            listener.spin_until(lambda: listener.node.count_subscribers(names.JOINT_STATE) == 2)
            listener.wait_for_status(lambda status: status.detail == 'waiting for parameter server')
            graph.start('parameter_server')
            listener.spin_until(is_all_told, lambda: f'{[len(said) for said in by_trainer + by_node + of_evaluation]} '
                                                     f'{processes.log("credit")}')
        assert graph.wait() == 0, graph.log('trainer')
        assert processes.end('credit') == 0, processes.log('credit')
    finally:
        processes.stop()
    assert graph.result() == result
    for robot in range(3):
        for told in by_trainer[robot], by_node[robot]:
            at, own, advantages, times = np.array(told).T
            at = at.astype(int)
            np.testing.assert_array_equal(at, np.arange(at[0], STEPS * UPDATES))
            np.testing.assert_allclose(own, credit.differences[at, robot], rtol=1e-5, atol=1e-5)
            if told is by_trainer[robot]:
                np.testing.assert_allclose(advantages, credit.advantages[at, robot], rtol=1e-5, atol=1e-5)
                np.testing.assert_allclose(times, 0.1 * at)


def test_bringup_has_the_trainer_tell_the_credit_of_the_world_it_is_asked_to_watch(domain, tmp_path):
    """At beta 0, where no reward network tells the difference rewards. Who finds the trainer late misses the first steps."""
    heard, updates = [], 4 * UPDATES
    last = 0.1 * (updates * STEPS - 1)  # s

    def time(message: Vector3Stamped) -> float:
        return standard_messages.seconds(message.header.stamp)

    with Listener() as listener:
        listener.node.create_subscription(Vector3Stamped, names.CREDIT.format(2), heard.append, qos.ROLLOUT)
        values = {**SMALL, 'beta': 0.0, 'total_steps': updates * 8 * STEPS, 'evaluation_episodes': 0}
        process = bringup(tmp_path / 'run', values, '--watch', str(WORLD))
        listener.spin_until(lambda: heard and np.isclose(time(heard[-1]), last) or process.poll() is not None)
        code, _, errors = finish(process)
    assert code == 0 and len(heard) >= 2 * STEPS, f'{len(heard)} {errors}'
    np.testing.assert_allclose([time(message) for message in heard], last - 0.1 * np.arange(len(heard))[::-1])
    assert all(np.isnan(message.vector.y) and np.isfinite([message.vector.x, message.vector.z]).all() for message in heard)


def said(meter, states, actions, rewards) -> list[float]:
    """What the library says that robot 1 earned, of messages heard and actions sent."""
    found = []
    for state in map(convert.joint_state, states):
        meter.on_joint_state(state)
        for action in actions:
            if action.stamp == state.stamp:
                meter.on_action(action)
        for reward in map(convert.shared_reward, rewards):
            credit = meter.on_reward(reward) if reward.stamp == state.stamp else None
            found += [] if credit is None else [credit.differences[0, 1]]
    return found


def test_beside_robots_a_task_monitor_and_the_node_tell_and_show_who_earns_what(domain, tmp_path):
    """The robots are put where they are by the test, which also acts for them: there is no trainer, no agent and no bridge."""
    file, processes = network_file(tmp_path / 'networks.safetensors'), Processes(tmp_path)
    told, shown, states, rewards, actions = [], [], [], [], []
    draw = np.random.default_rng(1)
    try:
        with Stage() as stage:
            for kind, topic, heard, profile in ((msg.JointState, names.JOINT_STATE, states, qos.ROLLOUT),
                                                (msg.SharedReward, names.SHARED_REWARD, rewards, qos.ROLLOUT),
                                                (Vector3Stamped, names.CREDIT.format(1), told, qos.ROLLOUT),
                                                (MarkerArray, names.MARKERS, shown, qos.EVENTS)):
                stage.node.create_subscription(kind, topic, heard.append, profile)
            act = [stage.node.create_publisher(msg.Action, names.ACTION.format(robot), qos.ROLLOUT) for robot in range(3)]
            processes.python('credit', *documented('credit', file), '-p', 'use_sim_time:=true')
            stage.spin_until(lambda: 'waiting for joint_state, shared_reward' in stage.diagnostics['credit'])
            processes.python('task_monitor', *documented('task_monitor'), '-p', 'use_sim_time:=true')
            stage.landmarks.publish(convert_robots.landmarks_message(PLACES[::-1], stage.now, FRAME))
            stage.tick_until(lambda: bool(states), 0, 1, 2)
            stage.spin_until(lambda: 'waiting for a whole step' in stage.diagnostics['credit'], lambda: str(stage.diagnostics))

            def step() -> None:
                stage.places += draw.normal(scale=0.03, size=(3, 2))
                stage.tick(0, 1, 2)
                stamp = stamp_at(stage.now, PERIOD, STEPS, RUN)
                stage.spin_until(lambda: convert.joint_state(states[-1]).stamp == stamp)
                for robot, publisher in enumerate(act):
                    weights = draw.dirichlet(np.ones(5)).astype(np.float32)
                    chosen = np.array([weights.argmax()], np.uint16)
                    actions.append(Action(stamp, robot, 0, chosen, weights[None]))
                    publisher.publish(convert.action_message(actions[-1]))

            # Whatever the node misses before it has found all publishers, it tells from an episode's start on.
            stage.repeat_until(lambda: len(told) > 2 * STEPS and any(marker.ns == 'credit' for marker in shown[-1].markers), step)
        assert processes.end('credit') == processes.end('task_monitor') == 0
    finally:
        processes.stop()
    differences, expected = [message.vector.y for message in told], said(CreditMeter(load(file), 0), states, actions, rewards)
    assert np.ptp(differences) > 0.01 and all(np.isnan(message.vector.z) for message in told)
    assert np.isclose(sliding_window_view(expected, len(told)), differences, rtol=1e-5, atol=1e-5).all(axis=1).any()
    texts = {float(marker.text) for array in shown for marker in array.markers if (marker.ns, marker.id) == ('credit', 1)}
    assert texts <= {round(difference, 3) for difference in expected}
