"""Compares dae_ros with its peers, taking turns on this machine.

    make bench-peers ARGS='--jaxmarl /path/to/a/checkout/of/JaxMARL'

Cooperative navigation, 3 robots, 25 steps: training by BenchMARL on VMAS and by JaxMARL's MAPPO-RNN, recurrent networks of
64 units, 128 worlds, 10 epochs, one mini-batch; simulation alone by VMAS, JaxMARL and mpe2, with random actions drawn
beforehand. Peers live in environments of their own (.peers/, pinned versions, without their GPU parts). Every contender
runs in a process that stays alive, warms up first, has all cores and its own choice of threads, and works while the others
wait. Each round gives each a turn; medians over the rounds count. A peer that cannot be had is left out.

Writes benchmarks/results.json and docs/benchmarks_peers.png.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from contextlib import ExitStack
from pathlib import Path

from benchmarks import machine, results
from benchmarks.peers import match, outcome
from benchmarks.peers.contender import Block, ContenderFailed, Running
from benchmarks.peers.environments import CannotInstall
from benchmarks.peers.match import Match
from benchmarks.peers.outcome import Outcome, Row
from benchmarks.peers.plot import plot

PICTURE = machine.ROOT / 'docs/benchmarks_peers.png'


def play(played: Match, rounds: int, turn_seconds: float, left_out: list[str]) -> Outcome:
    """All rounds of a match. Who fails is left out, with a sentence in `left_out`."""
    with tempfile.TemporaryDirectory(prefix='bench_peers_') as folder, ExitStack() as stack:
        units: dict[Running, int] = {}
        for number, contender in enumerate(played.contenders):
            try:
                running = stack.enter_context(Running(contender, Path(folder) / str(number)))
                units[running] = math.ceil(turn_seconds / running.warm_up())
            except (CannotInstall, ContenderFailed) as error:
                leave_out(contender.name, error, left_out)
        turns: dict[Running, list[Block]] = {running: [] for running in units}
        for _ in range(rounds):
            for running in list(turns):
                try:
                    turns[running].append(running.measure(units[running]))
                except ContenderFailed as error:
                    leave_out(running.name, error, left_out)
                    del turns[running]
        rows = tuple(Row(running.name, running.versions, tuple(blocks)) for running, blocks in turns.items())
    return outcome.outcome(played, rows)


def leave_out(name: str, reason: object, left_out: list[str]) -> None:
    left_out.append(f'{name} is left out: {reason}.')
    print(left_out[-1], flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(prog='make bench-peers', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--jaxmarl', type=Path, metavar='CHECKOUT', help='checkout of the JaxMARL repository, whose '
                        f'{match.SCRIPT} is not in its package; without one that row is left out')
    parser.add_argument('--rounds', type=int, default=5, help='turns of every contender')
    parser.add_argument('--seconds', type=float, default=3.0, help='how long a turn lasts, about')
    options = parser.parse_args()
    if options.rounds < 1 or not options.seconds > 0:
        parser.error('--rounds and --seconds must be positive')
    if options.jaxmarl and not (options.jaxmarl / match.SCRIPT).is_file():
        parser.error(f'{options.jaxmarl} is no checkout of JaxMARL: it has no {match.SCRIPT}')

    left_out: list[str] = []
    if not options.jaxmarl:
        leave_out(match.JAXMARL_MAPPO, f'its script is not in its package; --jaxmarl names a checkout of its repository, with '
                  f'{match.SCRIPT}', left_out)
    described = machine.description()
    if options.jaxmarl:
        described['jaxmarl_commit'] = machine.commit(options.jaxmarl)
    matches = [match.training(options.jaxmarl and options.jaxmarl.resolve()), match.simulation(match.NUM_WORLDS),
               match.simulation(match.MANY_WORLDS)]
    outcomes = []
    for played in matches:
        outcomes.append(play(played, options.rounds, options.seconds, left_out))
        print(f'\n{outcomes[-1].table()}', flush=True)
    disturbance = outcome.disturbance(outcomes)
    print(f'\n{disturbance or "The machine was quiet."}')

    results.merge('peers', {'machine': described, 'quiet': not disturbance, 'disturbance': disturbance, 'left_out': left_out,
                            'matches': [played.record() for played in outcomes]})
    caption = f'{described["processor"]}, {described["cores"]} cores, {described["date"]}. Median of {options.rounds} turns, ' \
              f'slowest to fastest.{"" if not disturbance else " The machine was not quiet."}'
    plot(outcomes, caption, PICTURE)
    print(f'Written: {results.FILE.relative_to(machine.ROOT)} and {PICTURE.relative_to(machine.ROOT)}')


if __name__ == '__main__':
    main()
