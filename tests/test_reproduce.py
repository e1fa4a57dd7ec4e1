"""`make reproduce`: what it declares, trains and resumes, and all of it in its short mode."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dae_ros import config, settings_yaml
from dae_ros.errors import RunFolderError, SettingsError
from dae_ros.run_folder import RunFolder
from dae_ros.weights.codec import decode_reward_network
from reproduce import figures, run, schedule
from reproduce.curves import COLUMNS
from reproduce.figures import Run
from reproduce.progress import Progress
from reproduce.records import Records, finished_file
from tests.pretended_runs import DECLARED, pretend_run

ROOT = Path(__file__).parent.parent
NAMES = [figure.name for figure in figures.load([])]
TINY = {'task': 'matrix_game', 'num_agents': 2, 'num_worlds': 2, 'num_steps': 2, 'hidden_size': 8, 'evaluation_episodes': 4,
        'epochs': 1, 'reward_network.epochs': 1, 'checkpoint_interval': 2, **figures.EVERY_RUN}


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
