"""Policy versions on disk: the newest are kept, whole ones are served, anything else is passed over."""

import numpy as np
import pytest

from dae_ros.errors import FileError
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.weights.codec import encode_policy
from dae_ros.weights.store import PolicyStore

SIZES = PolicyArchitecture(observation_size=2, num_actions=2, hidden_size=3, mlp_layers=1, activation='relu')


def policy_file(version):
    return encode_policy(Policy(SIZES, {name: np.full(shape, version, np.float32)
                                        for name, shape in SIZES.shapes().items()}))


def store_with(folder, versions, keep=3):
    store = PolicyStore(folder, keep)
    for version in versions:
        store.save(version, policy_file(version))
    return store


def file_of(folder, version):
    path, = (path for path in folder.iterdir() if path.name.startswith('policy_') and int(path.stem[7:]) == version)
    return path


def test_an_empty_store_makes_its_folder_and_has_nothing_to_serve(tmp_path):
    store = PolicyStore(tmp_path / 'some' / 'policies', 3)
    assert (tmp_path / 'some' / 'policies').is_dir()
    assert store.versions() == [] and store.newest() is None and store.load(0) is None


def test_a_version_comes_back_as_it_was_saved(tmp_path):
    store = store_with(tmp_path, [0, 1])
    assert store.load(0) == policy_file(0) and store.load(1) == policy_file(1)
    assert store.load(2) is None


def test_a_version_saved_again_is_replaced(tmp_path):
    store = store_with(tmp_path, [4])
    store.save(4, policy_file(5))
    assert store.versions() == [4] and store.load(4) == policy_file(5)


@pytest.mark.parametrize('keep', [1, 2, 3])
def test_the_newest_versions_are_kept_and_older_ones_deleted(tmp_path, keep):
    store = store_with(tmp_path, range(7), keep)
    assert store.versions() == list(range(7))[-keep:]
    assert store.load(6 - keep) is None
    assert len(list(tmp_path.iterdir())) == keep


def test_versions_are_ordered_by_number_however_many_digits_they_have(tmp_path):
    versions = [9, 10, 99_999_999, 100_000_000, 10**12]
    store = store_with(tmp_path, versions, keep=10)
    assert store.versions() == versions
    assert store.newest() == (10**12, policy_file(10**12))


def test_a_store_that_comes_back_serves_the_newest_version(tmp_path):
    store_with(tmp_path, [3, 4])
    assert PolicyStore(tmp_path, 3).newest() == (4, policy_file(4))


@pytest.mark.parametrize('damage', [lambda data: data[:-1], lambda data: b'', lambda data: data[:8] + b'[' + data[9:],
                                    lambda data: data[:-1] + bytes([data[-1] ^ 1])],
                         ids=['torn', 'empty', 'damaged', 'a bit flipped'])
def test_a_version_that_is_not_whole_is_passed_over_for_the_one_before(tmp_path, damage):
    store = store_with(tmp_path, [3, 4, 5])
    for version in (4, 5):
        path = file_of(tmp_path, version)
        path.write_bytes(damage(path.read_bytes()))
    assert store.load(5) is None and store.load(4) is None
    assert store.newest() == (3, policy_file(3))


def test_a_store_with_nothing_whole_has_nothing_to_serve(tmp_path):
    store = store_with(tmp_path, [3])
    file_of(tmp_path, 3).write_bytes(b'')
    assert store.newest() is None


def test_files_of_other_names_are_neither_versions_nor_deleted(tmp_path):
    others = ['policy_.safetensors', 'policy_new.safetensors', 'policy_-1.safetensors', 'policy_00000009.txt',
              'other_00000009.safetensors', '.policy_00000009.safetensors.123', 'notes.txt']
    for name in others:
        (tmp_path / name).write_bytes(policy_file(9))
    store = store_with(tmp_path, range(4), keep=2)
    assert store.versions() == [2, 3] and store.newest() == (3, policy_file(3))
    assert all((tmp_path / name).exists() for name in others)


def test_a_write_that_is_cut_short_leaves_the_versions_there_were(tmp_path, monkeypatch):
    store = store_with(tmp_path, [3, 4])

    def fail(*arguments):
        raise OSError('no space left')

    for step in ('os.fsync', 'os.replace'):
        with monkeypatch.context() as patch:
            patch.setattr(step, fail)
            for version in (4, 5):
                with pytest.raises(FileError, match=f'^cannot write {tmp_path}/policy_0000000{version}.*: no space left'):
                    store.save(version, b'half of a pol')
        assert len(list(tmp_path.iterdir())) == 2
        assert PolicyStore(tmp_path, 3).versions() == [3, 4]
        assert PolicyStore(tmp_path, 3).newest() == (4, policy_file(4))


def test_a_store_that_comes_back_removes_what_a_killed_one_left_half_written(tmp_path):
    store_with(tmp_path, [3])
    (tmp_path / '.policy_00000004.safetensors.123.part').write_bytes(b'half of a pol')
    PolicyStore(tmp_path, 3)
    assert len(list(tmp_path.iterdir())) == 1
