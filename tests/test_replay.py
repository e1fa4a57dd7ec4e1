"""Bags become the trajectories that a trainer had live, and whatever a bag may hold ends in counts or in one sentence."""

import random
import shutil
import sqlite3
from collections import Counter

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from dae_ros.errors import BagError
from dae_ros.replay.bag import find_bags
from dae_ros.replay.cdr import MESSAGE_TYPES
from dae_ros.replay.dataset import Dataset
from dae_ros.types import Action, JointState, RolloutRequest
from tests.bags import RUN, Team, typestore, write_bag

FORMS = [('mcap', 'none'), ('mcap', 'storage'), ('mcap', 'message'), ('mcap', 'file'), ('sqlite3', 'none'),
         ('sqlite3', 'message'), ('sqlite3', 'file')]


@pytest.fixture(scope='module')
def played():
    """Five rollouts: their trajectories, and for each the data it consists of."""
    team = Team()
    return [team.play(rollout) for rollout in range(5)]


def all_data(played):
    return [datum for _, data in played for datum in data]


def same(one, other):
    return all(a is b or a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize('storage, compression', FORMS)
def test_a_bag_gives_the_trajectories_bit_for_bit(storage, compression, played, tmp_path):
    dataset = Dataset(write_bag(tmp_path / 'bag', all_data(played), storage=storage, compression=compression))
    assert all(same(live, read) for (live, _), read in zip(played, dataset, strict=True))
    assert (dataset.rollouts, dataset.environment_steps, dataset.skipped) == (5, 5 * 4 * 5, Counter())
    assert dataset.spec == Team().spec and dataset.num_worlds == 4


@pytest.mark.parametrize('task', ['matrix_game', 'line', 'formation'])
def test_every_task_is_read(task, tmp_path):
    team = Team(task=task)
    trajectory, data = team.play(0)
    dataset = Dataset(write_bag(tmp_path / 'bag', data))
    assert same(trajectory, *dataset)
    assert dataset.spec[:4] == team.spec[:4]


def test_a_state_that_is_sent_apart_is_read(played, tmp_path):
    trajectory, data = played[0]
    assert same(trajectory, *Dataset(write_bag(tmp_path / 'bag', data, omit_state=False)))


def test_the_order_in_which_messages_were_recorded_does_not_matter(played, tmp_path):
    for seed in range(3):
        data = [list(part) for _, part in played]
        for part in data:
            random.Random(seed).shuffle(part)
        # A recorder may also hear the next request before the last data of the rollout under way.
        data[0][-1], data[1][0] = data[1][0], data[0][-1]
        dataset = Dataset(write_bag(tmp_path / f'bag_{seed}', [datum for part in data for datum in part]))
        assert all(same(live, read) for (live, _), read in zip(played, dataset, strict=True))


def test_several_bags_are_read_in_their_natural_order_and_a_rollout_may_go_on_in_the_next(played, tmp_path):
    data = all_data(played)
    parts = np.array_split(np.arange(len(data)), 12)
    for number, part in enumerate(parts):
        write_bag(tmp_path / f'part_{number}', [data[index] for index in part])
    dataset = Dataset(tmp_path / 'part_*')
    assert all(same(live, read) for (live, _), read in zip(played, dataset, strict=True))
    assert [path.name for path in find_bags(tmp_path / 'part_*')] == [f'part_{number}' for number in range(12)]
    assert find_bags(tmp_path / 'part_1', tmp_path / 'part_*')[0].name == 'part_1'


def test_each_iteration_begins_anew(played, tmp_path):
    dataset = Dataset(write_bag(tmp_path / 'bag', all_data(played)))
    assert [len(list(dataset)) for _ in range(2)] == [5, 5] and dataset.rollouts == 5


def test_a_rollout_that_was_begun_anew_is_read_once(played, tmp_path):
    trajectory, data = played[0]
    interrupted = [datum for datum in data[:9]]
    again = Team().play(0, attempt=1)[1]
    dataset = Dataset(write_bag(tmp_path / 'bag', interrupted + again + data))
    assert [same(trajectory, read) for read in dataset] == [True]
    # The attempt that was given up, then the same rollout once more, as after a resumed run: all but its request.
    assert dataset.skipped == {'incomplete': 1, 'duplicate': len(data) - 1}


def test_what_is_missing_costs_its_own_rollout_only(played, tmp_path):
    lost = next(datum for datum in played[2][1] if isinstance(datum, Action)), played[3][1][0]  # an action, a request
    data = [datum for datum in all_data(played) if not any(datum is missing for missing in lost)]
    dataset = Dataset(write_bag(tmp_path / 'bag', data))
    assert len(list(dataset)) == 3 and dataset.skipped == {'incomplete': 2}


def test_teams_groups_and_runs_are_kept_apart(tmp_path):
    teams = {('/red', '/group_0'): Team(1), ('/red', '/group_1'): Team(2), ('/blue', ''): Team(3), ('', ''): Team(4)}
    played = {key: team.play(0, run=RUN + index // 2) for index, (key, team) in enumerate(teams.items())}
    for index, ((namespace, group), (_, data)) in enumerate(played.items()):
        write_bag(tmp_path / f'bag_{index}', data, namespace=namespace, group=group)
    dataset = Dataset(tmp_path / 'bag_*')
    read = list(dataset.read())
    assert [(rollout.team, rollout.group, rollout.request.run) for rollout in read] == [
        ('red', 0, RUN), ('red', 1, RUN), ('blue', 0, RUN + 1), ('', 0, RUN + 1)]
    assert all(same(live, rollout.trajectory) for (live, _), rollout in zip(played.values(), read))


def test_rollouts_of_other_sizes_than_the_first_are_skipped_and_counted(played, tmp_path):
    write_bag(tmp_path / 'bag_0', all_data(played))
    write_bag(tmp_path / 'bag_1', Team(num_agents=2).play(0, run=RUN + 1)[1])
    dataset = Dataset(tmp_path / 'bag_*')
    assert len(list(dataset)) == 5 and dataset.skipped == {'other_sizes': 1}


def test_what_no_honest_node_sends_is_refused_by_reason(played, tmp_path):
    def spoilt(datum):
        if isinstance(datum, JointState) and datum.stamp.rollout == 1 and datum.stamp.step == 2:
            return datum._replace(observations=np.full_like(datum.observations, np.nan))
        if isinstance(datum, Action) and datum.stamp.rollout == 2 and datum.stamp.step == 1:
            return datum._replace(probabilities=datum.probabilities * 2)
        return datum._replace(num_steps=0) if isinstance(datum, RolloutRequest) and datum.rollout == 3 else datum

    dataset = Dataset(write_bag(tmp_path / 'bag', map(spoilt, all_data(played))))
    assert len(list(dataset)) == 2
    assert dataset.skipped == {'not_finite': 1, 'out_of_range': 3 + 1, 'incomplete': 3}


# Bags that cannot be read, or not to the end.

def refusal(*paths):
    with pytest.raises(BagError) as caught:
        list(Dataset(*paths))
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_a_bag_that_is_not_there_is_named(tmp_path):
    assert f"there is no bag '{tmp_path}/bag*'" in refusal(f'{tmp_path}/bag*')


def test_a_folder_without_storage_is_no_bag(tmp_path):
    assert 'is not a rosbag2 bag: expected .mcap' in refusal(tmp_path)


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'mcap.zstd', 'db3.zstd'])
@pytest.mark.parametrize('content', [b'', b'x', b'not a bag at all' * 100])
def test_a_file_that_is_no_bag_is_named(suffix, content, tmp_path):
    (tmp_path / f'bag.{suffix}').write_bytes(content)
    assert refusal(tmp_path / f'bag.{suffix}').startswith('no rollout can be read: ')


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_of_others_or_of_nothing_has_no_messages_of_ours(storage, tmp_path):
    assert 'no messages of ours in 1 bag' in refusal(write_bag(tmp_path / 'empty', [], storage=storage))
    with Writer(tmp_path / 'foreign', version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connection = writer.add_connection('/chat', 'std_msgs/msg/String', msgdef='string data\n', rihs01='RIHS01_00')
        writer.write(connection, 1, b'\x00\x01\x00\x00\x02\x00\x00\x00x\x00')
    assert 'no messages of ours in 1 bag' in refusal(tmp_path / 'foreign')


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_of_another_version_are_refused_and_other_bags_are_used(storage, played, tmp_path):
    older = typestore(lambda text: text.replace('uint64 policy_version', 'uint32 policy_version'))
    write_bag(tmp_path / 'bag_0', all_data(played), storage=storage, store=older)
    assert 'another version of dae_ros_msgs/msg/' in refusal(tmp_path / 'bag_0')
    write_bag(tmp_path / 'bag_1', all_data(played), storage=storage)
    dataset = Dataset(tmp_path / 'bag_*')
    assert len(list(dataset)) == 5
    assert 'bag_0' in dataset.describe_skipped() and 'another version' in dataset.describe_skipped()


def test_the_definitions_that_are_read_are_those_of_the_message_package():
    expected = {name: kind.rihs01 for name, kind in MESSAGE_TYPES.items()}
    assert {name: typestore().hash_rihs01(name) for name in MESSAGE_TYPES} == expected


@pytest.mark.parametrize('compression', ['none', 'storage'])
def test_a_bag_that_breaks_off_is_read_as_far_as_it_goes(compression, played, tmp_path):
    """Chunks are written as they fill up; here each message makes one."""
    with pytest.MonkeyPatch.context() as patch:
        from rosbags.rosbag2.storage_mcap import McapWriter
        write = McapWriter.write
        patch.setattr(McapWriter, 'write', lambda self, *args: (write(self, *args), self.close_chunk()))
        write_bag(tmp_path / 'bag', all_data(played), compression=compression)
    (tmp_path / 'bag/metadata.yaml').unlink()
    whole = (tmp_path / 'bag/bag.mcap').read_bytes()
    most = 0
    for end in range(len(whole) // 3, len(whole) // 2, 997):
        (tmp_path / 'bag/bag.mcap').write_bytes(whole[:end])
        dataset = Dataset(tmp_path / 'bag')
        read = list(dataset)
        assert all(same(live, trajectory) for (live, _), trajectory in zip(played, read))
        assert len(read) >= most and dataset.skipped['truncated'] == 1
        most = len(read)
    assert most >= 1


def flipped(content, draw):
    content = bytearray(content)
    for _ in range(draw.choice([1, 1, 1, 2, 8, 64])):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    return bytes(content)


@pytest.mark.parametrize('storage, compression', FORMS)
def test_flipped_bytes_end_in_counts_or_in_one_sentence(storage, compression, played, tmp_path):
    path = write_bag(tmp_path / 'bag', all_data(played[:3]), storage=storage, compression=compression)
    (file,) = (entry for entry in path.iterdir() if entry.name != 'metadata.yaml')
    whole, draw = file.read_bytes(), random.Random(1)
    for _ in range(120):
        file.write_bytes(flipped(whole, draw))
        dataset = Dataset(path)
        try:
            read = list(dataset)
        except BagError as error:
            assert '\n' not in str(error)
            continue
        assert dataset.rollouts == len(read) > 0


def test_a_journal_that_a_crash_left_is_taken_back(played, tmp_path):
    path = write_bag(tmp_path / 'bag', all_data(played), storage='sqlite3')
    database = sqlite3.connect(path / 'bag.db3')
    database.execute('PRAGMA cache_size = 1')
    database.execute('PRAGMA cache_spill = 1')
    database.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 1, ?)', [(bytes(50_000),)] * 200)
    shutil.copytree(path, tmp_path / 'crashed')
    database.close()
    assert (tmp_path / 'crashed/bag.db3-journal').stat().st_size
    dataset = Dataset(tmp_path / 'crashed')
    assert len(list(dataset)) == 5 and not dataset.skipped
