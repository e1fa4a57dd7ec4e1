"""The tables of docs/results.md: what is between a figure's markers is generated anew, the rest stays as it was written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Iterable, Sequence

import numpy as np

from dae_ros import config
from dae_ros.config import Settings
from dae_ros.files import write_atomically
from dae_ros.report.style import signed
from reproduce.curves import Curves, Seed
from reproduce.figures import METRICS, Team
from reproduce.records import Records
from reproduce.statistics import last, mean_and_interval, steps_to_reach

HEADER = '''# Results

The paper's figures, trained and drawn again by `make reproduce`. Lines and numbers are means over seeds, bands and ± their
95 % intervals (Student's t); of two seeds each is a thin line.
'''


def replace_block(text: str, name: str, block: str) -> str:
    """`text` with `block` between the markers of figure `name`, which are added at the end where there are none."""
    begin, end = f'<!-- generated: figure {name} -->', '<!-- end -->'
    marked = f'{begin}\n{block}\n{end}'
    found = re.compile(f'{re.escape(begin)}.*?{re.escape(end)}', re.DOTALL)
    if found.search(text):
        return found.sub(lambda _: marked, text, count=1)
    return f'{text.rstrip()}\n\n## Figure {name}\n\n{marked}\n'


def write_block(path: Path, name: str, block: str) -> None:
    """Puts `block` into the file, which is begun if it is not there."""
    text = path.read_text(encoding='utf-8') if path.exists() else HEADER
    write_atomically(path, replace_block(text, name, block).encode())


def figure_block(curves: Curves, records: Records) -> str:
    """All that is told of one figure: picture, tables, settings, versions and machine."""
    figure = curves.figure
    # A run that went on counts once, with all its time.
    facts = [*{seed.run.name: fact for seed in _all_seeds(curves) if (fact := records.facts(seed.run)) is not None}.values()]
    parts = [f'**{figure.title}.** Data: [results/{figure.name}.csv](results/{figure.name}.csv).',
             f'![{figure.title}](results/{figure.name}.png)', _results(curves, records)]
    if figure.threshold is not None:
        parts.append(_thresholds(curves))
    if figure.baseline is not None:
        parts.append(_differences(curves))
    parts.append('\n'.join([*_settings(curves), *_origins(facts)]))
    return '\n\n'.join(part for part in parts if part)


def _groups(curves: Curves) -> Iterable[tuple[str, list[Team]]]:
    """A task and the teams that share a row."""
    for task in curves.figure.tasks:
        if curves.figure.average:
            yield task, curves.averaged(task)
        else:
            yield from ((task, [team]) for team in curves.figure.sizes(task))


def _all_seeds(curves: Curves) -> list[Seed]:
    longer = (seed for seed in curves.longer.values() if seed is not None)
    return [*(seed for seeds in curves.seeds.values() for seed in seeds), *longer]


def _results(curves: Curves, records: Records) -> str:
    figure, rows = curves.figure, []
    for task, teams in _groups(curves):
        for curve in figure.curves:
            groups = [curves.seeds[team, curve] for team in teams]
            if groups and all(groups):
                rows.append(_row(curves, records, task, teams, curve, groups, _counts(curves, teams, curve)))
            longer = curves.longer[teams[0], curve] if len(teams) == 1 else None
            if longer is not None:
                rows.append(_row(curves, records, task, teams, curve, [[longer]], f'seed {longer.run.seed} alone'))
    head = ['task', 'N', 'curve', 'seeds', 'steps', f'{METRICS[figure.shows]}, last 5 %',
            f'{_evaluated(curves)[0]} at the end, greedy']
    return _table(head, rows)


def _row(curves: Curves, records: Records, task: str, teams: Sequence[Team], curve: str, groups: Sequence[Sequence[Seed]],
         seeds: str) -> list[str]:
    """One curve's numbers at the end of training, or of what is shown of it, over the seeds of each team."""
    figure = curves.figure
    return [task, _sizes(teams), curve, seeds, f'{min(groups[0][0].run.steps, figure.until or np.inf):,}',
            _number(*_interval(groups, lambda seed: last(seed.metrics[figure.shows]))),
            _number(*_interval(groups, lambda seed: _evaluation(seed, records, _evaluated(curves)[1])))]


def _thresholds(curves: Curves) -> str:
    """How soon the mean over the seeds, smoothed, reaches the figure's threshold, and how much sooner than the baseline."""
    figure, rows = curves.figure, []
    for task, teams in _groups(curves):
        bands = {curve: band for curve in figure.curves if (band := curves.band(teams, curve, figure.shows)) is not None}
        reached = {curve: steps_to_reach(figure.threshold, band.steps, band.mean) for curve, band in bands.items()}
        baseline = reached.get(figure.baseline)
        for curve, steps in reached.items():
            told = f'{steps:,.0f}' if steps is not None else f'not within {bands[curve].steps[-1]:,.0f}'
            ratio = f'{baseline / steps:.2f}' if baseline is not None and steps is not None else ''
            rows.append([task, _sizes(teams), curve, _counts(curves, teams, curve), told, ratio])
    return _table(['task', 'N', 'curve', 'seeds', f'steps to a mean return of {figure.threshold:g}',
                   f'steps of {figure.baseline} / its own'], rows)


def _differences(curves: Curves) -> str:
    """Every curve minus the baseline, seed by seed, at the end of training."""
    figure, rows = curves.figure, []
    for task, teams in _groups(curves):
        for curve in figure.curves:
            pairs = [_pairs(curves, team, curve) for team in teams]
            if curve != figure.baseline and pairs and all(map(len, pairs)):
                seeds = ' + '.join(str(len(pair)) for pair in pairs)
                rows.append([task, _sizes(teams), f'{curve} − {figure.baseline}', seeds, _number(*mean_and_interval(pairs))])
    head = ['task', 'N', 'difference, paired by seed', 'seeds', f'{METRICS[figure.shows]}, last 5 %']
    return _table(head, rows) if rows else ''


def _pairs(curves: Curves, team: Team, curve: str) -> np.ndarray:
    """Differences [seeds] of the curve and the baseline for the seeds that both have."""
    ours, theirs = ({seed.run.seed: last(seed.metrics[curves.figure.shows]) for seed in curves.seeds[team, name]}
                    for name in (curve, curves.figure.baseline))
    return np.array([ours[seed] - theirs[seed] for seed in ours if seed in theirs])


def _interval(groups: Sequence[Sequence[Seed]], value) -> tuple[float, float]:
    return mean_and_interval([np.array([value(seed) for seed in group]) for group in groups])


def _evaluated(curves: Curves) -> tuple[str, str]:
    """What the trained teams' evaluation tells: what people call it, and its name among a run's facts."""
    return ('share won', 'evaluation_win_rate') if curves.figure.shows == 'win_rate' else ('return', 'evaluation_return')


def _evaluation(seed: Seed, records: Records, name: str) -> float:
    facts = records.facts(seed.run)
    found = None if facts is None else facts[name]
    return np.nan if found is None else found


def _counts(curves: Curves, teams: list[Team], curve: str) -> str:
    return ' + '.join(f'{count}' if count == team.seeds else f'{count} of {team.seeds}'
                      for count, team in zip(curves.counts(teams, curve), teams))


def _sizes(teams: Sequence[Team]) -> str:
    return ', '.join(str(team.num_agents) for team in teams)


def _number(mean: float, half: float) -> str:
    """`mean ± half` with two digits behind the point where the numbers are small, one otherwise."""
    if not np.isfinite(mean):
        return ''
    digits = 1 if abs(mean) >= 20 else 2
    return signed(mean, digits) + (f' ± {half:.{digits}f}' if np.isfinite(half) else '')


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def _settings(curves: Curves) -> list[str]:
    """What differs from the defaults, for each task, and for each curve."""
    figure, lines = curves.figure, []
    for task in figure.tasks:
        common = _changed(figure.run(figure.sizes(task)[0], figure.baseline or next(iter(figure.curves)), 1).settings)
        varied = {name for changes in figure.curves.values() for name in changes}
        for name in {'task', 'num_agents', 'seed', 'total_steps'} | varied:
            common.pop(name, None)
        lines.append(f'- Settings of {task} (`config/{task}.yaml`) other than the defaults: {_listed(common) or "none"}.')
    told = '; '.join(f'{curve}: {_listed(changes)}' for curve, changes in figure.curves.items())
    return [*lines, f'- Curves: {told}.']


def _changed(settings: Settings) -> dict[str, Any]:
    return {name: value for name, value in config.flatten(settings).items() if value != config.SETTINGS[name].default}


def _listed(values) -> str:
    return ', '.join(f'`{name}` {value}' for name, value in values.items())


def _origins(facts: Sequence[dict[str, Any]]) -> list[str]:
    """Where the numbers come from: every machine, version and commit that took part."""
    machines = {'{processor}, {cores} cores, {system}'.format(**fact['machine']) for fact in facts}
    versions = {', '.join(f'{name} {version}' for name, version in fact['versions'].items()) for fact in facts}
    commits = {fact['machine']['commit'] for fact in facts}
    hours = sum(fact['seconds'] for fact in facts) / 3600
    return [f'- {len(facts)} runs, {hours:.1f} hours of training in one thread each, on {"; ".join(sorted(machines))}.',
            f'- Versions: {"; ".join(sorted(versions))}. Commit: {", ".join(sorted(commits))}.']
