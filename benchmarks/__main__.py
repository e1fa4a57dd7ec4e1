"""make bench: what we reach on this machine; kept in benchmarks/results.json and drawn in docs/.

Parts: training (one process, with its phases), graph (beside the single process), learner (arithmetic beside the matrix
peak), worlds (simulators), inference (one robot), execution (the same through its node, over DDS); scale (as the work grows),
bags, and memory (of the graph's processes, as updates pass), which take long and must be named.
"""

from __future__ import annotations

import argparse
import os
from typing import Any, Callable

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import bags, inference, learner, phases, scale, worlds
from benchmarks.machine import QUIET, ROOT, Bystanders, description
from benchmarks.results import merge
from dae_ros import config
from dae_ros.config import TaskSettings
from dae_ros.report.style import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SAND, SKY, VERMILION, plain

TRAININGS = {'MAPPO': {'beta': 0.0}, 'DAE, per_agent': {'reward_network.architecture': 'per_agent'},
             'DAE, shared_trunk': {'reward_network.architecture': 'shared_trunk'}}
PICTURE = ROOT / 'docs' / 'benchmarks.png'
SHOWN = {'simulate': SKY, 'infer': BLUE, 'join': PURPLE, 'advantages': GREY, 'actor': GREEN, 'critic': SAND,
         'reward network': ORANGE, 'publish': VERMILION}


def training(rounds: int) -> dict[str, Any]:
    """Phases of each training, medians over rounds taken in turn."""
    turns = [{name: phases.measure(config.from_flat(changes)) for name, changes in TRAININGS.items()} for _ in range(rounds)]
    result = {name: {key: float(np.median([turn[name][key] for turn in turns])) for key in turns[0][name]} for name in TRAININGS}
    print(f'{"[ms per rollout of 3,200 steps]":32}' + ''.join(f'{name:>20}' for name in result))
    for key in next(iter(result.values())):
        print(f'  {key:30}' + ''.join(f'{found[key]:20,.1f}' for found in result.values()))
    return result


def graph(rounds: int) -> dict[str, Any]:
    """Graph beside single process; needs ROS."""
    from benchmarks import graph as benchmark

    result = benchmark.measure(rounds=rounds)
    for beta, found in result.items():
        print(benchmark.as_text(beta, found))
    return result


def simulators(rounds: int) -> dict[str, Any]:
    """Environment steps per second of our worlds."""
    result = {}
    for num_worlds in (128, 4096):
        speeds = worlds.steps_per_second(TaskSettings(task='navigation', num_agents=3, num_worlds=num_worlds), 3 * rounds)
        result[str(num_worlds)] = float(np.median(speeds))
        print(f'  navigation, {num_worlds:5} worlds {np.median(speeds):14,.0f} steps/s')
    return result


def memory(_: int) -> dict[str, Any]:
    """Resident memory of the graph's processes over 2,000 updates; needs ROS."""
    from benchmarks import memory as benchmark

    result = benchmark.measure()
    print(benchmark.as_text(result))
    return result


def one_robot(rounds: int) -> dict[str, float]:
    result = inference.measure()
    print(f'  {result["median"]:.0f} us, 99th percentile {result["percentile_99"]:.0f} us')
    return result


def one_agent(rounds: int) -> dict[str, float]:
    """One robot's agent as a node; needs ROS."""
    from benchmarks import execution

    result = execution.measure()
    print(f'  {result["median"]:.2f} ms, 99th percentile {result["percentile_99"]:.2f} ms; round trip '
          f'{result["round_trip_median"]:.2f} ms, 99th percentile {result["round_trip_percentile_99"]:.2f} ms')
    return result


PARTS: dict[str, Callable[[int], Any]] = {
    'training': training, 'graph': graph, 'learner': lambda rounds: learner.measure(repeats=rounds + 2), 'worlds': simulators,
    'inference': one_robot, 'execution': one_agent, 'scale': lambda rounds: scale.measure(), 'bags': bags.measure,
    'memory': memory}
UNASKED = tuple(name for name in PARTS if name not in ('scale', 'bags', 'memory'))


def plot(found: dict[str, dict[str, float]]) -> None:
    """Where a rollout's processor time goes, one bar per training."""
    figure = Figure(figsize=(8.0, 2.4), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    plain(axes)
    names = list(found)[::-1]
    ends = np.zeros(len(names))
    for phase, colour in SHOWN.items():
        widths = np.array([found[name][phase] for name in names])
        axes.barh(names, widths, left=ends, color=colour, label=phase, height=0.6)
        ends += widths
    for place, name in enumerate(names):
        axes.annotate(f'{found[name]["steps_per_second"]:,.0f} steps/s', (ends[place], place), xytext=(4, 0), va='center',
                      textcoords='offset points', fontsize=8, color=INK)
    axes.set_xlabel('processor milliseconds per rollout of 3,200 steps; the networks learn side by side on all cores', fontsize=8)
    axes.margins(x=0.14)
    figure.legend(ncols=8, loc='outside upper center', fontsize=8, frameon=False)
    figure.savefig(PICTURE, dpi=150)


PLOTS: dict[str, Callable[[Any], None]] = {'training': plot, 'scale': scale.plot}


def main() -> None:
    parser = argparse.ArgumentParser(prog='make bench', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('parts', nargs='*', metavar='part',
                        help=f'which of {", ".join(PARTS)}; without any, all but scale, bags and memory')
    parser.add_argument('--rounds', type=int, default=3, help='turns of each training, graph and single process')
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f'there is no part {", ".join(sorted(unknown))}')
    for name in options.parts or UNASKED:
        print(f'\n{name}', flush=True)
        bystanders = Bystanders(os.getpid())
        result = PARTS[name](options.rounds)
        others = bystanders.cores()
        if others > QUIET:
            print(f'  The machine was not quiet: other processes kept {others:.1f} cores busy.')
        merge(f'bench {name}', {'machine': description(), 'cores_of_others': round(others, 2), 'result': result})
        if name in PLOTS:
            PLOTS[name](result)
    print('\nkept in benchmarks/results.json')


if __name__ == '__main__':
    main()
