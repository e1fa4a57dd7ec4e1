"""What `make bench-peers` makes of its measurements; the speeds themselves are nobody's promise here."""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest

from benchmarks import bags, results
from benchmarks.machine import ROOT, Bystanders
from benchmarks.peers import contender, environments, match
from benchmarks.peers.contender import Block, Contender, ContenderFailed, Running
from benchmarks.peers.match import Comparison, Match
from benchmarks.peers.outcome import Row, disturbance, outcome
from benchmarks.peers.plot import plot
from dae_ros import config, settings_yaml
from dae_ros.replay.played import write_rollouts


def row(name, *speeds, bystanders=0.0):
    return Row(name, {}, tuple(Block(speed, bystanders) for speed in speeds))


def played(*rows, others=('fast', 'slow'), target=2.0):
    return outcome(Match('a match', (), (Comparison('ours', others, target),)), rows)


def test_medians_count_and_the_best_of_the_others_is_compared_with():
    ratio, = played(row('ours', 300.0, 10.0, 200.0), row('slow', 50.0), row('fast', 90.0, 110.0)).ratios
    assert (ratio.other, ratio.value) == ('fast', 2.0)


@pytest.mark.parametrize('speed, target, verdict', [
    (200.0, 2.0, 'reached: at least 2.0'), (199.0, 2.0, 'missed: at least 2.0'), (1.0, None, '')])
def test_a_ratio_says_whether_it_reaches_its_target(speed, target, verdict):
    ratio, = played(row('ours', speed), row('fast', 100.0), target=target).ratios
    assert ratio.verdict == verdict


def test_a_comparison_goes_on_without_those_left_out_and_needs_one_of_each_side():
    assert played(row('ours', 60.0), row('slow', 30.0)).ratios[0].other == 'slow'
    assert played(row('ours', 60.0)).ratios == played(row('slow', 30.0)).ratios == ()


def test_the_machine_was_quiet_only_if_it_was_so_in_every_turn():
    quiet, busy = played(row('ours', 1.0, 1.0, bystanders=0.01)), played(row('ours', 1.0, bystanders=0.7))
    assert disturbance([quiet]) == ''
    assert 'in 1 of 3 turns' in disturbance([quiet, busy]) and '0.7' in disturbance([quiet, busy])


def test_a_measured_process_is_no_bystander_of_its_own():
    while_measured = Bystanders(os.getpid()), Bystanders(1)
    begin = sum(os.times()[:2])
    while sum(os.times()[:2]) < begin + 0.3:
        pass
    mine, all_but_the_first = (bystanders.cores() for bystanders in while_measured)
    assert 0.0 <= mine < all_but_the_first


def test_a_result_replaces_its_own_key_and_leaves_the_others(tmp_path):
    path = tmp_path / 'results.json'
    for key, value in (('bench', 1), ('peers', 2), ('peers', 3)):
        results.merge(key, {'value': value}, path)
    assert json.loads(path.read_text()) == {'bench': {'value': 1}, 'peers': {'value': 3}}


def test_an_outcome_becomes_a_table_a_record_and_a_picture(tmp_path):
    one = played(row('ours', 1234.4, 1300.0, bystanders=0.123), row('fast', 500.0))
    assert '1,267' in one.table() and 'reached' in one.table()
    record = json.loads(json.dumps(one.record()))
    assert record['rows'][0]['rounds'] == [1234, 1300] and record['ratios'][0]['value'] == 2.534
    plot([one, one], 'two matches', tmp_path / 'picture.png')
    assert (tmp_path / 'picture.png').read_bytes().startswith(b'\x89PNG')


DRIVER = """
import sys
from clock import Clock

print('libraries talk')
clock = Clock(10, 'numpy')
for unit in range(int(sys.argv[1])):
    clock.tick()
print('ended', file=sys.stderr)
"""


@pytest.fixture
def driver(tmp_path, monkeypatch):
    (tmp_path / 'drivers').mkdir()
    (tmp_path / 'drivers/driver.py').write_text(DRIVER)
    (tmp_path / 'drivers/clock.py').symlink_to(contender.DRIVERS / 'clock.py')
    monkeypatch.setattr(contender, 'DRIVERS', tmp_path / 'drivers')
    return lambda units: Running(Contender('somebody', '', 'driver.py', (str(units),)), tmp_path / 'run')


def test_a_driver_warms_up_and_then_works_when_asked(driver):
    with driver(1000) as running:
        assert running.warm_up() > 0.0
        assert set(running.versions) == {'numpy'}
        assert running.measure(5).speed > 0.0 and running.measure(7).speed > 0.0


def test_a_driver_that_ends_early_is_told_of_with_its_last_words(driver):
    with driver(3) as running:
        running.warm_up()
        with pytest.raises(ContenderFailed, match='somebody ended before its time; its last words: ended'):
            running.measure(5)


def test_without_a_checkout_only_jaxmarls_training_is_missing(tmp_path):
    names = {one.name for one in match.training(None).contenders}
    assert {one.name for one in match.training(tmp_path).contenders} - names == {match.JAXMARL_MAPPO}


def test_every_contender_has_a_driver_and_our_settings_exist(tmp_path):
    matches = [match.training(tmp_path), match.simulation(match.NUM_WORLDS), match.simulation(match.MANY_WORLDS)]
    for one in (one for each in matches for one in each.contenders):
        assert (contender.DRIVERS / one.driver).is_file()
        assert not one.environment or (environments.LISTS / f'{one.environment}.txt').is_file()
        if one.driver == 'train_ours.py':
            config.from_flat(dict(map(settings_yaml.parse_override, one.arguments)))
    for each in matches:
        names = {one.name for one in each.contenders}
        assert all({comparison.ours, *comparison.others} <= names for comparison in each.comparisons)


@pytest.mark.parametrize('path', sorted(environments.LISTS.glob('*.txt')), ids=lambda path: path.stem)
def test_peers_are_pinned_and_bring_no_gpu_parts_nor_addresses(path):
    lines = path.read_text().splitlines()
    if path.stem != 'without':
        assert all('==' in line for line in lines)
        assert not [line for line in lines if line.startswith(('nvidia', 'cuda', 'triton', 'torch=='))]
    assert '://' not in path.read_text()


def test_a_peer_that_needs_a_newer_python_says_so(monkeypatch):
    monkeypatch.setattr(environments, 'OLDEST_PYTHON', {'jaxmarl': (9, 0)})
    with pytest.raises(environments.CannotInstall, match='jaxmarl needs Python 9.0'):
        environments.prepare('jaxmarl')


def test_an_environment_is_made_once_and_made_anew_when_its_list_changes(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(environments, 'ROOT', tmp_path)
    monkeypatch.setattr(environments, 'FOLDER', tmp_path / '.peers')
    monkeypatch.setattr(environments, 'LISTS', tmp_path)
    monkeypatch.setattr(environments.venv, 'create', lambda folder, with_pip: (folder.mkdir(parents=True), made.append(folder)))
    monkeypatch.setattr(environments, '_install', lambda python, name, *what: None)
    for pins in ('a==1', 'a==1', 'a==2'):
        (tmp_path / 'peer.txt').write_text(pins)
        assert environments.prepare('peer') == tmp_path / '.peers/peer/bin/python'
    assert len(made) == 2


def test_a_peer_that_cannot_be_installed_says_why(tmp_path):
    refusing = tmp_path / 'python'
    refusing.write_text('#!/bin/sh\necho "no such package" >&2\nexit 1\n')
    refusing.chmod(refusing.stat().st_mode | stat.S_IXUSR)
    with pytest.raises(environments.CannotInstall, match='^peer could not be installed: .*$'):
        environments._install(refusing, 'peer', '--requirement', str(tmp_path / 'missing.txt'))


def test_peers_do_not_see_our_own_packages(monkeypatch):
    monkeypatch.setenv('PYTHONPATH', str(ROOT))
    assert 'PYTHONPATH' not in environments.clean_environment()
    assert Path(sys.prefix).name not in environments.clean_environment().get('VIRTUAL_ENV', '')


# What bags are measured with, in small.

TEAM = {'task': 'matrix_game', 'num_agents': 2, 'num_steps': 4, 'num_worlds': 8}


@pytest.fixture
def bag(tmp_path):
    write_rollouts(tmp_path / 'bag', bags.played(config.from_flat(TEAM), 320), bags.SCHEMAS)
    return tmp_path / 'bag'


def test_a_message_that_a_recording_lacks_is_counted(bag, tmp_path):
    settings = config.from_flat({**TEAM, 'total_steps': 320})
    everything = 10 * (1 + 5 + 4 + 2 * 4)
    assert bags.lost(bag, settings) == (everything, 0)
    assert bags.lost(bag, config.from_flat({'total_steps': 352}, settings)) == (everything, everything // 10)
    played = list(bags.played(settings, 320))
    write_rollouts(tmp_path / 'shorter', played[:-1], bags.SCHEMAS)
    assert bags.lost(tmp_path / 'shorter', settings) == (everything * 9 // 10, everything // 10)


def test_bags_are_read_and_learnt_from_in_small(bag):
    assert bags.reading(bag, 2) > 0
    found = bags.learning(bag, config.from_flat({**TEAM, **bags.NETWORK, 'reward_network.hidden_size': 16}), 64, max_epochs=2)
    assert found['times_better'] == pytest.approx(found['mean_reward_error'] / found['held_out_error'])
