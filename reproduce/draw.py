"""Draws a figure: every curve's mean over the seeds with its 95 % interval, a panel for each team or each task."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from dae_ros.config import TaskSettings
from dae_ros.report.style import FAINT, GREY, INK, ROBOTS, compact, plain
from dae_ros.worlds.yardsticks import yardstick_returns
from reproduce.curves import Curves
from reproduce.figures import Team

METRIC_LABELS = {'mean_return': 'mean return of an episode', 'advantage/deviation': 'standard deviation of the advantages'}
YARDSTICKS = ('random', 'greedy', 'best')
YARDSTICK_EPISODES = 1000


def draw(curves: Curves, path: Path) -> None:
    """Writes the figure as a PNG, as far as its runs are finished."""
    figure = curves.figure
    rows = [[curves.averaged(task) for task in figure.tasks]] if figure.average else [
        [[team] for team in figure.sizes(task)] for task in figure.tasks]
    columns = max(map(len, rows))
    wide = columns == 1
    canvas = Canvas(figsize=(7.5 if wide else 3.4 * columns, (4.2 if wide else 2.6) * len(rows) + 0.8), layout='constrained')
    FigureCanvasAgg(canvas)
    panels = canvas.subplots(len(rows), columns, squeeze=False)
    for number, (row, places) in enumerate(zip(rows, panels)):
        for teams, axes, task in zip(row, places, figure.tasks if figure.average else [figure.tasks[number]] * columns):
            _panel(axes, curves, task, teams)
    canvas.supylabel(METRIC_LABELS[figure.shows], fontsize=9, color=INK)
    canvas.supxlabel('environment steps', fontsize=9, color=INK)
    handles = {}
    for axes in panels.flat:
        handles |= {text: line for line, text in zip(*axes.get_legend_handles_labels())}
    if handles:
        order = [curve for curve in figure.curves if curve in handles]
        canvas.legend([handles[curve] for curve in order], order, ncols=len(order), loc='outside upper center', fontsize=9,
                      frameon=False)
    canvas.savefig(path, dpi=150, format='png')


def _panel(axes: Axes, curves: Curves, task: str, teams: Sequence[Team]) -> None:
    figure = curves.figure
    plain(axes)
    axes.grid(axis='y', color=FAINT, linewidth=0.6)
    axes.xaxis.set_major_formatter(compact)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    sizes = ', '.join(str(team.num_agents) for team in teams)
    axes.set_title(f'{task}, N = {sizes or "none yet"}  {_seeds(curves, teams)}', loc='left', fontsize=9, color=INK)
    for curve in figure.curves:
        colour = ROBOTS[figure.palette.index(curve) % len(ROBOTS)]
        band = curves.band(teams, curve, figure.shows)
        if band is None:
            continue
        axes.plot(band.steps, band.mean, color=colour, linewidth=1.5, label=curve)
        axes.fill_between(band.steps, band.mean - band.half, band.mean + band.half, color=colour, alpha=0.2, linewidth=0)
        longer = curves.longer[teams[0], curve] if len(teams) == 1 else None
        if longer is not None:
            beyond = longer.steps >= band.steps[-1]
            axes.plot(longer.steps[beyond], longer.metrics[figure.shows][beyond], color=colour, linewidth=0.8, alpha=0.8)
    if figure.shows == 'mean_return' and teams:
        _yardsticks(axes, teams)


def _seeds(curves: Curves, teams: Sequence[Team]) -> str:
    """How many seeds are behind the curves of a panel."""
    counts = sorted({count for curve in curves.figure.curves for count in curves.counts(teams, curve) if count})
    if not counts:
        return ''
    return f'({counts[0]} seeds)' if len(counts) == 1 else f'({counts[0]} to {counts[-1]} seeds)'


def _yardsticks(axes: Axes, teams: Sequence[Team]) -> None:
    """Thin lines at the returns of teams that learnt nothing, averaged over the team sizes."""
    found = [_yardstick_returns(team.task, team.num_agents) for team in teams]
    for name in [name for name in YARDSTICKS if name in found[0]]:
        height = np.mean([returns[name][0] for returns in found])
        axes.axhline(height, color=GREY, linewidth=0.8, linestyle=(0, (5, 3)), zorder=1)
        axes.annotate(name, (1.0, height), xycoords=('axes fraction', 'data'), xytext=(-2, 2), textcoords='offset points',
                      ha='right', va='bottom', fontsize=7, color='#5f5f5f')


@lru_cache(maxsize=None)
def _yardstick_returns(task: str, num_agents: int) -> dict[str, tuple[float, float]]:
    return yardstick_returns(TaskSettings(task=task, num_agents=num_agents), YARDSTICK_EPISODES, seed=1)
