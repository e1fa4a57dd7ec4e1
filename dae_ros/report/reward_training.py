"""What the training of a reward network from bags leaves for people: report.json and report.png."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dae_ros.files import write_atomically
from dae_ros.replay.reward_training import HeldOut
from dae_ros.report.style import BLUE, FAINT, GREY, INK, ROBOTS, plain


def write_report(folder: Path, facts: Mapping[str, Any], errors: Sequence[float], baseline: float, held_out: HeldOut) -> None:
    """Writes the facts as JSON and the pictures of them.

    errors: held-out mean squared error after each epoch; baseline: the mean reward's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / 'report.json', (json.dumps(facts, indent=2, allow_nan=False) + '\n').encode())
    known = held_out.true_expected is not None
    figure = Figure(figsize=(16.0 if known else 12.0, 3.8), layout='constrained')
    FigureCanvasAgg(figure)
    curve, scatter, episode, *truth = figure.subplots(1, 4 if known else 3)
    _draw_errors(curve, errors, baseline)
    _draw_predictions(scatter, 'reward of held-out steps', 'paid', np.repeat(held_out.rewards, held_out.predicted.shape[1]),
                      held_out.predicted.ravel())
    _draw_credit(episode, held_out.credit, held_out.true_credit)
    if known:
        _draw_predictions(truth[0], 'E[r] over own actions of held-out steps', 'true', held_out.true_expected.ravel(),
                          held_out.expected.ravel())
    figure.savefig(folder / 'report.png', dpi=150, format='png')


def _axes(axes: Axes, title: str, x: str, y: str) -> None:
    plain(axes)
    axes.set_title(title, loc='left', fontsize=10, color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)


def _draw_errors(axes: Axes, errors: Sequence[float], baseline: float) -> None:
    _axes(axes, 'held-out episodes', 'epoch', 'mean squared error')
    axes.grid(axis='y', color=FAINT, linewidth=0.6)
    epochs = np.arange(1, len(errors) + 1)
    best = int(np.argmin(errors))
    axes.plot(epochs, errors, color=BLUE, linewidth=1.6)
    axes.plot(epochs[best], errors[best], 'o', color=BLUE, markersize=6, label=f'best  {errors[best]:.3g}')
    axes.axhline(baseline, color=GREY, linewidth=0.9, linestyle=(0, (5, 3)), label=f'mean reward  {baseline:.3g}')
    if min(errors) > 0 and baseline > 0:
        axes.set_yscale('log')
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.legend(frameon=False, fontsize=8)


def _draw_predictions(axes: Axes, title: str, x: str, truth: np.ndarray, predicted: np.ndarray) -> None:
    _axes(axes, title, x, 'predicted')
    ends = [min(truth.min(), predicted.min()), max(truth.max(), predicted.max())]
    axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.plot(truth, predicted, '.', color=BLUE, alpha=0.2, markersize=3)


def _draw_credit(axes: Axes, credit: np.ndarray, truth: np.ndarray | None) -> None:
    known = '' if truth is None else ' (dashed: true)'
    _axes(axes, f'credit in one held-out episode{known}', 'step', 'r − E[r] over own actions')
    axes.axhline(0, color=GREY, linewidth=0.6)
    for robot, values in enumerate(credit.T):
        axes.plot(values, color=ROBOTS[robot % len(ROBOTS)], linewidth=1.3, marker='.' if len(credit) < 30 else '',
                  label=f'robot {robot}')
        if truth is not None:
            axes.plot(truth[:, robot], color=ROBOTS[robot % len(ROBOTS)], linewidth=1.0, linestyle=(0, (4, 2)))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if credit.shape[1] <= len(ROBOTS):
        axes.legend(frameon=False, fontsize=8)
