"""A bag is played as it was recorded, and a training that listens to it ends as the one that was recorded."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from harness import SMALL, TIMEOUT, Listener, Recorder, finish
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from dae_ros.replay.recording import Recording
from dae_ros.report.summary import Summary
from dae_ros.ros import qos
from dae_ros.ros.recorded import as_written, team_topics
from tests.bags import Team, as_message, typestore


def start(module, *arguments):
    """A node in a process of its own, as a user would start it."""
    return subprocess.Popen([sys.executable, '-m', f'dae_ros_nodes.{module}', *map(str, arguments)], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL))


@pytest.fixture
def play(domain):
    """Starts players and leaves none behind."""
    started = []

    def playing(*arguments):
        started.append(start('player', *arguments))
        return started[-1]

    yield playing
    for process in started:
        process.kill()
        process.communicate()


def counted(path, numbers, gap=1e-3):
    """A bag of std_msgs/Int64, `gap` seconds from message to message."""
    store = get_typestore(Stores.ROS2_JAZZY)
    offered = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # so that the first ones are not missed
    profile = as_written(team_topics(1, 1, False)[0]._replace(offered=offered), '').qos
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/count', 'std_msgs/msg/Int64', typestore=store, offered_qos_profiles=[profile])
        for number in numbers:
            message = store.types['std_msgs/msg/Int64'](data=number)
            writer.write(connection, 10**18 + int(number * gap * 1e9), store.serialize_cdr(message, 'std_msgs/msg/Int64'))
    return path


class Counter(Listener):
    """What is heard on a topic of numbers."""

    def __init__(self, topic='/count'):
        super().__init__()
        self.heard = []
        self.node.create_subscription(Int64, topic, lambda message: self.heard.append(message.data),
                                      qos.REPLAYED_LATCHED)

    def wait_for(self, expected):
        self.spin_until(lambda: len(self.heard) >= len(expected), lambda: f'heard {len(self.heard)}')
        assert self.heard == expected


def test_messages_come_in_order_at_a_rate_from_an_offset_into_another_namespace(play, tmp_path):
    bag = counted(tmp_path / 'bag', range(40), gap=0.1)
    with Counter('/elsewhere/count') as listener:
        began = time.monotonic()
        player = play(bag, '--rate', '4', '--start-offset', '2', '--namespace', 'elsewhere', '--wait-for-subscribers')
        listener.wait_for(list(range(20, 40)))
        assert time.monotonic() - began > 1.9 / 4
    assert finish(player)[:2] == (0, '20 messages played\n')


def test_a_paused_player_goes_step_by_step_and_then_on_and_around(play, tmp_path):
    bag = counted(tmp_path / 'bag', range(5))
    with Counter() as listener:
        step = listener.client(Trigger, '/player/play_next')
        player = play(bag, '--start-paused', '--loop', '--wait-for-subscribers')

        def call(name):
            return listener.call(Trigger, f'/player/{name}', Trigger.Request()).success

        assert not call('pause')
        assert step.wait_for_service(TIMEOUT)
        for steps in (1, 2, 3):
            step.call_async(Trigger.Request())  # whose answer may be dropped, but which must not be asked twice
            listener.wait_for(list(range(steps)))
        call('resume')
        assert not call('play_next') and not call('resume')
        listener.spin_until(lambda: len(listener.heard) > 12)
        assert listener.heard[:12] == [*range(5), *range(5), 0, 1]
        player.send_signal(signal.SIGINT)
        code, output, errors = finish(player)
        assert code == 0 and 'messages played' in output and 'Traceback' not in errors


def test_as_fast_as_it_is_taken_nothing_is_lost_although_the_subscriber_sleeps(play, tmp_path):
    """What is sent are more messages than all the queues between the two hold."""
    bag = counted(tmp_path / 'bag', range(8_000))
    with Counter() as listener:
        player = play(bag, '--fast', '--wait-for-subscribers')
        listener.spin_until(lambda: len(listener.heard) > 100)
        time.sleep(1.0)  # the queue runs full
        listener.wait_for(list(range(8_000)))
    assert finish(player)[:2] == (0, '8000 messages played\n')


def test_topics_are_offered_as_they_were_recorded(play, tmp_path):
    recording = Recording(tmp_path / 'bag', [as_written(topic, f'/{topic.name}') for topic in team_topics(3, 1, False)])
    for datum in Team(num_worlds=2).play(0)[1]:
        name, kind, message = as_message(typestore(), datum, True)
        recording.write(f'/{name}', time.time_ns(), bytes(typestore().serialize_cdr(message, kind)))
    recording.close()
    bag = tmp_path / 'bag'
    play(bag, '--start-paused', '--exclude-topics', '/shared_reward')

    def offered(listener):
        return {name: listener.node.get_publishers_info_by_topic(name) for name in
                ('/rollout_request', '/joint_state', '/shared_reward', '/robot_2/action')}

    with Listener() as listener:
        listener.spin_until(lambda: sum(map(len, offered(listener).values())) >= 3)
        found = offered(listener)
        assert found.pop('/shared_reward') == []
        durability = {name: info.qos_profile.durability for name, (info,) in found.items()}
        assert durability == {'/rollout_request': DurabilityPolicy.TRANSIENT_LOCAL, '/joint_state': DurabilityPolicy.VOLATILE,
                              '/robot_2/action': DurabilityPolicy.VOLATILE}


@pytest.mark.parametrize('arguments, complaint', [
    (['nowhere'], "error: there is no bag 'nowhere'"), (['bag', '--topics', '/other'], 'error: there is nothing to play in bag'),
    (['bag', '--start-offset', '9'], 'error: --start-offset 9 lies behind the last message, at 0.004 s')])
def test_what_cannot_be_played_is_told_in_one_sentence(arguments, complaint, play, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counted(tmp_path / 'bag', range(5))
    code, _, errors = finish(play(*arguments))
    assert code == 2 and errors.startswith(complaint) and errors.count('\n') == 1


def test_a_training_that_listens_to_a_replay_ends_with_the_weights_of_the_recorded_run(play, make_graph, tmp_path):
    values = {**SMALL, 'num_agents': 2, 'world_groups': 2}
    graph = make_graph(tmp_path / 'live', values)
    with Listener() as listener:
        Recorder(graph, listener, tmp_path / 'bag').record_run()
    graph.stop()
    trainer = start('replay_trainer', '--ros-args', '--params-file', graph.folder.settings_file, '-p',
                    f'run_folder:={tmp_path / "replayed"}')
    player = play(tmp_path / 'bag', '--fast', '--wait-for-subscribers', '--exclude-topics', '/training_status')
    code, _, errors = finish(trainer)
    assert code == 0, errors
    assert finish(player)[0] == 0
    live, replayed = (Summary.read(tmp_path / name / 'summary.json') for name in ('live', 'replayed'))
    assert (live.weights_sha256, live.evaluation_return) == (replayed.weights_sha256, replayed.evaluation_return)
    policies = [(tmp_path / name / 'policy.safetensors').read_bytes() for name in ('live', 'replayed')]
    assert policies[0] == policies[1]
