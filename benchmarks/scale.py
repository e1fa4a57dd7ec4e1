"""make bench ARGS=scale: time and memory of a rollout and of learning from it, as the work grows.

One size grows at a time from navigation with 3 robots, 128 worlds, 25 steps and hidden layers of 64 (128 in the reward
network). Learning is one epoch of every network. Each point is a process of its own, so that its memory is its own. The
exponent is the slope between the largest sizes in logarithms: 1 is proportional. Called by itself, this measures one point.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.machine import ROOT
from dae_ros import config
from dae_ros.learning.learner import Learner
from dae_ros.report.style import BLUE, FAINT, GREY, INK, ORANGE, plain
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest
from dae_ros.worlds import make_worlds

SIZES = {'num_agents': (3, 6, 12, 24, 48), 'num_worlds': (1, 4, 16, 64, 256, 1024, 4096),
         'hidden_size': (64, 128, 256), 'num_steps': (25, 50, 100, 200, 400)}
TITLES = {'num_agents': 'robots', 'num_worlds': 'worlds', 'hidden_size': 'width of the hidden layers',
          'num_steps': 'steps of a rollout'}
ARCHITECTURES = ('per_agent', 'shared_trunk')
CURVES = {'collect': ('collect', GREY), 'learn per_agent': ('learn, per_agent', BLUE),
          'learn shared_trunk': ('learn, shared_trunk', ORANGE)}
REPEATS = 3
PICTURE = ROOT / 'docs' / 'benchmarks_scale.png'


def point(changes: dict[str, Any]) -> dict[str, float]:
    """Seconds to collect a rollout and to learn from it, the fastest of the repeats, and the process's peak MiB."""
    settings = config.from_flat({'epochs': 1, 'reward_network.epochs': 1, **changes})
    worlds = make_worlds(settings.task)
    learner = Learner(worlds.spec, settings.learner, settings.reward_network, 1)
    collector = InProcessCollector(worlds)
    best = {'collect': math.inf, 'learn': math.inf}
    for rollout in range(REPEATS):
        request = RolloutRequest(1, rollout, 0, rollout, 1, settings.run.num_steps, False)
        began = time.perf_counter()
        trajectory = collector.collect(request, learner.policy)
        collected = time.perf_counter()
        learner.update(trajectory, rollout)
        best = {'collect': min(best['collect'], collected - began),
                'learn': min(best['learn'], time.perf_counter() - collected)}
    learner.close()
    worlds.close()
    return best | {'memory': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def measured(changes: dict[str, Any]) -> dict[str, float]:
    """`point` in a process of its own."""
    command = [sys.executable, '-m', 'benchmarks.scale', json.dumps(changes)]
    return json.loads(subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout)


def grown(size: str, value: int, architecture: str) -> dict[str, Any]:
    changes = {size: value, 'reward_network.architecture': architecture}
    if size == 'hidden_size':
        changes |= {'reward_network.hidden_size': 2 * value, 'reward_network.trunk_size': 3 * value // 2}
    return changes


def measure() -> dict[str, dict[str, list[float]]]:
    """By size: its values, and the curves over them."""
    table: dict[str, dict[str, list[float]]] = {}
    for size, values in SIZES.items():
        rows = [{architecture: measured(grown(size, value, architecture)) for architecture in ARCHITECTURES} for value in values]
        table[size] = {'values': list(values), 'collect': [min(row[a]['collect'] for a in ARCHITECTURES) for row in rows]}
        for architecture in ARCHITECTURES:
            table[size] |= {f'{what} {architecture}': [row[architecture][what] for row in rows] for what in ('learn', 'memory')}
        print(as_text(size, table[size]), flush=True)
    return table


def exponent(values: list[float], figures: list[float]) -> float:
    """Slope in logarithms between the last and the last but one."""
    return math.log(figures[-1] / figures[-2]) / math.log(values[-1] / values[-2])


def as_text(size: str, curves: dict[str, list[float]]) -> str:
    names = [name for name in curves if name != 'values']
    lines = [f'{TITLES[size]:>28}' + ''.join(f'{name:>22}' for name in names)]
    for index, value in enumerate(curves['values']):
        cells = (f'{curves[name][index]:18.0f} MiB' if 'memory' in name else f'{1e3 * curves[name][index]:19.1f} ms'
                 for name in names)
        lines.append(f'{value:28}' + ''.join(cells))
    lines.append(f'{"exponent":>28}' + ''.join(f'{exponent(curves["values"], curves[name]):22.2f}' for name in names))
    return '\n'.join(lines)


def plot(table: dict[str, dict[str, list[float]]], path: Path = PICTURE) -> None:
    """Time above, memory below, one column per size, logarithmic."""
    figure = Figure(figsize=(11.0, 5.4), layout='constrained')
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(table), sharex='col', sharey='row')
    for (above, below), (size, curves) in zip(panels.T, table.items()):
        for axes in (above, below):
            plain(axes)
            axes.set(xscale='log', yscale='log')
            axes.grid(color=FAINT, linewidth=0.6)
        for name, (label, colour) in CURVES.items():
            above.plot(curves['values'], curves[name], marker='o', markersize=3, color=colour, label=label)
        for architecture, colour in zip(ARCHITECTURES, (BLUE, ORANGE)):
            below.plot(curves['values'], curves[f'memory {architecture}'], marker='o', markersize=3, color=colour)
        above.set_title(TITLES[size], fontsize=10, color=INK)
        below.set_xticks(curves['values'], [f'{value:g}' for value in curves['values']], fontsize=8)
        below.minorticks_off()
    panels[0, 0].set_ylabel('seconds')
    panels[0, 0].legend(fontsize=8, frameon=False)
    panels[1, 0].set_ylabel('peak memory [MiB]')
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('point', type=json.loads, help='settings of the point, as JSON')
    print(json.dumps(point(parser.parse_args().point)))


if __name__ == '__main__':
    main()
