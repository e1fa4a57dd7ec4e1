"""What a run leaves for people: metrics, pictures, summary and progress, written for real and read back."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pty
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dae_ros.config import TaskSettings
from dae_ros.files import write_atomically
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.report.episode import EPISODES, STRIP_FRAMES, draw_animation, draw_strip, record_episodes
from dae_ros.report.learning_curve import apart, plot_learning_curve, smoothed
from dae_ros.report.metrics import MetricsLog, read_metrics
from dae_ros.report.progress import ProgressDisplay
from dae_ros.report.summary import Summary
from dae_ros.worlds import world_spec

YARDSTICKS = {'no-op': (-203.7, 0.7), 'random': (-218.1, 0.7), 'greedy': (-114.7, 0.3)}
SUMMARY = Summary(task='navigation', num_agents=3, beta=0.95, seed=1, environment_steps=502_400, seconds=175.0,
                  steps_per_second=2866.2, policy='greedy', evaluation_return=-131.8, evaluation_standard_error=0.6,
                  evaluation_episodes=1024, yardsticks={name: list(value) for name, value in YARDSTICKS.items()},
                  weights_sha256='ab' * 32)


def random_policy(task: TaskSettings) -> Policy:
    spec, draw = world_spec(task), np.random.default_rng(0)
    architecture = PolicyArchitecture(spec.observation_size, spec.num_actions, 16, 1, 'tanh')
    return Policy(architecture, {name: draw.standard_normal(shape).astype(np.float32)
                                 for name, shape in architecture.shapes().items()})


def colours(path) -> int:
    with Image.open(path) as picture:
        return len(np.unique(np.asarray(picture.convert('RGB')).reshape(-1, 3), axis=0))


def test_metrics_are_a_table_and_tensorboard_events(tmp_path):
    log = MetricsLog(tmp_path)
    for steps in (100, 200):
        log.write(steps, {'mean_return': -steps / 2, 'policy/entropy': 1.5})
    log.close()
    columns = read_metrics(tmp_path / 'metrics.csv')
    assert list(columns) == ['environment_steps', 'mean_return', 'policy/entropy']
    np.testing.assert_array_equal(columns['environment_steps'], [100, 200])
    np.testing.assert_array_equal(columns['mean_return'], [-50, -100])
    events = EventAccumulator(str(tmp_path / 'tensorboard')).Reload().Scalars('mean_return')
    assert [(event.step, event.value) for event in events] == [(100, -50), (200, -100)]


def test_a_row_with_other_metrics_than_the_first_is_a_bug(tmp_path):
    log = MetricsLog(tmp_path)
    log.write(100, {'mean_return': 1.0})
    with pytest.raises(ValueError, match='entropy'):
        log.write(200, {'mean_return': 1.0, 'entropy': 2.0})
    log.close()


def test_a_resumed_log_drops_what_came_after_the_checkpoint_and_a_torn_last_line(tmp_path):
    log = MetricsLog(tmp_path)
    for steps in (100, 200, 300):
        log.write(steps, {'mean_return': float(steps)})
    log.close()
    with open(tmp_path / 'metrics.csv', 'a') as file:
        file.write('400,4')
    resumed = MetricsLog(tmp_path, resume_at=200)
    resumed.write(300, {'mean_return': 333.0})
    resumed.close()
    columns = read_metrics(tmp_path / 'metrics.csv')
    np.testing.assert_array_equal(columns['environment_steps'], [100, 200, 300])
    np.testing.assert_array_equal(columns['mean_return'], [100, 200, 333])


@pytest.mark.parametrize('rows', [1, 60])
@pytest.mark.parametrize('with_reward_network', [True, False])
def test_a_learning_curve_is_drawn_for_any_run(rows, with_reward_network, tmp_path):
    steps = np.arange(1, rows + 1) * 3200.0
    metrics = {'environment_steps': steps, 'mean_return': np.where(steps == 3200, math.nan, -200 + steps / 2000),
               'policy/entropy': np.linspace(1.6, 1.0, rows), 'value/loss': np.linspace(1, 0.1, rows)}
    if with_reward_network:
        metrics['reward_network/explained_variance'] = np.linspace(-3, 0.9, rows)
    plot_learning_curve(metrics, YARDSTICKS, 'navigation', tmp_path / 'curve.png')
    assert colours(tmp_path / 'curve.png') > 20


def test_labels_that_would_overlap_are_moved_apart_and_others_stay():
    heights = apart(np.array([0.1, 0.5, 0.52, 0.9]), 0.1)
    np.testing.assert_allclose(heights, [0.1, 0.46, 0.56, 0.9])


def test_smoothing_keeps_constants_and_the_mean_of_what_is_near():
    np.testing.assert_allclose(smoothed(np.full(50, 3.0)), 3.0)
    assert smoothed(np.arange(100.0))[50] == pytest.approx(50)


@pytest.mark.parametrize('task', [TaskSettings(), TaskSettings(num_agents=5), TaskSettings(task='formation'),
                                  TaskSettings(task='line', episode_steps=7)], ids=str)
def test_episodes_of_robots_with_a_place_are_animated_and_shown_as_a_strip(task, tmp_path):
    episodes = record_episodes(task, random_policy(task), seed=1)
    length = task.episode_steps or 25
    assert episodes.positions.shape == (length, EPISODES, task.num_agents, 2)
    np.testing.assert_array_equal(episodes.lengths, length)
    draw_animation(episodes, tmp_path / 'episode.gif')
    with Image.open(tmp_path / 'episode.gif') as animation:
        assert animation.n_frames == length
    draw_strip(episodes, tmp_path / 'episode.png')
    with Image.open(tmp_path / 'episode.png') as strip:
        assert strip.width > STRIP_FRAMES * 200
    assert colours(tmp_path / 'episode.png') > 20


@pytest.mark.parametrize('task', [TaskSettings(task='matrix_game', num_agents=4),
                                  TaskSettings(task='pettingzoo:mpe2.simple_spread_v3')], ids=lambda task: task.task)
def test_episodes_of_robots_without_a_place_are_shown_by_their_actions(task, tmp_path):
    episodes = record_episodes(task, random_policy(task), seed=1)
    assert episodes.positions is None and episodes.lengths[0] > 0
    draw_strip(episodes, tmp_path / 'episode.png')
    assert colours(tmp_path / 'episode.png') > 20


def test_the_same_seed_records_the_same_episodes_and_another_seed_others():
    task, policy = TaskSettings(), random_policy(TaskSettings())
    first, again, other = (record_episodes(task, policy, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.positions, again.positions)
    assert not np.array_equal(first.positions, other.positions)


@pytest.mark.parametrize('summary', [SUMMARY, dataclasses.replace(SUMMARY, evaluation_return=None, evaluation_episodes=0,
                                                                  evaluation_standard_error=None)])
def test_a_summary_comes_back_from_its_file_as_it_was(summary, tmp_path):
    summary.write(tmp_path / 'summary.json')
    assert Summary.read(tmp_path / 'summary.json') == summary
    assert json.loads((tmp_path / 'summary.json').read_text())['weights_sha256'] == 'ab' * 32


def test_the_last_lines_tell_how_many_battles_were_won():
    assert 'fresh episodes, 94% won' in dataclasses.replace(SUMMARY, evaluation_win_rate=0.9375).lines()
    assert 'won' not in SUMMARY.lines()


def test_the_last_lines_show_the_trained_team_between_the_yardsticks():
    lines = SUMMARY.lines().splitlines()
    order = [line.split()[0] for line in lines if '±' in line]
    assert order == ['random', 'no-op', 'trained', 'greedy']
    text = SUMMARY.lines()
    for fact in ('navigation', 'seed 1', '502,400', '175 s', '2,866', '−131.8 ± 0.6', '1024 fresh episodes', 'ab' * 32):
        assert fact in text


def test_a_file_that_cannot_be_replaced_keeps_its_old_content(tmp_path):
    target = tmp_path / 'file'
    write_atomically(target, b'old')
    with pytest.raises(TypeError):
        write_atomically(target, 'not bytes')
    assert target.read_bytes() == b'old'


def test_progress_without_a_terminal_is_a_line_for_each_change_of_state(capsys):
    with ProgressDisplay() as display:
        display.update('waiting', 0, 1000, math.nan, 0.0, 0)
        for step in range(10):
            display.update('collecting' if step % 2 else 'learning', 100 * step, 1000, -150.0, 200.0, step)
        display.update('evaluating', 1000, 1000, -150.0, 200.0, 10)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(':')[0] for line in lines] == ['waiting', 'training', 'evaluating']
    assert 'nan' not in ''.join(lines) and 'return −150.0' in lines[1]


def test_the_terminal_is_given_back_after_an_error():
    program = ('from dae_ros.report.progress import ProgressDisplay\n'
               'with ProgressDisplay() as display:\n'
               '    display.update("training", 500, 1000, -150.0, 200.0, 5)\n'
               '    raise SystemExit(3)\n')
    ours, theirs = pty.openpty()
    environment = {**os.environ, 'TERM': 'xterm', 'COLUMNS': '80'}
    process = subprocess.Popen([sys.executable, '-c', program], stdout=theirs, env=environment)
    os.close(theirs)
    shown = b''
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # Linux's way of saying that the other end was closed
            break
        shown += part
    assert process.wait() == 3
    assert b'return' in shown
    assert shown.rindex(b'\x1b[?25h') > shown.rindex(b'\x1b[?25l')
