"""Draws a figure: every curve's mean over the seeds with its 95 % interval, or both seeds, a panel for each team or each task."""

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
from dae_ros.report.metrics import STEPS
from dae_ros.report.style import FAINT, GREY, INK, ROBOTS, compact, plain
from dae_ros.worlds.yardsticks import yardstick_returns
from reproduce.curves import Curves
from reproduce.figures import METRICS, Team
from reproduce.statistics import last

YARDSTICKS = ('random', 'greedy', 'best')
YARDSTICK_EPISODES = 1000
FEW = 2  # seeds, of whose interval, a dozen of their distances wide, nothing could be seen
POSSIBLE = {'win_rate': (0.0, 1.0), 'advantage/deviation': (0.0, np.inf)}
"""Least and largest value; Student's t knows of none."""


def draw(curves: Curves, path: Path) -> None:
    """Writes the figure as a PNG."""
    composed(curves).savefig(path, dpi=150, format='png')


def composed(curves: Curves) -> Canvas:
    """The figure, as far as its runs are finished; a task that none of them is of has no panels."""
    figure = curves.figure
    rows = {task: [curves.averaged(task)] if figure.average else [[team] for team in figure.sizes(task)] for task in figure.tasks}
    rows = {task: row for task, row in rows.items() if any(_counts(curves, teams) for teams in row)} or rows
    columns = max(map(len, rows.values()))
    wide = columns == 1
    canvas = Canvas(figsize=(7.5 if wide else 3.4 * columns, (4.2 if wide else 2.6) * len(rows) + 0.8), layout='constrained')
    FigureCanvasAgg(canvas)
    panels = canvas.subplots(len(rows), columns, squeeze=False)
    for (task, row), places in zip(rows.items(), panels):
        for teams, axes in zip(row, places):
            _panel(axes, curves, task, teams)
    canvas.supylabel(METRICS[figure.shows], fontsize=9, color=INK)
    canvas.supxlabel(METRICS[figure.against], fontsize=9, color=INK)
    handles = {}
    for axes in panels.flat:
        handles |= {text: line for line, text in zip(*axes.get_legend_handles_labels())}
    if handles:
        order = [curve for curve in figure.curves if curve in handles]
        canvas.legend([handles[curve] for curve in order], order, ncols=len(order) if len(order) < 5 else 3,
                      loc='outside upper center', fontsize=9, frameon=False)
    return canvas


def _panel(axes: Axes, curves: Curves, task: str, teams: Sequence[Team]) -> None:
    figure = curves.figure
    plain(axes)
    axes.grid(axis='y', color=FAINT, linewidth=0.6)
    if not figure.scattered:
        axes.xaxis.set_major_formatter(compact)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    counts = _counts(curves, teams)
    sizes = f', N = {", ".join(str(team.num_agents) for team in teams)}' if teams else ''
    longer = {curve: curves.longer[teams[0], curve] for curve in figure.curves} if len(teams) == 1 else {}
    alone = '; thin: seed 1 alone' if any(longer.values()) else ''
    axes.set_title(f'{task}{sizes}   {_seeds(counts)}{alone}', loc='left', fontsize=9, color=INK)
    if not counts:
        axes.set(xticks=[], yticks=[])
        return
    if figure.scattered:  # without yardsticks: they would press the points into a line
        _points(axes, curves, teams)
        return
    if figure.shows == 'mean_return':
        _yardsticks(axes, curves, teams)
    bands = {curve: band for curve in figure.curves if (band := curves.band(teams, curve, figure.shows)) is not None}
    for curve, band in bands.items():
        colour = _colour(curves, curve)
        axes.plot(band.steps, band.mean, color=colour, linewidth=1.5, label=curve)
        if figure.against == STEPS and (seed := longer.get(curve)) is not None:
            beyond = seed.steps >= band.steps[-1]
            axes.plot(seed.steps[beyond], seed.metrics[figure.shows][beyond], color=colour, linewidth=0.8, alpha=0.8)
    axes.margins(y=0.1)
    limits = axes.get_ylim()
    for curve, band in bands.items():
        colour = _colour(curves, curve)
        if curves.counts(teams, curve) == [FEW]:
            for seed in curves.seeds[teams[0], curve]:
                axes.plot(band.steps, seed.metrics[figure.shows][:len(band.steps)], color=colour, linewidth=0.6, alpha=0.6)
        else:
            low, high = np.clip([band.mean - band.half, band.mean + band.half], *POSSIBLE.get(figure.shows, (-np.inf, np.inf)))
            axes.fill_between(band.steps, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set_ylim(limits)  # an interval can be wider than everything else there is to see


def _points(axes: Axes, curves: Curves, teams: Sequence[Team]) -> None:
    """Where every seed ended."""
    figure = curves.figure
    for curve in figure.curves:
        ends = [[last(seed.metrics[metric]) for metric in (figure.against, figure.shows)]
                for team in teams for seed in curves.seeds[team, curve]]
        if ends:
            axes.scatter(*zip(*ends), color=_colour(curves, curve), s=18, label=curve)


def _colour(curves: Curves, curve: str) -> str:
    return ROBOTS[curves.figure.palette.index(curve) % len(ROBOTS)]


def _counts(curves: Curves, teams: Sequence[Team]) -> list[int]:
    """The numbers of seeds behind the curves of a panel, ascending."""
    return sorted({count for curve in curves.figure.curves for count in curves.counts(teams, curve) if count})


def _seeds(counts: list[int]) -> str:
    if not counts:
        return 'not trained yet'
    if len(counts) > 1:
        return f'{counts[0]} to {counts[-1]} seeds'
    return '1 seed' if counts == [1] else f'{counts[0]} seeds'


def _yardsticks(axes: Axes, curves: Curves, teams: Sequence[Team]) -> None:
    """Thin lines at the returns of teams that learnt nothing, averaged over the team sizes."""
    curve = next(iter(curves.figure.curves))
    found = [_yardstick_returns(curves.figure.run(team, curve, 1).settings.task) for team in teams]
    for name in [name for name in YARDSTICKS if name in found[0]]:
        height = np.mean([returns[name][0] for returns in found])
        axes.axhline(height, color=GREY, linewidth=0.8, linestyle=(0, (5, 3)), zorder=1)
        axes.annotate(name, (1.0, height), xycoords=('axes fraction', 'data'), xytext=(-2, 2), textcoords='offset points',
                      ha='right', va='bottom', fontsize=7, color='#5f5f5f')


@lru_cache(maxsize=None)
def _yardstick_returns(task: TaskSettings) -> dict[str, tuple[float, float]]:
    return yardstick_returns(task, YARDSTICK_EPISODES, seed=1)
