"""The folder of a run: it belongs to one set of settings and gives the newest whole checkpoint back."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.errors import FileError, RunFolderError
from dae_ros.run_folder import RunFolder

SETTINGS = config.from_flat({'keep_checkpoints': 3, 'beta': 0.5})


def tensors(update):
    return {'weights': np.full((2, 3), update, np.float32), 'value_norm': np.arange(3.0)}


def folder_with(path, updates, settings=SETTINGS):
    folder = RunFolder(path, settings)
    for update in updates:
        folder.save_checkpoint(update, tensors(update), {'updates': update})
    return folder


def newest_update(folder):
    found = folder.newest_checkpoint()
    if found is None:
        return None
    np.testing.assert_array_equal(found[0]['weights'], tensors(found[1]['updates'])['weights'])
    return found[1]['updates']


def checkpoint_of(folder, update):
    path, = (path for path in folder.checkpoints.iterdir() if path.stem.endswith(f'_{update:08d}'))
    return path


def test_a_run_leaves_its_settings_as_a_task_file(tmp_path):
    folder = RunFolder(tmp_path / 'runs' / 'mine', SETTINGS)
    assert config.from_flat(settings_yaml.load(folder.settings_file)) == SETTINGS


def test_everything_a_run_leaves_lies_in_its_folder(tmp_path):
    folder = RunFolder(tmp_path, SETTINGS)
    places = [folder.settings_file, folder.checkpoints, folder.policies, folder.policy_file, folder.metrics_file,
              folder.summary_file]
    assert len(set(places)) == len(places)
    assert all(tmp_path in place.parents for place in places)


def test_the_same_run_opened_again_has_the_same_number(tmp_path):
    first = RunFolder(tmp_path, SETTINGS)
    again = RunFolder(tmp_path, config.from_flat({'beta': 0.5}))
    assert first.run == again.run and 0 < first.run < 2**63


def test_runs_of_other_settings_or_names_have_other_numbers(tmp_path):
    numbers = {RunFolder(tmp_path / name, replace(SETTINGS, run=replace(SETTINGS.run, seed=seed))).run
               for name, seed in (('a', 1), ('b', 1), ('c', 2), ('d', 3))}
    assert len(numbers) == 4


def test_a_run_that_was_moved_has_the_same_number(tmp_path):
    assert RunFolder(tmp_path / 'a' / 'mine', SETTINGS).run == RunFolder(tmp_path / 'b' / 'mine', SETTINGS).run


def test_a_folder_of_another_run_is_refused_and_left_as_it_is(tmp_path):
    folder = folder_with(tmp_path, [1])
    before = folder.settings_file.read_bytes()
    with pytest.raises(RunFolderError, match=f'^{tmp_path} holds a run with other settings; choose another name'):
        RunFolder(tmp_path, Settings())
    assert folder.settings_file.read_bytes() == before and newest_update(folder) == 1


def test_a_folder_that_cannot_be_written_is_an_error_that_names_it(tmp_path):
    file = tmp_path / 'file'
    file.write_text('in the way')
    for path in (file, file / 'below'):
        with pytest.raises(RunFolderError, match=f'^cannot write the run folder {path}: '):
            RunFolder(path, SETTINGS)


def test_a_new_run_has_no_checkpoint(tmp_path):
    assert RunFolder(tmp_path, SETTINGS).newest_checkpoint() is None


def test_a_checkpoint_comes_back_with_its_tensors_and_facts(tmp_path):
    folder = RunFolder(tmp_path, SETTINGS)
    told = {'updates': 7, 'seconds': 0.1 + 0.2, 'settings': 'é'}
    folder.save_checkpoint(7, tensors(7), {**told, 'mean_return': math.nan})
    saved, facts = RunFolder(tmp_path, SETTINGS).newest_checkpoint()
    assert saved.keys() == tensors(7).keys()
    for name, tensor in tensors(7).items():
        assert saved[name].dtype == tensor.dtype
        np.testing.assert_array_equal(saved[name], tensor)
    assert math.isnan(facts.pop('mean_return'))
    assert facts == told


@pytest.mark.parametrize('keep', [1, 3])
def test_the_newest_checkpoints_are_kept_and_older_ones_deleted(tmp_path, keep):
    folder = folder_with(tmp_path, range(1, 8), config.from_flat({'keep_checkpoints': keep}))
    assert len(list(folder.checkpoints.iterdir())) == keep
    for update in range(7, 7 - keep, -1):
        assert newest_update(folder) == update
        checkpoint_of(folder, update).unlink()
    assert newest_update(folder) is None


def test_every_so_often_a_checkpoint_is_kept_for_good(tmp_path):
    folder = folder_with(tmp_path, range(1, 12), config.from_flat({'keep_checkpoints': 2, 'keep_every': 4}))
    assert sorted(int(path.stem[11:]) for path in folder.checkpoints.iterdir()) == [4, 8, 10, 11]


def test_an_attempt_is_given_once_also_when_the_folder_is_opened_again(tmp_path):
    given = [RunFolder(tmp_path, SETTINGS).next_attempt() for _ in range(3)]
    folder = RunFolder(tmp_path, SETTINGS)
    assert [*given, folder.next_attempt(), folder.next_attempt()] == [0, 1, 2, 3, 4]


def test_a_number_of_attempts_that_cannot_be_read_is_an_error_that_names_its_file(tmp_path):
    folder = RunFolder(tmp_path, SETTINGS)
    (tmp_path / 'attempts').write_text('many')
    with pytest.raises(RunFolderError, match=f'^{tmp_path}/attempts should hold the number of attempts'):
        folder.next_attempt()


def test_what_a_killed_trainer_left_half_written_is_removed_by_the_next(tmp_path):
    folder = folder_with(tmp_path, [1])
    (folder.checkpoints / '.checkpoint_00000002.safetensors.12.part').write_bytes(b'half')
    assert newest_update(folder) == 1
    folder.claim().close()
    assert len(list(folder.checkpoints.iterdir())) == 1


def test_checkpoints_are_ordered_by_number_however_many_digits_they_have(tmp_path):
    folder = folder_with(tmp_path, [9, 99_999_999, 100_000_000])
    assert newest_update(folder) == 100_000_000


def test_a_checkpoint_saved_again_is_replaced(tmp_path):
    folder = folder_with(tmp_path, [1, 2, 2])
    folder.save_checkpoint(2, tensors(2), {'updates': 2, 'again': True})
    assert folder.newest_checkpoint()[1] == {'updates': 2, 'again': True}
    assert len(list(folder.checkpoints.iterdir())) == 2


@pytest.mark.parametrize('damage', [
    lambda data: data[:-1], lambda data: data[:20], lambda data: b'', lambda data: data[:-1] + bytes([data[-1] ^ 1])],
    ids=['torn at the end', 'torn at the start', 'empty', 'a bit flipped'])
def test_a_checkpoint_that_is_not_whole_is_passed_over_for_the_one_before(tmp_path, damage):
    folder = folder_with(tmp_path, [1, 2, 3])
    for spoiled, newest in ((3, 2), (2, 1), (1, None)):
        path = checkpoint_of(folder, spoiled)
        path.write_bytes(damage(path.read_bytes()))
        assert newest_update(RunFolder(tmp_path, SETTINGS)) == newest


def test_a_write_that_is_cut_short_leaves_the_checkpoints_there_were(tmp_path, monkeypatch):
    folder = folder_with(tmp_path, [1, 2])

    def fail(*arguments):
        raise OSError('no space left')

    for step in ('os.fsync', 'os.replace'):
        with monkeypatch.context() as patch:
            patch.setattr(step, fail)
            for update in (2, 3):
                with pytest.raises(FileError, match=f'^cannot write .*_0000000{update}.safetensors: no space left'):
                    folder.save_checkpoint(update, tensors(9), {'updates': 9})
        assert len(list(folder.checkpoints.iterdir())) == 2
        assert newest_update(RunFolder(tmp_path, SETTINGS)) == 2


WRITER = '''
import os, sys, time
from pathlib import Path
import numpy as np
from dae_ros import config
from dae_ros.run_folder import RunFolder

def stop_here(*arguments):
    print(flush=True)
    time.sleep(600)

folder = RunFolder(Path(sys.argv[1]), config.from_flat({'keep_checkpoints': 3, 'beta': 0.5}))
setattr(os, sys.argv[2], stop_here)
folder.save_checkpoint(2, {'weights': np.full((2, 3), 2, np.float32)}, {'updates': 2})
'''


@pytest.mark.parametrize('moment', ['fsync', 'replace'])
def test_a_writer_killed_in_the_middle_of_a_checkpoint_leaves_the_one_before(tmp_path, moment):
    folder = folder_with(tmp_path, [1])
    with subprocess.Popen([sys.executable, '-c', WRITER, str(tmp_path), moment], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b'\n'
        writer.kill()
    assert len(list(folder.checkpoints.iterdir())) == 2
    again = RunFolder(tmp_path, SETTINGS)
    again.claim().close()
    assert newest_update(again) == 1
    assert len(list(folder.checkpoints.iterdir())) == 1


def test_files_of_other_names_are_not_checkpoints(tmp_path):
    folder = folder_with(tmp_path, [1])
    good = checkpoint_of(folder, 1).read_bytes()
    for name in ('checkpoint_best.safetensors', '.checkpoint_00000009.safetensors.12', 'checkpoint_00000009.tmp'):
        (folder.checkpoints / name).write_bytes(good)
    assert newest_update(folder) == 1
    folder_with(tmp_path, range(2, 6))
    assert (folder.checkpoints / 'checkpoint_best.safetensors').exists()


def test_a_folder_belongs_to_one_trainer_at_a_time(tmp_path):
    folder, again = (RunFolder(tmp_path, SETTINGS) for _ in range(2))
    claim = folder.claim()
    with pytest.raises(RunFolderError, match=f'^another trainer is at work in {tmp_path}; '):
        again.claim()
    claim.close()
    again.claim().close()


def test_a_folder_that_can_only_be_read_is_an_error_that_names_it(tmp_path):
    folder = RunFolder(tmp_path, SETTINGS)
    (tmp_path / 'trainer.lock').mkdir()  # nobody may write here, root included
    with pytest.raises(RunFolderError, match=f'^cannot write the run folder {tmp_path}: '):
        folder.claim()


def test_the_same_folder_by_another_path_is_the_same_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert RunFolder(Path('runs/mine'), SETTINGS).run == RunFolder(tmp_path / 'runs' / 'mine', SETTINGS).run
