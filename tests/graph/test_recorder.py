"""What the recorder holds of a real run is that run, message for message."""

from __future__ import annotations

import os
import re
import signal
import time

import numpy as np
import pytest
import yaml
from harness import LASTING, REPOSITORY, SMALL, Listener, Recorder, begin_alone, oracle
from rosbags.rosbag2 import Reader
from std_srvs.srv import Trigger

from dae_ros.errors import BagError
from dae_ros.replay.dataset import Dataset
from dae_ros.rollout.in_process import train
from dae_ros.ros import names
from dae_ros.ros.graph import NodeProcess
from dae_ros.ros.recorded import team_topics


def trajectories(folder, values):
    """Every rollout of the same run in this process, the evaluation's too."""
    (training, worlds), seen = begin_alone(folder, values), []
    consume = training.consume
    training.consume = lambda trajectory: (seen.append(trajectory), consume(trajectory))
    train(training, worlds, lambda: None)
    training.close()
    return seen


def holds_rollouts(bag) -> bool:
    """Whether one can be read, from a bag that is still being written."""
    try:
        return any(Dataset(bag))
    except BagError:
        return False


@pytest.mark.parametrize('parameters, end', [
    ({}, signal.SIGINT), ({'storage': 'sqlite3'}, signal.SIGTERM), ({'compression': 'zstd', 'split_megabytes': 1}, signal.SIGINT),
    ({}, signal.SIGKILL)], ids=['mcap', 'sqlite3', 'split and compressed', 'killed'])
def test_a_recorded_run_holds_every_message_and_its_trajectories_bit_for_bit(parameters, end, make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    expected = trajectories(tmp_path / 'alone', SMALL)
    with Listener() as listener:
        Recorder(graph, listener, tmp_path / 'bag', **parameters).record_run()
    time.sleep(1.0)  # what a kill may cost
    os.kill(graph.pids['recorder'], end)
    code = graph.wait('recorder')
    assert code == (-end if end == signal.SIGKILL else 0)
    if code == 0:
        assert re.search(r'\d+ messages in .*bag', graph.log('recorder')) and 'missed' not in graph.log('recorder')

    dataset = Dataset(f'{tmp_path / "bag"}*')
    read = list(dataset.read())
    assert [rollout.request.rollout for rollout in read] == list(range(len(expected)))
    assert all(np.array_equal(a, b) for live, rollout in zip(expected, read) for a, b in zip(live, rollout.trajectory))
    assert set(dataset.skipped) <= ({'truncated'} if code else set())


def test_a_recorder_killed_and_started_again_disturbs_nothing_and_both_bags_are_read_as_one(make_graph, tmp_path):
    values = {**LASTING, 'total_steps': 40 * 8 * 25}
    graph = make_graph(tmp_path / 'graph', values)
    with Listener() as listener:
        first, second = (Recorder(graph, listener, tmp_path / 'bags' / name, name) for name in ('first', 'second'))
        for service in names.PAUSE, names.RESUME:
            listener.client(Trigger, service)
        graph.start(*(name for name in graph.names if name != 'second'))
        listener.spin_until(lambda: holds_rollouts(tmp_path / 'bags' / 'first'), lambda: f'{first.values} {graph.log("first")}')
        graph.kill('first')
        assert listener.call(Trigger, names.PAUSE, Trigger.Request()).success
        graph.start('second')
        listener.spin_until(lambda: second.sentence == 'recording', lambda: graph.log('second'))
        assert listener.call(Trigger, names.RESUME, Trigger.Request()).success
        assert graph.wait() == 0, graph.log('trainer')
    graph.stop()
    expected = trajectories(tmp_path / 'alone', values)
    assert graph.result() == oracle(tmp_path / 'oracle', values)
    read = list(Dataset(f'{tmp_path / "bags"}/*').read())
    rollouts = [rollout.request.rollout for rollout in read]
    assert rollouts == sorted(set(rollouts)) and rollouts[-1] == len(expected) - 1
    alone = [list(Dataset(tmp_path / 'bags' / name)) for name in ('first', 'second')]
    assert all(alone) and len(read) in (sum(map(len, alone)), sum(map(len, alone)) + 1)  # one may lie in both
    assert all(np.array_equal(a, b) for rollout in read
               for a, b in zip(expected[rollout.request.rollout], rollout.trajectory))


def test_what_the_recorder_writes_is_read_without_our_messages(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    with Listener() as listener:
        recorder = Recorder(graph, listener, tmp_path / 'bag', everything=True)
        graph.start('recorder')
        listener.spin_until(lambda: recorder.sentence.startswith('waiting for rollout_request'), lambda: graph.log('recorder'))
        graph.start(*(name for name in graph.names if name != 'recorder'))
        assert graph.wait() == 0, graph.log('trainer')
    graph.stop()
    with Reader(tmp_path / 'bag') as reader:
        topics = {connection.topic: connection for connection in reader.connections}
        assert set(topics) == {'/rollout_request', '/training_status', '/joint_state', '/shared_reward', '/policy',
                               *(f'/robot_{robot}/{name}' for robot in range(3) for name in ('action', 'observation'))}
        assert '# Where in a run a datum belongs' in topics['/joint_state'].msgdef.data
        assert all(connection.digest.startswith('RIHS01_') for connection in topics.values())
        assert topics['/policy'].ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'


def test_a_recorder_writes_over_nothing(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    graph.processes['recorder'] = NodeProcess('recorder', 'recorder', {'bag': str(tmp_path)})
    graph.start('recorder')
    assert graph.wait('recorder') == 2
    assert graph.log('recorder').startswith(f'error: {tmp_path} exists already')


def test_the_overrides_for_ros2_bag_record_are_those_the_recorder_listens_with():
    overrides = yaml.safe_load((REPOSITORY / 'config/bags/record_qos.yaml').read_text())
    topics = {f'/{topic.name}': topic.profile for topic in team_topics(8, 1, True)}
    assert set(overrides) == set(topics)
    for name, profile in topics.items():
        unlimited = dict.fromkeys(('deadline', 'lifespan', 'liveliness_lease_duration'), {'sec': 0, 'nsec': 0})
        assert overrides[name] == {'history': 'keep_last', 'depth': profile.depth, 'reliability': 'reliable',
                                   'durability': profile.durability.name.lower(), 'liveliness': 'system_default',
                                   'avoid_ros_namespace_conventions': False, **unlimited}
