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
from dae_ros.report.style import BLUE, FAINT, GREY, INK, ROBOTS, plain


def write_report(folder: Path, facts: Mapping[str, Any], errors: Sequence[float], baseline: float, rewards: np.ndarray,
                 predicted: np.ndarray, credit: np.ndarray) -> None:
    """Writes the facts as JSON and the pictures of them.

    errors: held-out mean squared error after each epoch; baseline: the mean reward's. rewards [steps] and predicted
    [steps, N]: of held-out steps. credit [steps, N]: of one held-out episode.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / 'report.json', (json.dumps(facts, indent=2, allow_nan=False) + '\n').encode())
    figure = Figure(figsize=(12.0, 3.8), layout='constrained')
    FigureCanvasAgg(figure)
    curve, scatter, episode = figure.subplots(1, 3)
    _draw_errors(curve, errors, baseline)
    _draw_predictions(scatter, rewards, predicted)
    _draw_credit(episode, credit)
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


def _draw_predictions(axes: Axes, rewards: np.ndarray, predicted: np.ndarray) -> None:
    _axes(axes, 'reward of held-out steps', 'paid', 'predicted')
    ends = [min(rewards.min(), predicted.min()), max(rewards.max(), predicted.max())]
    axes.plot(ends, ends, color=GREY, linewidth=0.8)
    axes.plot(np.repeat(rewards, predicted.shape[1]), predicted.ravel(), '.', color=BLUE, alpha=0.2, markersize=3)


def _draw_credit(axes: Axes, credit: np.ndarray) -> None:
    _axes(axes, 'credit in one held-out episode', 'step', 'r − E[r] over own actions')
    axes.axhline(0, color=GREY, linewidth=0.6)
    for robot, values in enumerate(credit.T):
        axes.plot(values, color=ROBOTS[robot % len(ROBOTS)], linewidth=1.3, marker='.' if len(credit) < 30 else '',
                  label=f'robot {robot}')
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if credit.shape[1] <= len(ROBOTS):
        axes.legend(frameon=False, fontsize=8)
