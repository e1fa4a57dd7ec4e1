"""`make reproduce`: what it declares, trains, resumes, computes and writes."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student

from dae_ros import config, settings_yaml
from dae_ros.errors import RunFolderError, SettingsError
from dae_ros.report.metrics import STEPS, MetricsLog
from dae_ros.run_folder import RunFolder
from dae_ros.weights.codec import decode_reward_network
from reproduce import figures, run, schedule
from reproduce.curves import COLUMNS, POINTS, Curves
from reproduce.draw import composed
from reproduce.figures import Run
from reproduce.progress import Progress
from reproduce.records import Records, finished_file
from reproduce.results import write_results
from reproduce.statistics import binned, mean_and_interval, steps_to_reach
from reproduce.tables import figure_block, replace_block

ROOT = Path(__file__).parent.parent
NAMES = [figure.name for figure in figures.load([])]
TINY = {'task': 'matrix_game', 'num_agents': 2, 'num_worlds': 2, 'num_steps': 2, 'hidden_size': 8, 'evaluation_episodes': 4,
        'epochs': 1, 'reward_network.epochs': 1, 'checkpoint_interval': 2, **figures.EVERY_RUN}
DECLARED = '''
teams: {navigation: {3: {seeds: 2, steps: 6400}, 4: {seeds: 2, steps: 6400}}, line: {3: {seeds: 3, steps: 6400}}}
curves: {'low': {beta: 0.0}, 'high': {beta: 1.0}}
figures: {x: {title: Some tasks, shows: mean_return, curves: [low, high], average: true, baseline: low, threshold: 5}}
'''


def settings(**changes):
    return config.from_flat({**TINY, **changes})


def never():
    return False


def after(calls):
    """Holds from the last of so many calls on."""
    left = iter(range(calls - 1))
    return lambda: next(left, None) is None


def weights(path, steps):
    return json.loads(finished_file(path, steps).read_text())['weights_sha256']


def reproduce(folder, *arguments):
    places = ['--runs', str(folder / 'runs'), '--docs', str(folder / 'docs')]
    return [sys.executable, '-m', 'reproduce', *arguments, '--short', *places]


# Declarations.

@pytest.mark.parametrize('name', NAMES)
def test_every_run_of_every_figure_has_settings(name):
    figure, = figures.load([name])
    runs = figure.all_runs()
    assert len(runs) == len(set(runs)) and len({run.name for run in runs}) == sum(
        team.seeds for team in figure.teams) * len(figure.curves)
    assert all(run.settings.learner.learner_threads == 1 for run in runs)
    assert max(len(f'.{run.name}.json.4194304.part') for run in runs) <= 255  # bytes of a file's name: a record being written


def test_the_declared_sizes_are_those_asked_for():
    matrix_game, particles = figures.load(['1b', '4'])
    team, = matrix_game.teams
    assert (team.num_agents, team.seeds, team.steps, team.first_seed_steps) == (16, 5, 200_000, 1_000_000)
    assert [changes['beta'] for changes in matrix_game.curves.values()] == [0.0, 0.3, 0.6, 0.9, 1.0]
    assert particles.tasks == ['navigation', 'formation', 'line']
    assert [(team.num_agents, team.seeds) for team in particles.sizes('line')] == [(3, 5), (4, 2), (5, 2)]
    assert min(team.steps for team in particles.teams) >= 1_000_000


def test_options_replace_seeds_and_steps():
    figure, = figures.load(['1b'], seeds=2, steps=50_000)
    assert {(run.seed, run.settings.run.total_steps) for run in figure.all_runs()} == {(1, 50_000), (2, 50_000)}


@pytest.mark.parametrize('before, after, words', [
    ('title: Some tasks', 'titel: Some tasks', "figure x in .* has the unknown key 'titel'"),
    ('title: Some tasks, ', '', "lacks the key 'title'"),
    ('shows: mean_return', 'shows: speed', "cannot show 'speed'"),
    ('curves: [low, high]', 'curves: [low, higher]', "names the curve 'higher'"),
    ('baseline: low', 'baseline: lowest', "has the baseline 'lowest'"),
    ('baseline: low, ', '', 'has a threshold and no baseline'),
    ('threshold: 5', 'threshold: five', "threshold must be of type float, not 'five'"),
    ('threshold: 5', 'threshold: 5, until: 0', 'must show at least one step, not until 0'),
    ('seeds: 3', 'seeds: 0', 'must be integers of at least 1'),
    ('{3: {seeds: 3, steps: 6400}}', '5', 'teams of line .* must be a mapping, not 5'),
    ('{beta: 1.0}', '{betta: 1.0}', "curve high of figure x: unknown setting 'betta'; did you mean 'beta'"),
    ('{beta: 1.0}', '{beta: 7.0}', 'curve high of figure x: beta must lie in'),
    ('curves: {', 'curves: {{', 'is not YAML'),
])
def test_a_wrong_declaration_is_named(tmp_path, before, after, words):
    assert before in DECLARED
    (tmp_path / 'some.yaml').write_text(DECLARED.replace(before, after))
    with pytest.raises(SettingsError, match=words):
        figures.load([], folder=tmp_path)[0].all_runs()


def test_a_figure_that_is_not_declared_is_named():
    with pytest.raises(SettingsError, match='there is no figure 9; there are 3, 4-battles, 6, delayed, '):
        figures.load(['9'])


# Training.

def test_a_killed_run_goes_on_to_the_weights_of_one_that_was_not(tmp_path):
    long = settings(total_steps=400)
    command = [sys.executable, '-m', 'reproduce.run', str(tmp_path / 'killed'), json.dumps(config.flatten(long))]
    process = subprocess.Popen(command, cwd=ROOT)
    deadline = time.monotonic() + 60.0
    while not list((tmp_path / 'killed/checkpoints').glob('*.safetensors')):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not finished_file(tmp_path / 'killed', 400).exists()
    for name in ('killed', 'whole'):
        run.run(tmp_path / name, long, never)
    assert weights(tmp_path / 'killed', 400) == weights(tmp_path / 'whole', 400)


def test_a_stopped_run_loses_nothing(tmp_path):
    with pytest.raises(run.Stopped):
        run.run(tmp_path / 'stopped', settings(total_steps=24), after(3))
    assert Records(tmp_path, tmp_path).progress('stopped')[0] == 12
    for name in ('stopped', 'whole'):
        run.run(tmp_path / name, settings(total_steps=24), never)
    assert weights(tmp_path / 'stopped', 24) == weights(tmp_path / 'whole', 24)


def test_a_run_that_ended_goes_on_when_more_steps_are_wanted(tmp_path):
    for steps in (8, 24):
        run.run(tmp_path / 'longer', settings(total_steps=steps), never)
    run.run(tmp_path / 'whole', settings(total_steps=24), never)
    assert weights(tmp_path / 'longer', 24) == weights(tmp_path / 'whole', 24) != weights(tmp_path / 'longer', 8)
    records = Records(tmp_path, tmp_path)
    finished = {steps: records.finished(Run('longer', settings(total_steps=steps))) for steps in (8, 16, 24, 28)}
    assert finished == {8: True, 16: True, 24: True, 28: False}


def test_a_folder_of_other_settings_is_refused(tmp_path):
    run.run(tmp_path / 'run', settings(total_steps=8), never)
    with pytest.raises(RunFolderError, match='holds a run with other settings'):
        run.run(tmp_path / 'run', settings(total_steps=8, beta=0.5), never)


def test_a_run_is_trained_by_one_process_at_a_time(tmp_path):
    def again():
        with pytest.raises(RunFolderError, match='is being trained by another process'):
            run.run(tmp_path / 'run', settings(total_steps=8), never)
        return False

    run.run(tmp_path / 'run', settings(total_steps=8), again)


def test_a_run_may_begin_with_reward_networks_that_learnt_from_a_bag_of_its_own_seed(tmp_path):
    """They are trained once, and a run that is stopped meanwhile trains them again."""
    with pytest.raises(run.Stopped):
        run.run(tmp_path / 'run', settings(total_steps=32, num_worlds=8), after(4), pretrained=80)
    for name, frozen in (('run', False), ('frozen', True)):
        values = {'total_steps': 32, 'num_worlds': 8, 'reward_network.freeze': frozen}
        run.run(tmp_path / name, settings(**values), never, pretrained=80)
    file, = tmp_path.glob('pretrained/*/reward.safetensors')
    before = file.read_bytes()
    run.run(tmp_path / 'other', settings(total_steps=32, num_worlds=8, seed=2), never, pretrained=80)
    other, = set(tmp_path.glob('pretrained/*/reward.safetensors')) - {file}
    assert file.read_bytes() == before != other.read_bytes()
    learnt = {name: RunFolder(tmp_path / name, config.from_flat(settings_yaml.load(tmp_path / name / 'settings.yaml')))
              .newest_checkpoint()[0] for name in ('run', 'frozen')}
    for name, tensor in decode_reward_network(before)[0].items():
        member, _, parameter = name.partition('.')
        kept, moved = (learnt[run][f'reward_network.{member}.parameters.{parameter}'] for run in ('frozen', 'run'))
        assert np.array_equal(kept, tensor) and np.array_equal(moved, tensor) == (parameter == 'scale')


# Scheduling.

def test_first_seeds_come_first_and_what_goes_beyond_the_others_last(tmp_path):
    runs = [run for figure in figures.load(['4', '1b', '4'], seeds=2) for run in figure.all_runs()]
    todo = schedule.jobs(runs, Records(tmp_path, tmp_path))
    assert len(todo) == len(set(runs))
    places = [(job.begins_at > 0, job.run.seed, job.work(0)) for job in todo]
    assert places == sorted(places)
    assert {job.run.settings.run.total_steps for job in todo if job.begins_at} == {1_000_000}


@pytest.fixture
def pretending(monkeypatch):
    """Puts a shell command in place of each training."""
    def pretend(command):
        def start(run, records):
            records.path(run).mkdir(parents=True)
            with open(records.log_file(run), 'w') as log:
                return subprocess.Popen(['bash', '-c', command(run, records)], stdout=log, stderr=log)
        monkeypatch.setattr(schedule, '_start', start)
    return pretend


def test_a_failed_run_is_told_of_and_the_others_go_on(tmp_path, pretending, capsys):
    pretending(lambda run, records: 'echo no such luck; exit 3' if run.seed == 2 else pretend_run(run, records, 1.0))
    runs = [Run(f'run{seed}', settings(total_steps=8, seed=seed)) for seed in (1, 2, 3)]
    records, ended = Records(tmp_path, tmp_path), []
    with Progress() as progress:
        failed = schedule.train(schedule.jobs(runs, records), 2, records, progress, lambda: ended.append(True))
    assert failed == [runs[1]] and len(ended) == 2
    assert re.search(r'run2 failed with exit code 3:\s+no such luck', capsys.readouterr().out)
    assert [job.run for job in schedule.jobs(runs, records)] == failed


def test_an_interruption_stops_the_processes(tmp_path, pretending):
    pretending(lambda run, records: f'cd {records.path(run)}; trap "touch stopped; exit" TERM; touch begun; '
                                    'while true; do sleep 0.02; done')
    runs = [Run(f'run{seed}', settings(total_steps=8, seed=seed)) for seed in (1, 2, 3)]
    records = Records(tmp_path, tmp_path)

    class Interrupting(Progress):
        def update(self, waiting, running, records):
            if all((records.path(job.run) / 'begun').exists() for job in running):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Interrupting() as progress:
        schedule.train(schedule.jobs(runs, records), 2, records, progress, never)
    assert sorted(path.parent.name for path in tmp_path.glob('*/stopped')) == ['run1', 'run2']


# Numbers.

def test_the_interval_of_one_group_is_students():
    values = np.array([[1.0, 5.0], [2.0, 5.0], [6.0, 5.0]])
    mean, half = mean_and_interval([values])
    assert mean.tolist() == [3.0, 5.0]
    assert half[0] == pytest.approx(student.ppf(0.975, 2) * values[:, 0].std(ddof=1) / np.sqrt(3)) and half[1] == 0.0


def test_one_seed_has_no_interval():
    mean, half = mean_and_interval([np.array([[4.0], [6.0]]), np.array([[1.0]])])
    assert mean == [3.0] and np.isnan(half).all()


def test_the_interval_over_several_groups_holds_the_truth_as_often_as_it_says():
    draw, hits = np.random.default_rng(1), 0
    for _ in range(2000):
        mean, half = mean_and_interval([draw.normal(size, size, (count, 1)) for size, count in ((3, 5), (4, 2), (5, 2))])
        hits += abs(mean[0] - 4.0) <= half[0]
    assert 0.92 < hits / 2000 < 0.99


@pytest.mark.parametrize('values, width, expected', [
    ([1.0, 3.0, 5.0, 7.0, 100.0], 20, [2.0, 6.0]), ([1.0, np.nan, np.nan, np.nan], 20, [1.0, np.nan]), ([1.0, 3.0], 50, [2.0])])
def test_bins_are_means_of_whole_bins(values, width, expected):
    np.testing.assert_array_equal(binned(10 * np.arange(1, 1 + len(values)), np.array(values), width), expected)


def test_rows_that_are_bins_already_stay_as_they_are():
    np.testing.assert_array_equal(binned(np.array([20, 40, 60]), np.array([2.0, 6.0, 4.0]), 20), [2.0, 6.0, 4.0])


def test_the_threshold_is_reached_where_the_smoothed_curve_first_does():
    steps, values = np.arange(1.0, 101.0), np.repeat([0.0, 10.0], 50)
    values[10] = 10.0  # a peak that does not last
    assert steps_to_reach(5.0, steps, values) == 51.0
    assert steps_to_reach(11.0, steps, values) is None


# Results, from runs that are made up.

def pretend_run(run, records, level):
    """Leaves what a training leaves; returns a shell command that does nothing more."""
    path = records.path(run)
    log = MetricsLog(path)
    (path / 'settings.yaml').write_text(settings_yaml.dump(run.settings))
    for update in range(1, run.updates + 1):
        log.write(update * run.steps_per_update, {'mean_return': level + update, 'advantage/deviation': 1.0,
                                                  'seconds/collecting': 0.5, 'seconds/learning': 1.5})
    log.close()
    facts = {'environment_steps': run.steps, 'seconds': 3600.0, 'evaluation_return': level, 'versions': {'python': '3'},
             'machine': {'processor': 'abacus', 'cores': 2, 'system': 'wood', 'commit': 'abc'}, 'settings': {'num_agents': 3}}
    finished_file(path, run.steps).write_text(json.dumps(facts))
    return 'true'


@pytest.fixture
def made_up(tmp_path):
    """A figure of two tasks of which some runs are finished, and where."""
    (tmp_path / 'declared').mkdir()
    (tmp_path / 'declared/some.yaml').write_text(DECLARED)
    figure, = figures.load([], folder=tmp_path / 'declared')
    records = Records(tmp_path / 'runs', tmp_path / 'results')
    for curve, level in (('low', 1.0), ('high', 4.0)):
        for team in figure.teams:
            for each in figure.runs(team, curve)[:2]:
                pretend_run(each, records, level + each.seed)
    return figure, records


def test_tables_hold_means_intervals_and_paired_differences(made_up):
    block = figure_block(Curves(*made_up), made_up[1])
    assert '| navigation | 3, 4 | high | 2 + 2 | 6,400 | 7.50 ± ' in block
    assert '| line | 3 | low | 2 of 3 | 6,400 | 4.50 ± 6.35 | 2.50 ± 6.35 |' in block
    assert '| navigation | 3, 4 | high − low | 2 + 2 | 3.00 ± 0.00 |' in block
    assert '| line | 3 | high | 2 of 3 | 3,200 | ' in block and 'not within 6,400' in block
    assert '`evaluation_episodes`' not in block and '`beta` 1.0' in block and 'abacus, 2 cores, wood' in block


def test_a_figure_can_end_before_its_runs(made_up):
    figure, records = made_up
    whole, part = Curves(figure, records), Curves(replace(figure, until=figure.teams[-1].steps // 2), records)
    for key, seeds in part.seeds.items():
        for seed, entire in zip(seeds, whole.seeds[key], strict=True):
            assert 0 < len(seed.steps) < len(entire.steps) and seed.steps[-1] <= figure.teams[-1].steps // 2
            assert np.array_equal(seed.metrics['mean_return'], entire.metrics['mean_return'][:len(seed.steps)])
    assert '| line | 3 | low | 2 of 3 | 3,200 | 3.50 ± ' in figure_block(part, records)


def test_nothing_is_told_of_the_credit_before_it_was_first_measured(made_up):
    figure, records = made_up
    each = figure.runs(figure.teams[0], 'high')[0]
    log = MetricsLog(records.path(each) / 'credit')
    log.write(each.steps, {'explained': 0.75, 'credit_explained': 0.5})
    log.close()
    told = Curves(figure, records).seeds[figure.teams[0], 'high'][0].metrics['expected_reward/explained']
    assert np.isnan(told[:-1]).all() and told[-1] == 0.75


def test_an_average_leaves_out_a_team_size_that_a_curve_lacks(made_up):
    figure, records = made_up
    for each in figure.runs(figure.teams[1], 'low'):
        finished_file(records.path(each), each.steps).unlink()
    assert [team.num_agents for team in Curves(figure, records).averaged('navigation')] == [3]


def test_a_figure_over_seconds_takes_the_time_of_the_updates(made_up):
    figure, records = made_up
    band = Curves(replace(figure, against='seconds'), records).band([figure.teams[0]], 'low', 'mean_return')
    np.testing.assert_allclose(band.steps, 2.0 * np.arange(1, 1 + len(band.steps)))


def test_of_two_seeds_each_is_drawn_and_of_three_their_interval(made_up):
    figure, records = made_up
    third = figure.run(figure.teams[2], 'low', 3)
    pretend_run(third, records, 7.0)
    curves = Curves(replace(figure, shows='advantage/deviation', average=False), records)
    line, = (axes for axes in composed(curves).axes if axes.get_title('left').startswith('line'))
    low, high = curves.seeds[figure.teams[2], 'low'], curves.seeds[figure.teams[2], 'high']
    assert (len(low), len(high)) == (3, 2)
    assert len(line.collections) == 1 and len(line.lines) == 2 + len(high)


def test_a_scattered_figure_shows_where_every_seed_ended(made_up, tmp_path):
    figure, records = made_up
    for team in figure.teams:
        for number, each in enumerate(figure.runs(team, 'high')[:2]):
            log = MetricsLog(records.path(each) / 'credit')
            log.write(each.steps, {'explained': 0.5 + number / 10, 'credit_explained': -1.0})
            log.close()
    scattered = replace(figure, against='expected_reward/explained', threshold=None, average=False)
    curves = Curves(scattered, records)
    ends = [seed.metrics['expected_reward/explained'][-1] for seed in curves.seeds[figure.teams[0], 'high']]
    assert ends == [0.5, 0.6]
    write_results([scattered], records, tmp_path)
    assert (tmp_path / 'results/x.png').read_bytes().startswith(b'\x89PNG')


def test_what_is_written_beside_the_markers_survives(made_up, tmp_path):
    figure, records = made_up
    write_results([figure], records, tmp_path)
    text = (tmp_path / 'results.md').read_text()
    (tmp_path / 'results.md').write_text(text.replace('## Figure x\n', '## Figure x\n\nBy hand.\n').replace('abacus', 'sundial'))
    write_results([figure], records, tmp_path)
    assert (tmp_path / 'results.md').read_text() == text.replace('## Figure x\n', '## Figure x\n\nBy hand.\n')


def test_results_are_drawn_from_records_where_the_runs_are_gone(made_up, tmp_path):
    figure, records = made_up
    first = figure.runs(figure.teams[0], 'high')[0]
    log = MetricsLog(records.path(first) / 'credit')
    for steps in (3200, 6400):
        log.write(steps, {'explained': 1 / 3, 'credit_explained': -1.0})
    log.close()
    write_results([figure], records, tmp_path)
    before = {file: file.read_bytes() for file in (tmp_path / 'results').glob('*.*')}
    text = (tmp_path / 'results.md').read_text()
    shutil.rmtree(records.folder)
    write_results([figure], records, tmp_path)
    assert (tmp_path / 'results.md').read_text() == text and len(before) == 2
    assert {file: file.read_bytes() for file in before} == before
    missing = [job.run for job in schedule.jobs(figure.all_runs(), records)]
    assert missing == [figure.run(figure.teams[2], curve, 3) for curve in ('low', 'high')]


def test_a_record_of_other_settings_is_not_taken_for_the_run(made_up, tmp_path):
    figure, records = made_up
    first = figure.runs(figure.teams[0], 'low')[0]
    records.keep(first)
    shutil.rmtree(records.folder)
    assert records.finished(first)
    assert not records.finished(replace(first, settings=config.from_flat({'gamma': 0.9}, first.settings)))
    assert records.finished(replace(first, settings=config.from_flat({'reward_network.epochs': 3}, first.settings)))  # beta is 0
    shorter = replace(first, settings=config.from_flat({'total_steps': 3200}, first.settings))
    assert records.finished(shorter) and records.facts(shorter) is None and records.metrics(shorter)[STEPS].tolist() == [3200]
    file, = tmp_path.glob('results/runs/*.json')
    file.write_text(file.read_text().replace('"gamma"', '"of_old"'))
    assert not records.finished(first)


def test_a_longer_record_stays_when_a_shorter_run_is_trained_again(made_up):
    figure, records = made_up
    first = figure.runs(figure.teams[0], 'low')[0]
    records.keep(first)
    shutil.rmtree(records.path(first))
    shorter = replace(first, settings=config.from_flat({'total_steps': 3200}, first.settings))
    pretend_run(shorter, records, 9.0)
    records.keep(shorter)
    assert records.metrics(first)['mean_return'].tolist() == [3.0, 4.0]


def test_a_block_replaces_only_its_own():
    text = replace_block(replace_block('Top.\n', '1', 'one'), '2', r'two \1')
    assert replace_block(text, '1', 'uno') == text.replace('one', 'uno')


def test_csv_rows_are_few_and_the_longer_run_is_in_them_once(tmp_path):
    figure, = figures.load(['1b'])
    team, = figure.teams
    records = Records(tmp_path / 'runs', tmp_path / 'results')
    longer = figure.longer_run(team, 'beta 1')
    pretend_run(longer, records, 1.0)
    Curves(figure, records).write_csv(tmp_path / 'some.csv')
    rows = list(csv.DictReader(open(tmp_path / 'some.csv', encoding='utf-8')))
    assert {(row['task'], row['num_agents'], row['curve'], row['seed']) for row in rows} == {('matrix_game', '16', 'beta 1', '1')}
    steps = [int(row['environment_steps']) for row in rows]
    assert steps == sorted(set(steps)) and steps[-1] > 0.99 * longer.steps
    assert len([step for step in steps if step <= 200_704]) <= 2 * POINTS
    assert rows[0]['mean_return'] == '2' and rows[0]['reward_explained_variance'] == ''


# All of it, for real.

@pytest.mark.slow  # a process for each of some twenty runs
def test_every_figure_is_trained_drawn_and_tabled_in_its_short_mode(tmp_path):
    done = subprocess.run(reproduce(tmp_path), cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    text = (tmp_path / 'docs/results.md').read_text()
    for figure in figures.load(NAMES, short=True):
        if not figure.is_playable:
            assert figure.name in done.stdout.split('left out: figures ')[1].splitlines()[0]
            continue
        assert f'<!-- generated: figure {figure.name} -->' in text
        assert (tmp_path / f'docs/results/{figure.name}.png').read_bytes().startswith(b'\x89PNG')
        rows = list(csv.DictReader(open(tmp_path / f'docs/results/{figure.name}.csv', encoding='utf-8')))
        assert {row['curve'] for row in rows} == set(figure.curves) and set(COLUMNS.values()) <= rows[0].keys()
    again = subprocess.run(reproduce(tmp_path, '1b'), cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert again.returncode == 0 and '0 runs to train' in again.stdout and (tmp_path / 'docs/results.md').read_text() == text


@pytest.mark.slow  # a real run
def test_a_signal_stops_the_runs_and_says_how_to_go_on(tmp_path):
    process = subprocess.Popen(reproduce(tmp_path, '4', '--steps', '1000000', '--workers', '1'), cwd=ROOT, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60.0
    while not any(path.stat().st_size for path in tmp_path.glob('runs/*/metrics.csv')):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130 and 'the same command goes on from here' in said
    stopped, = tmp_path.glob('runs/*')
    assert 'stopped; it goes on' in (stopped / 'log.txt').read_text() and list(stopped.glob('checkpoints/*.safetensors'))


def test_short_results_never_replace_the_real_ones():
    done = subprocess.run([sys.executable, '-m', 'reproduce', '--short'], cwd=ROOT, capture_output=True, text=True, timeout=60,
                          env={**os.environ, 'COLUMNS': '200'})
    assert done.returncode == 2 and '--short needs --runs and --docs' in done.stderr
