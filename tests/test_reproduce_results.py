"""What `make reproduce` computes, tables, draws and keeps of runs."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from dae_ros import config
from dae_ros.report.metrics import STEPS, MetricsLog
from reproduce import figures, schedule
from reproduce.curves import POINTS, Curves
from reproduce.draw import composed
from reproduce.records import Records, finished_file
from reproduce.results import write_results
from reproduce.statistics import binned, mean_and_interval, steps_to_reach
from reproduce.tables import figure_block, replace_block
from tests.pretended_runs import DECLARED, pretend_run

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


# Results.

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
