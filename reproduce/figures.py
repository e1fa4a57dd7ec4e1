"""Which figures there are, and the runs each of them needs: what config/figures/*.yaml declares, strictly checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Mapping

import yaml

from benchmarks.machine import ROOT
from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.errors import SettingsError
from dae_ros.report.metrics import STEPS
from dae_ros.worlds import smax

FOLDER = ROOT / 'config' / 'figures'
# One thread each: side by side, runs use the cores better than a learner's threads do.
EVERY_RUN = {'device': 'cpu', 'learner_threads': 1}
SECONDS = 'seconds'
EXACT = 'exact'  # true among a curve's settings: its runs are told the simulator's E[r]
PRETRAINED = 'pretrained'  # among them too: steps of a team that has learnt nothing, from which its reward networks learn first
METRICS = {'mean_return': 'mean return of an episode', 'win_rate': 'share of the episodes won',
           'advantage/deviation': 'standard deviation of the advantages',
           'reward_network/explained_variance': 'variance of the reward explained',
           'expected_reward/explained': 'variance of E[r] explained', 'credit/explained': 'credit explained',
           STEPS: 'environment steps', SECONDS: 'seconds of training, in one thread'}
SHORT_STEPS = 200  # of each run
SHORT_PRETRAINING = 400
SHORT = {'num_worlds': 4, 'epochs': 1, 'reward_network.epochs': 1, 'evaluation_episodes': 8}


@dataclass(frozen=True)
class Run:
    """One training. Runs of the same name differ in nothing but their steps: the longer one goes on from the shorter."""

    name: str
    settings: Settings
    exact: bool = False  # with the simulator's own E[r] in place of reward networks
    pretrained: int = 0  # steps its reward networks learn from before it begins

    @property
    def seed(self) -> int:
        return self.settings.run.seed

    @property
    def updates(self) -> int:
        return -(-self.settings.run.total_steps // self.steps_per_update)

    @property
    def steps_per_update(self) -> int:
        return self.settings.task.num_worlds * self.settings.run.num_steps

    @property
    def steps(self) -> int:
        """Environment steps at its end: whole rollouts."""
        return self.updates * self.steps_per_update


@dataclass(frozen=True)
class Team:
    """A task with a team size, and how long and how often it is trained."""

    task: str  # its task file below config/, without the suffix
    num_agents: int
    seeds: int
    steps: int
    first_seed_steps: int  # seed 1 goes on to these


@dataclass(frozen=True)
class Figure:
    """One of the paper's figures: curves of every team, over environment steps."""

    name: str
    title: str
    shows: str                           # the metric
    curves: Mapping[str, Mapping[str, Any]]  # settings that differ from the task file, by the curve's name
    teams: tuple[Team, ...]
    against: str                         # STEPS, or a metric: 'seconds' is an axis like steps, others give a point a seed
    average: bool                        # over the team sizes of a task
    threshold: float | None
    baseline: str | None
    until: int | None                    # environment steps after which it shows no more of its runs
    palette: tuple[str, ...]             # all curves of the file, so that a curve has one colour in all its figures
    short: bool

    @property
    def scattered(self) -> bool:
        """Whether every seed is one point, of where its training ended."""
        return self.against not in (STEPS, SECONDS)

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(team.task for team in self.teams))

    @property
    def is_playable(self) -> bool:
        """Whether what its tasks need beside this package is installed."""
        plays_smax = any(_task_file(team.task)['task'].startswith(smax.PREFIX) for team in self.teams)
        return not plays_smax or find_spec('jaxmarl') is not None

    def sizes(self, task: str) -> list[Team]:
        """The teams of one task."""
        return [team for team in self.teams if team.task == task]

    def run(self, team: Team, curve: str, seed: int, steps: int | None = None) -> Run:
        """The run behind one curve and seed; `steps` other than the team's make it a longer one."""
        changes = dict(self.curves[curve])
        exact, pretrained = bool(changes.pop(EXACT, False)), changes.pop(PRETRAINED, 0)
        values = {**_task_file(team.task), **EVERY_RUN, **(SHORT if self.short else {}), **changes,
                  'num_agents': team.num_agents, 'seed': seed, 'total_steps': steps or team.steps}
        try:
            settings = config.from_flat(values)
        except SettingsError as error:
            raise SettingsError(f'curve {curve} of figure {self.name}: {error}') from error
        # Named after its settings, not after a figure or a curve, so that figures share it; a file's name has to hold them all.
        different = ''.join(f'_{name.replace("reward_network", "reward")}-{_text(config.flatten(settings)[name])}'
                            for name in sorted(changes))
        different += f'_{EXACT}' if exact else f'_{PRETRAINED}-{pretrained}' if pretrained else ''
        return Run(f'{Path(team.task).name}_n{team.num_agents}{different}_seed{seed}', settings, exact,
                   min(pretrained, SHORT_PRETRAINING) if self.short else pretrained)

    def runs(self, team: Team, curve: str) -> list[Run]:
        """One for each seed."""
        return [self.run(team, curve, seed) for seed in range(1, team.seeds + 1)]

    def longer_run(self, team: Team, curve: str) -> Run | None:
        """Seed 1 with more steps, where it goes on."""
        return self.run(team, curve, 1, team.first_seed_steps) if team.first_seed_steps > team.steps else None

    def all_runs(self) -> list[Run]:
        """Every run of every team and curve, the longer ones included."""
        found = [run for team in self.teams for curve in self.curves for run in self.runs(team, curve)]
        longer = (self.longer_run(team, curve) for team in self.teams for curve in self.curves)
        return found + [run for run in longer if run is not None]


def load(names: list[str], seeds: int | None = None, steps: int | None = None, short: bool = False,
         folder: Path = FOLDER) -> list[Figure]:
    """The figures of these names, all without any; `seeds` and `steps` replace those declared, for every team.

    short: only the first team of each figure, with one seed, a few worlds and updates, where nothing else is asked for.
    Raises SettingsError if a declaration is not as it should be or there is no such figure.
    """
    figures = {figure.name: figure for path in sorted(folder.glob('*.yaml')) for figure in _figures_of(path)}
    unknown = [name for name in names if name not in figures]
    if unknown:
        raise SettingsError(f'there is no figure {", ".join(unknown)}; there are {", ".join(figures)}')
    return [_resized(figures[name], seeds, steps, short) for name in names or figures]


def _resized(figure: Figure, seeds: int | None, steps: int | None, short: bool) -> Figure:
    teams = figure.teams
    if short:
        teams, seeds, steps = teams[:1], seeds or 1, steps or SHORT_STEPS
    if seeds:
        teams = [replace(team, seeds=seeds) for team in teams]
    if steps:
        teams = [replace(team, steps=steps, first_seed_steps=steps) for team in teams]
    return replace(figure, teams=tuple(teams), short=short)


@lru_cache(maxsize=None)
def _task_file(task: str) -> dict[str, Any]:
    return settings_yaml.load(ROOT / 'config' / f'{task}.yaml')


def _text(value: Any) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value)


def _figures_of(path: Path) -> list[Figure]:
    content = _fields(_read(path), str(path), {'teams': dict, 'curves': dict, 'figures': dict})
    teams = tuple(_team(path, task, size, declared) for task, sizes in content['teams'].items()
                  for size, declared in _mapping(sizes, f'teams of {task} in {path}').items())
    curves = {name: _mapping(changes, f'curve {name} in {path}') for name, changes in content['curves'].items()}
    figures = []
    for name, declared in content['figures'].items():
        origin = f'figure {name} in {path}'
        parts = _fields(_mapping(declared, origin), origin, {'title': str, 'shows': str, 'curves': list},
                        {'against': str, 'average': bool, 'threshold': float, 'baseline': str, 'until': int})
        for curve in parts['curves']:
            if curve not in curves:
                raise SettingsError(f'{origin} names the curve {curve!r}, which is not under curves')
        if parts['baseline'] not in (None, *parts['curves']):
            raise SettingsError(f'{origin} has the baseline {parts["baseline"]!r}, which is none of its curves')
        if parts['threshold'] is not None and parts['baseline'] is None:
            raise SettingsError(f'{origin} has a threshold and no baseline to be sooner than')
        if parts['until'] is not None and parts['until'] < 1:
            raise SettingsError(f'{origin} must show at least one step, not until {parts["until"]}')
        against = parts['against'] or STEPS
        for metric in (parts['shows'], against):
            if metric not in METRICS:
                raise SettingsError(f'{origin} cannot show {metric!r}; known are {", ".join(METRICS)}')
        figures.append(Figure(str(name), parts['title'], parts['shows'], {curve: curves[curve] for curve in parts['curves']},
                              teams, against, bool(parts['average']), parts['threshold'], parts['baseline'], parts['until'],
                              tuple(curves), short=False))
    return figures


def _team(path: Path, task: str, size: Any, declared: Any) -> Team:
    origin = f'team {task} of {size} in {path}'
    parts = _fields(_mapping(declared, origin), origin, {'seeds': int, 'steps': int}, {'first_seed_steps': int})
    if type(size) is not int or parts['seeds'] < 1 or parts['steps'] < 1:
        raise SettingsError(f'{origin}: team size, seeds and steps must be integers of at least 1')
    return Team(task, size, parts['seeds'], parts['steps'], parts['first_seed_steps'] or parts['steps'])


def _read(path: Path) -> dict[str, Any]:
    try:
        return _mapping(yaml.safe_load(path.read_text(encoding='utf-8')), str(path))
    except yaml.YAMLError as error:
        raise SettingsError(f'{path} is not YAML: {" ".join(str(error).split())}') from error


def _mapping(value: Any, origin: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise SettingsError(f'{origin} must be a mapping, not {value!r}')
    return value


def _fields(values: dict[Any, Any], origin: str, needed: Mapping[str, type],
            optional: Mapping[str, type] = {}) -> dict[str, Any]:
    """`values`, None for what is optional and missing.

    Raises SettingsError for a key that is unknown, missing or of another type.
    """
    kinds = {**needed, **optional}
    for name, value in values.items():
        if name not in kinds:
            raise SettingsError(f'{origin} has the unknown key {name!r}; known are {", ".join(kinds)}')
        if type(value) is not kinds[name] and (kinds[name] is not float or type(value) is not int):
            raise SettingsError(f'{origin}: {name} must be of type {kinds[name].__name__}, not {value!r}')
    for name in needed:
        if name not in values:
            raise SettingsError(f'{origin} lacks the key {name!r}')
    return {name: values.get(name) for name in kinds}
