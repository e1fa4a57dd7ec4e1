"""Draws the speeds of all contenders, one panel per match."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.peers.outcome import Outcome
from dae_ros.report.style import BLUE, FAINT, GREY, INK, compact, plain

OURS = 'dae_ros'  # how the names of our contenders begin


def plot(outcomes: list[Outcome], caption: str, path: Path) -> None:
    """Writes a PNG: bars to the medians, thin lines from the slowest to the fastest turn; `caption` stands below."""
    heights = [len(played.rows) + 1 for played in outcomes]
    figure = Figure(figsize=(8.0, 0.42 * sum(heights) + 0.5), layout='constrained')
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(h_pad=0.06, w_pad=0.08)
    for axes, played in zip(figure.subplots(len(outcomes), 1, squeeze=False, height_ratios=heights)[:, 0], outcomes):
        _bars(axes, played)
    figure.supxlabel(caption, x=0.01, ha='left', fontsize=8, color=GREY)
    figure.savefig(path, dpi=150, format='png')


def _bars(axes: Axes, played: Outcome) -> None:
    plain(axes)
    axes.set_title(f'{played.title}  [environment steps per second]', loc='left', fontsize=10, color=INK)
    rows = sorted(played.rows, key=lambda row: row.median)
    places = range(len(rows))
    medians = [row.median for row in rows]
    axes.grid(axis='x', color=FAINT, linewidth=0.6)
    axes.xaxis.set_major_formatter(compact)
    axes.barh(places, medians, height=0.62, color=[BLUE if row.name.startswith(OURS) else GREY for row in rows])
    axes.hlines(places, [row.slowest for row in rows], [row.fastest for row in rows], color=INK, linewidth=1.0)
    axes.set_yticks(places, [row.name for row in rows], fontsize=9)
    axes.tick_params(axis='y', length=0)
    axes.spines['left'].set_visible(False)
    for place, row in zip(places, rows):
        axes.annotate(f'{row.median:,.0f}', (max(row.median, row.fastest), place), xytext=(5, 0), textcoords='offset points',
                      va='center', fontsize=8.5, color=INK)
    axes.margins(x=0.14, y=0.04)
    axes.set_xlim(left=0)
