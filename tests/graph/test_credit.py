"""Who earns what, on topics: from the trainer for the world that is watched, and from a file of reward networks without it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from harness import REPOSITORY, SMALL, Listener, bringup, finish, oracle
from robots import Processes

from dae_ros import config
from dae_ros.learning.networks import make_reward_network
from dae_ros.learning.reward_files import encode
from dae_ros.robots import standard_messages
from dae_ros.ros import names, qos
from dae_ros.ros.graph import watching
from dae_ros.worlds import world_spec

WORLD, STEPS, UPDATES, ROLLOUTS = 3, 25, 5, 6  # the last rollout is the evaluation's


def network_file(path):
    """A file of reward networks that fit the small task."""
    settings = config.from_flat(SMALL)
    spec = world_spec(settings.task)
    path.write_bytes(encode([make_reward_network(spec, settings.reward_network, 3, 0)], spec, settings.reward_network))
    return path


def documented(executable, file=''):
    """Module and arguments of a command in the documentation, for these reward networks."""
    text = (REPOSITORY / 'docs/robots.md').read_text()
    path, *arguments = re.search(rf'^install/\S+/{executable} .*$', text, re.MULTILINE)[0].split()
    return f'dae_ros_nodes.{Path(path).name}', *(word.replace('runs/reward_network.safetensors', str(file)) for word in arguments)


def test_the_trainer_and_a_node_with_its_reward_networks_tell_the_same_difference_rewards(make_graph, tmp_path):
    """What is told of who earns what changes no weight."""
    file = network_file(tmp_path / 'networks.safetensors')
    values = {**SMALL, 'reward_network.path': str(file), 'reward_network.freeze': True}
    graph, processes = make_graph(tmp_path / 'graph', values), Processes(tmp_path)
    graph.processes = {process.name: process for process in watching(list(graph.processes.values()), WORLD)}
    heard = [[] for _ in range(3)]
    try:
        with Listener() as listener:
            for robot, said in enumerate(heard):
                listener.node.create_subscription(Vector3Stamped, names.CREDIT.format(robot), said.append, qos.ROLLOUT)
            processes.python('credit', *documented('credit', file), '-p', f'world:={WORLD}')
            graph.start(*(name for name in graph.names if name != 'parameter_server'))  # for which all wait
            listener.spin_until(lambda: listener.node.count_subscribers(names.JOINT_STATE) == 2)
            listener.wait_for_status(lambda status: status.detail == 'waiting for parameter server')
            graph.start('parameter_server')
            listener.spin_until(lambda: all(len(said) == STEPS * (UPDATES + ROLLOUTS) for said in heard),
                                lambda: f'{[len(said) for said in heard]} {processes.log("credit")}')
        assert graph.wait() == 0, graph.log('trainer')
        assert processes.end('credit') == 0, processes.log('credit')
    finally:
        processes.stop()
    assert graph.result() == oracle(tmp_path / 'alone', values)
    for said in heard:
        numbers = np.array([(message.vector.x, message.vector.y, message.vector.z) for message in said])
        by_trainer, by_node = (numbers[which] for which in (~np.isnan(numbers[:, 2]), np.isnan(numbers[:, 2])))
        np.testing.assert_allclose(by_node[:len(by_trainer), :2], by_trainer[:, :2], rtol=1e-5, atol=1e-5)
        assert len(by_trainer) == STEPS * UPDATES and np.ptp(by_trainer[:, 1]) > 0.1 and np.ptp(by_trainer[:, 2]) > 0.1
        times = [standard_messages.seconds(message.header.stamp) for message in said if not np.isnan(message.vector.z)]
        np.testing.assert_allclose(times, 0.1 * np.arange(STEPS * UPDATES))


def test_bringup_has_the_trainer_tell_the_credit_of_the_world_it_is_asked_to_watch(domain, tmp_path):
    """At beta 0, where no reward network tells the difference rewards."""
    heard = []
    with Listener() as listener:
        listener.node.create_subscription(Vector3Stamped, names.CREDIT.format(2), heard.append, qos.ROLLOUT)
        values = {**SMALL, 'beta': 0.0, 'total_steps': 2 * 8 * STEPS, 'evaluation_episodes': 0}
        process = bringup(tmp_path / 'run', values, '--watch', str(WORLD))
        listener.spin_until(lambda: len(heard) == 2 * STEPS or process.poll() is not None)
        code, _, errors = finish(process)
    assert code == 0 and len(heard) == 2 * STEPS, f'{len(heard)} {errors}'
    assert all(np.isnan(message.vector.y) and np.isfinite([message.vector.x, message.vector.z]).all() for message in heard)
