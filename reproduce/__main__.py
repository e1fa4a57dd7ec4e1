"""make reproduce: trains what the paper's figures show and draws them again, as declared in config/figures/.

    make reproduce figure='1b 4' seeds=2 steps=200000 workers=2
    make reproduce figure=1b ARGS=--list

Runs go to runs/reproduce/, results to docs/results/ and docs/results.md, also while some runs are still missing. Figures share
the runs they have in common. Whatever interrupts it, the same command goes on from there; more steps or seeds go on from what
there is. Runs whose records lie in docs/results/runs/ are not trained again: to see for yourself, give other --runs and --docs.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from pathlib import Path

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes

from benchmarks.machine import ROOT
from dae_ros.command import interrupt_on_sigterm, run_command
from reproduce import figures, schedule
from reproduce.figures import Figure
from reproduce.progress import Progress
from reproduce.records import Records
from reproduce.results import results_folder, write_results

REFRESH_PERIOD = 600.0  # s at least between two drawings, which take some seconds, while runs are being trained


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'must be at least 1, not {value}')
    return value


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='make reproduce', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('figures', nargs='*', metavar='figure', help='figures of the paper, such as 1b; all without any')
    parser.add_argument('--seeds', type=positive, help='seeds of every curve, in place of those declared')
    parser.add_argument('--steps', type=positive, help='environment steps of every run, in place of those declared')
    parser.add_argument('--workers', type=positive, default=len(os.sched_getaffinity(0)),
                        help='runs trained at a time; default: the cores there are, %(default)s')
    parser.add_argument('--short', action='store_true', help='see everything work in a minute: the first team of each figure, '
                                                             'one seed, few worlds and updates; needs --runs and --docs')
    parser.add_argument('--runs', type=Path, default=ROOT / 'runs' / 'reproduce', help='folder of the runs')
    parser.add_argument('--docs', type=Path, default=ROOT / 'docs', help='folder of the results')
    parser.add_argument('--list', action='store_true', help='say what there is and how much of it is done, and train nothing')
    parsed = parser.parse_args(arguments)
    if parsed.short and (parsed.runs == parser.get_default('runs') or parsed.docs == parser.get_default('docs')):
        parser.error('--short needs --runs and --docs, lest its results replace the real ones')
    return parsed


def show(chosen: list[Figure], records: Records) -> None:
    """A line for each figure and one for all: how many runs are done, and the core hours left at the speed of those done."""
    everything = [run for figure in chosen for run in figure.all_runs()]
    speed = records.speed(set(everything))
    width = max(len(figure.name) for figure in chosen) + 2
    for name, runs in [*((f'{figure.name:{width}}{figure.title}', figure.all_runs()) for figure in chosen), ('all', everything)]:
        todo = schedule.jobs(runs, records)
        steps = sum(job.run.steps - job.begins_at for job in todo)
        hours = sum(job.work(records.progress(job.run.name)[0]) for job in todo) / speed / 3600
        print(f'{name}: {len(set(runs)) - len(todo)} of {len(set(runs))} runs done, {steps / 1e6:.1f}M steps left'
              + (f', about {hours:.1f} core hours' if todo and math.isfinite(hours) else ''))


def reproduce(chosen: list[Figure], workers: int, records: Records, docs: Path) -> int:
    """Trains what is missing and writes the results. Returns how many runs failed."""
    drawn_at = time.monotonic()

    def refresh() -> None:
        nonlocal drawn_at
        if time.monotonic() - drawn_at > REFRESH_PERIOD:
            write_results(chosen, records, docs)
            drawn_at = time.monotonic()

    playable = [figure for figure in chosen if figure.is_playable]
    todo = schedule.jobs([run for figure in playable for run in figure.all_runs()], records)
    with Progress() as progress:
        if len(playable) < len(chosen):
            left_out = ', '.join(figure.name for figure in chosen if figure not in playable)
            progress.note(f'left out: figures {left_out}, which need JaxMARL; `make smax` installs it')
        progress.note(f'{len(todo)} runs to train in {records.folder}')
        try:
            failed = schedule.train(todo, workers, records, progress, refresh)
        finally:
            write_results(chosen, records, docs)
    print(f'results in {docs / "results.md"}')
    if failed:
        print(f'{len(failed)} runs failed: {", ".join(run.name for run in failed)}', file=sys.stderr)
    return len(failed)


def main(arguments: list[str] | None = None) -> int:
    options = parse_arguments(arguments)
    interrupt_on_sigterm()
    records = Records(options.runs, results_folder(options.docs))

    def act() -> int:
        chosen = figures.load(options.figures, options.seeds, options.steps, options.short)
        if options.list:
            show(chosen, records)
            return 0
        return 1 if reproduce(chosen, options.workers, records, options.docs) else 0

    return run_command(act, 'stopped; the same command goes on from here')


if __name__ == '__main__':
    sys.exit(main())
