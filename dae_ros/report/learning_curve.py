"""Draws how a run's return grew, between the yardsticks, and what the networks did meanwhile."""

from __future__ import annotations

from pathlib import Path
from typing import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dae_ros.report.metrics import STEPS
from dae_ros.report.style import BLUE, FAINT, GREY, INK, compact, plain, signed

PANELS = {
    'policy/entropy': 'entropy of the policy',
    'reward_network/explained_variance': 'reward variance explained',
    'value/loss': 'value loss',
}
SMOOTHED_SHARE = 0.05  # of all updates, under the moving average
LABEL_GAP = 0.055      # least distance of two labels, as a share of the height of the axes


def plot_learning_curve(metrics: Mapping[str, np.ndarray], yardsticks: Mapping[str, tuple[float, float]], title: str,
                        path: Path) -> None:
    """Writes a PNG of the mean return over environment steps, with `yardsticks` as horizontal lines, and small panels.

    metrics: columns [rows] as `read_metrics` gives them; a panel whose column is missing is left out.
    yardsticks: mean return and its standard error by name, as `yardstick_returns` gives them.
    """
    panels = {name: label for name, label in PANELS.items() if name in metrics}
    steps = metrics[STEPS]
    figure = Figure(figsize=(8.0, 5.4 if panels else 4.0), layout='constrained')
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(h_pad=0.08, w_pad=0.08)
    grid = figure.add_gridspec(2 if panels else 1, max(len(panels), 1), height_ratios=[2.8, 1.0] if panels else None)

    main = figure.add_subplot(grid[0, :])
    main.set_title(title, loc='left', fontsize=11, color=INK)
    main.set_ylabel('mean return of an episode', fontsize=9, color=INK)
    main.set_xlabel('environment steps', fontsize=9, color=INK)
    _curve(main, steps, metrics['mean_return'])
    labels = [(mean, f'{name}  {signed(mean)}', GREY) for name, (mean, _) in yardsticks.items()]
    for mean, _, colour in labels:
        main.axhline(mean, color=colour, linewidth=0.9, linestyle=(0, (5, 3)), zorder=1)
    reached = metrics['mean_return'][np.isfinite(metrics['mean_return'])]
    if len(reached):
        last = smoothed(reached)[-1]
        labels.append((last, f'team  {signed(last)}', BLUE))
    _label_right(main, labels)

    for column, (name, label) in enumerate(panels.items()):
        small = figure.add_subplot(grid[1, column], sharex=main)
        small.set_title(label, loc='left', fontsize=8.5, color=INK)
        _curve(small, steps, metrics[name])
        small.yaxis.set_major_locator(MaxNLocator(3))
        small.xaxis.set_major_locator(MaxNLocator(4))
    if 'reward_network/explained_variance' in panels:
        # Predictions before the first updates can be far worse than the mean; what matters is how near to 1 they come.
        figure.axes[1 + list(panels).index('reward_network/explained_variance')].set_ylim(-0.05, 1.05)
    main.xaxis.set_major_locator(MaxNLocator(6))
    figure.savefig(path, dpi=150, format='png')


def smoothed(values: np.ndarray) -> np.ndarray:
    """Centred moving average [rows] over a twentieth of the rows, over fewer towards both ends."""
    half = int(len(values) * SMOOTHED_SHARE / 2)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    centre = np.arange(len(values))
    reach = np.minimum(np.minimum(centre, centre[::-1]), half)
    return (sums[centre + reach + 1] - sums[centre - reach]) / (2 * reach + 1)


def _curve(axes: Axes, steps: np.ndarray, values: np.ndarray) -> None:
    """The values as they are, light, and smoothed; gaps where there is no number are bridged."""
    plain(axes)
    axes.grid(axis='y', color=FAINT, linewidth=0.6)
    axes.xaxis.set_major_formatter(compact)
    known = np.isfinite(values)
    steps, values = steps[known], values[known]
    axes.plot(steps, values, color=BLUE, alpha=0.3, linewidth=0.8, marker='.' if len(values) < 20 else '', markersize=4)
    axes.plot(steps, smoothed(values), color=BLUE, linewidth=1.6)


def _label_right(axes: Axes, labels: list[tuple[float, str, str]]) -> None:
    """Write each (height, text, colour) beside the right end of the axes, moved apart where they would overlap."""
    axes.margins(x=0.0, y=0.06)
    low, high = axes.get_ylim()
    labels = sorted(labels)
    heights = apart(np.array([(value - low) / (high - low) for value, _, _ in labels]), LABEL_GAP)
    for height, (_, text, colour) in zip(heights, labels):
        axes.annotate(text, (1.0, height), xycoords='axes fraction', xytext=(6, 0), textcoords='offset points',
                      va='center', fontsize=8.5, color=colour if colour != GREY else '#5f5f5f',
                      fontweight='bold' if colour == BLUE else 'normal', annotation_clip=False)


def apart(heights: np.ndarray, gap: float) -> np.ndarray:
    """Ascending `heights` [k] moved as little as may be so that neighbours are at least `gap` apart."""
    # Least squares under an order constraint: pool neighbours that violate it, each pool takes its members' mean.
    offsets = gap * np.arange(len(heights))
    pools: list[list[float]] = []
    for height in heights - offsets:
        pools.append([height])
        while len(pools) > 1 and np.mean(pools[-2]) > np.mean(pools[-1]):
            pools[-2:] = [pools[-2] + pools[-1]]
    return offsets + np.array([np.mean(pool) for pool in pools for _ in pool])
