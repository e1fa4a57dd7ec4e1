"""A recording holds every message, whatever the form, and after a crash all but the last half second."""

import resource
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader

from dae_ros.errors import BagError
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.gaps import Gaps
from dae_ros.replay.played import write_rollouts
from dae_ros.replay.recording import Recording, Topic
from tests.bags import SCHEMAS, Team, as_message, typestore

QOS = Qos(QosHistory.KEEP_LAST, 1024, QosReliability.RELIABLE, QosDurability.VOLATILE, QosTime(0, 0), QosTime(0, 0),
          QosLiveliness.SYSTEM_DEFAULT, QosTime(0, 0), False)
FORMS = [('mcap', 'none'), ('mcap', 'zstd'), ('sqlite3', 'none'), ('sqlite3', 'zstd')]


def serialized(data):
    """Topics to be recorded, and the messages on them."""
    store, topics, messages = typestore(), {}, []
    for datum in data:
        name, kind, message = as_message(store, datum, True)
        topics[name] = Topic(name, kind, store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind), QOS)
        messages.append((name, bytes(store.serialize_cdr(message, kind))))
    return list(topics.values()), messages


@pytest.fixture(scope='module')
def played():
    team = Team()
    return [team.play(rollout) for rollout in range(4)]


@pytest.fixture(scope='module')
def heard(played):
    return serialized([datum for _, data in played for datum in data])


def same(played, dataset):
    return all(np.array_equal(a, b) for (live, _), read in zip(played, dataset, strict=True) for a, b in zip(live, read))


@pytest.mark.parametrize('storage, compression', FORMS)
def test_what_is_recorded_is_read_again_also_by_other_tools(storage, compression, heard, played, tmp_path):
    topics, messages = heard
    recording = Recording(tmp_path / 'bag', topics, storage, compression)
    for moment, (topic, data) in enumerate(messages):
        recording.write(topic, 10**18 + moment * 10**7, data)
    recording.close()
    assert recording.messages.total() == len(messages)
    assert same(played, Dataset(tmp_path / 'bag'))
    with Reader(tmp_path / 'bag') as reader:
        assert [(connection.topic, data) for connection, _, data in reader.messages()] == messages
        assert all(connection.msgdef.data for connection in reader.connections)
        assert all(connection.ext.offered_qos_profiles == [QOS] for connection in reader.connections)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_recording_is_split_by_size_and_by_time(storage, heard, played, tmp_path):
    topics, messages = heard
    total = sum(len(data) for _, data in messages)
    recordings = {'size': Recording(tmp_path / 'size', topics, storage, split_bytes=total // 3),
                  'time': Recording(tmp_path / 'time', topics, storage, split_time=len(messages) // 3 + 1)}
    for name, recording in recordings.items():
        for moment, (topic, data) in enumerate(messages):
            recording.write(topic, 10**18 + moment, data)
        recording.close()
        assert recording.messages.total() == len(messages)
        assert sorted(path.name for path in tmp_path.glob(f'{name}_*')) == [f'{name}_{part}' for part in range(3)]
        dataset = Dataset(tmp_path / f'{name}_*')
        assert same(played, dataset) and not dataset.skipped


def test_nothing_that_exists_is_written_over(heard, tmp_path):
    (tmp_path / 'bag').mkdir()
    with pytest.raises(BagError, match='bag exists already: choose another name'):
        Recording(tmp_path / 'bag', heard[0])
    (tmp_path / 'file').touch()
    with pytest.raises(BagError, match='cannot write the bag'):
        Recording(tmp_path / 'file' / 'bag', heard[0])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_disk_that_is_full_ends_the_recording_with_one_sentence(storage, heard, tmp_path):
    """A limit on the size of files stands for the disk's end."""
    topics, messages = heard
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    recording = Recording(tmp_path / 'bag', topics, storage)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(BagError, match='cannot write the bag .*bag: ') as caught:
            for moment in range(10_000):
                recording.write(messages[1][0], 10**18 + moment * 10**9, messages[1][1])
        recording.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert '\n' not in str(caught.value)


WRITING = '''
import sys, time
from pathlib import Path
from dae_ros.replay.played import write_rollouts
from dae_ros.replay.recording import Recording
from tests.test_recording import serialized
from tests.bags import SCHEMAS, Team

team = Team()
topics, messages = serialized([datum for rollout in range(4) for datum in team.play(rollout)[1]])
recording = Recording(Path(sys.argv[1]), topics, *sys.argv[2:])
for topic, data in messages:
    recording.write(topic, time.time_ns(), data)
recording.flush_if_due(time.time_ns() + 10**9)
for topic, data in serialized(team.play(4)[1])[1][:-1]:
    recording.write(topic, time.time_ns(), data)
print('written', flush=True)
time.sleep(60)
'''


@pytest.mark.parametrize('storage, compression', FORMS)
def test_after_a_kill_everything_up_to_the_last_flush_is_readable(storage, compression, played, tmp_path):
    command = [sys.executable, '-c', WRITING, str(tmp_path / 'bag'), storage, compression]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1])
    assert process.stdout.readline() == 'written\n'
    process.send_signal(signal.SIGKILL)
    process.wait()
    dataset = Dataset(tmp_path / 'bag')
    assert same(played, dataset)
    assert set(dataset.skipped) <= {'truncated', 'incomplete'}
    assert 'bag_0' in {path.stem for path in (tmp_path / 'bag').iterdir()}  # as `ros2 bag reindex` wants it


def test_messages_are_flushed_as_time_goes_by(heard, played, tmp_path):
    topics, messages = heard
    recording = Recording(tmp_path / 'bag', topics)
    for moment, (topic, data) in enumerate(messages):
        recording.write(topic, 10**18 + moment * 10**8, data)
    dataset = Dataset(tmp_path / 'bag')
    assert len(list(dataset)) >= 3  # the fourth rollout's last half second is not there yet
    recording.close()


def test_gaps_are_told_by_the_stamps():
    def heard(*stamps):
        gaps = Gaps()
        return [gaps.missing('topic', b'\0\1\0\0' + struct.pack('<QIII', *stamp) + bytes(9)) for stamp in stamps]

    run = [(1, rollout, 0, step) for rollout in range(2) for step in range(4)]
    assert heard(*run) == [0] * 8
    assert heard(*run[2:]) == [0] * 6           # the recorder came late
    assert heard(*run[:1], *run[3:]) == [0, 2, 0, 0, 0, 0]
    assert heard(*run[:4], *run[6:]) == [0, 0, 0, 0, 2, 0]
    assert heard(*run[:2], (1, 0, 1, 0), (1, 0, 1, 1)) == [0, 0, 0, 0]  # begun anew
    assert Gaps().missing('topic', b'') == 0


def test_recording_keeps_up_with_any_team(heard, tmp_path):
    """A team on two cores makes some thousand messages a second."""
    topics, messages = heard
    recording, began = Recording(tmp_path / 'bag', topics), time.process_time()
    for moment, (topic, data) in enumerate(messages * 20):
        recording.write(topic, 10**18 + moment * 10**5, data)
    assert len(messages) * 20 / (time.process_time() - began) > 10_000
    recording.close()


def test_rollouts_that_were_played_in_one_process_are_written_as_a_recorder_hears_them(played, tmp_path):
    write_rollouts(tmp_path / 'bag', [(data[0], live) for live, data in played], SCHEMAS)
    dataset = Dataset(tmp_path / 'bag')
    rollouts = list(dataset.read())
    assert same(played, (rollout.trajectory for rollout in rollouts)) and not dataset.skipped
    assert [rollout.request for rollout in rollouts] == [data[0] for _, data in played]
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == sum(len(data) for _, data in played)
