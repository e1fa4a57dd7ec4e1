"""The curves of a figure from the finished runs behind them, and the CSV that holds them."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dae_ros.files import write_atomically
from dae_ros.report.metrics import STEPS
from reproduce.figures import SECONDS, Figure, Run, Team
from reproduce.records import Records
from reproduce.statistics import binned, mean_and_interval

POINTS = 100  # bins of a run, at least; at most twice as many
COLUMNS = {'mean_return': 'mean_return', 'win_rate': 'win_rate', 'advantage/deviation': 'advantage_deviation',
           'reward_network/explained_variance': 'reward_explained_variance', 'policy/entropy': 'policy_entropy',
           'expected_reward/explained': 'expected_reward_explained', 'credit/explained': 'credit_explained', SECONDS: 'seconds'}
PROBED = {'expected_reward/explained': 'explained', 'credit/explained': 'credit_explained'}  # in what the runs log of it


@dataclass(frozen=True)
class Seed:
    """One finished run, binned: environment steps at the end of each bin [bins], and metrics by name, each [bins]."""

    run: Run
    steps: np.ndarray
    metrics: dict[str, np.ndarray]


@dataclass(frozen=True)
class Band:
    """A curve with its interval: all [bins]."""

    steps: np.ndarray  # or what else the figure shows it against
    mean: np.ndarray
    half: np.ndarray  # of the interval's width; nan where there is none


class Curves:
    """The finished runs of one figure, by team and curve."""

    def __init__(self, figure: Figure, records: Records):
        self.figure = figure
        self.seeds: dict[tuple[Team, str], list[Seed]] = {}
        self.longer: dict[tuple[Team, str], Seed | None] = {}
        for team in figure.teams:
            for curve in figure.curves:
                runs = figure.runs(team, curve)
                width = max(1, runs[0].updates // POINTS) * runs[0].steps_per_update
                self.seeds[team, curve] = [self._seed(run, width, records) for run in runs if records.finished(run)]
                longer = figure.longer_run(team, curve)
                self.longer[team, curve] = (self._seed(longer, width, records)
                                            if longer is not None and records.finished(longer) else None)

    def counts(self, teams: list[Team], curve: str) -> list[int]:
        """How many seeds of the curve are finished, team by team."""
        return [len(self.seeds[team, curve]) for team in teams]

    def averaged(self, task: str) -> list[Team]:
        """The team sizes that every curve trained so far has; a mean over other ones would compare curves of different tasks."""
        sizes = self.figure.sizes(task)
        trained = [curve for curve in self.figure.curves if any(self.seeds[team, curve] for team in sizes)]
        return [team for team in sizes if trained and all(self.seeds[team, curve] for curve in trained)]

    def band(self, teams: list[Team], curve: str, metric: str) -> Band | None:
        """Mean over the teams' seeds and then over the teams; None if a team has no finished run."""
        if not teams or not all(self.counts(teams, curve)):
            return None
        groups = [self.seeds[team, curve] for team in teams]
        bins = min(len(seed.steps) for group in groups for seed in group)
        mean, half = mean_and_interval([np.array([seed.metrics[metric][:bins] for seed in group]) for group in groups])
        if self.figure.against == SECONDS:
            return Band(np.mean([seed.metrics[SECONDS][:bins] for group in groups for seed in group], axis=0), mean, half)
        return Band(groups[0][0].steps[:bins], mean, half)

    def write_csv(self, path: Path) -> None:
        """Long form: a row for each team, curve, seed and bin; five digits, and nothing where there is no number."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        writer.writerow(['task', 'num_agents', 'curve', 'seed', STEPS, *COLUMNS.values()])
        for (team, curve), seeds in self.seeds.items():
            longer = self.longer[team, curve]
            # The longer run begins with the shorter one of its seed.
            shown = seeds if longer is None else [longer, *(seed for seed in seeds if seed.run.seed != longer.run.seed)]
            for seed in shown:
                for row, steps in enumerate(seed.steps):
                    numbers = [seed.metrics[metric][row] for metric in COLUMNS]
                    writer.writerow([team.task, team.num_agents, curve, seed.run.seed, int(steps),
                                     *(f'{number:.5g}' if np.isfinite(number) else '' for number in numbers)])
        write_atomically(path, text.getvalue().encode())

    def _seed(self, run: Run, width: int, records: Records) -> Seed:
        """Its run, in bins of `width` environment steps."""
        columns = records.metrics(run)
        steps = columns[STEPS]
        missing = np.full(len(steps), np.nan)  # a run without reward networks has no metrics of them
        metrics = {metric: binned(steps, columns.get(metric, missing), width) for metric in COLUMNS}
        ends = np.arange(1, len(metrics['mean_return']) + 1) * min(width, int(steps[-1]))
        # The usual time of an update: what else the machine did now and then must not move the curve.
        metrics[SECONDS] = ends / run.steps_per_update * np.median(columns[SECONDS])
        credit = records.credit(run)
        for metric, name in PROBED.items():
            if run.exact:
                metrics[metric] = np.ones(len(ends))
            elif credit:
                metrics[metric] = np.interp(ends, credit[STEPS], credit[name], left=np.nan)
        shown = ends <= max(self.figure.until or np.inf, ends[0])
        return Seed(run, ends[shown], {metric: values[shown] for metric, values in metrics.items()})
