"""What runs have left on disk: how far each is, and, also when its folder is gone, the record that is kept of its ends.

A run's folder holds checkpoints and logs, and belongs to the machine that trains it. Its record is one small file among the
results: figures are drawn from it, and whoever has it need not train the run again.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterable, Mapping

import numpy as np

from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.errors import SettingsError
from dae_ros.files import write_atomically
from dae_ros.report.metrics import STEPS, read_metrics
from reproduce.figures import SECONDS, Run

KEPT = 'runs'  # folder of the records, below that of the results
METRICS = ('mean_return', 'win_rate', 'advantage/deviation', 'reward_network/explained_variance', 'policy/entropy')
SPENT = ('seconds/collecting', 'seconds/learning')
CREDIT = ('explained', 'credit_explained')
DIGITS = 5
OF_THE_FOLDER_ALONE = {'total_steps': 1, 'reward_network.path': ''}  # settings that do not make it another run


def finished_file(folder: Path, environment_steps: int) -> Path:
    """Where a run's facts lie that came to an end after so many steps."""
    return folder / f'finished_{environment_steps:010d}.json'


@dataclass(frozen=True)
class Record:
    """What is told of a run: metrics by name, each [rows], those of its credit too, and the facts of its ends by their steps."""

    settings: Mapping[str, Any]
    metrics: Mapping[str, np.ndarray]
    credit: Mapping[str, np.ndarray]
    ends: Mapping[int, Mapping[str, Any]]

    @property
    def steps(self) -> int:
        return int(self.metrics[STEPS][-1]) if len(self.metrics[STEPS]) else 0

    def covers(self, run: Run) -> bool:
        """Whether it is of this run, and the run came to its end, or went past it on the way to more steps."""
        own, asked = self.settings, _settings(run.settings)
        if run.exact:
            own, asked = map(_without_reward_network, (own, asked))
        return (run.steps in self.ends or self.steps > run.steps) and own == asked


class Records:
    """The folder all runs lie in, and the one of the records that are kept."""

    def __init__(self, folder: Path, results: Path):
        self.folder = folder
        self._kept = results / KEPT

    def path(self, run: Run) -> Path:
        return self.folder / run.name

    def log_file(self, run: Run) -> Path:
        """What the run's process said."""
        return self.path(run) / 'log.txt'

    def finished(self, run: Run) -> bool:
        """Whether it came to its end, here or elsewhere."""
        return self._record(run) is not None

    def facts(self, run: Run) -> Mapping[str, Any] | None:
        """Of the end at exactly its steps; None if it went past them without one."""
        record = self._record(run)
        return record and record.ends.get(run.steps)

    def speed(self, runs: Iterable[Run]) -> float:
        """Robot steps per second and core, over those of `runs` that came to an end; nan if none did."""
        ends = [(run, facts) for run in runs if (facts := self.facts(run)) is not None]
        work = sum(run.steps * run.settings.task.num_agents for run, _ in ends)
        return work / sum(facts['seconds'] for _, facts in ends) if ends else math.nan

    def metrics(self, run: Run) -> dict[str, np.ndarray]:
        """Columns of a finished run's metrics up to its steps, [rows] by name; SECONDS are those of each update."""
        metrics = self._record(run).metrics
        rows = metrics[STEPS] <= run.steps
        return {name: values[rows] for name, values in metrics.items()}

    def credit(self, run: Run) -> Mapping[str, np.ndarray]:
        """Columns of what was measured of a finished run's credit, [rows] by name; none where it learns no reward."""
        return self._record(run).credit

    def progress(self, name: str) -> tuple[int, float]:
        """Environment steps behind the run of this name in its folder, and the mean return of its newest rollout."""
        columns = _columns(self.folder / name / 'metrics.csv')
        return (int(columns[STEPS][-1]), float(columns['mean_return'][-1])) if len(columns[STEPS]) else (0, float('nan'))

    def keep(self, run: Run) -> None:
        """Writes the record of a finished run whose folder is here; one that goes as far stays as it is."""
        own, kept = self._in_folder(run), self._in_file(run)
        if own is None or not own.covers(run) or kept is not None and kept.covers(run) and kept.steps >= own.steps:
            return
        self._kept.mkdir(parents=True, exist_ok=True)
        write_atomically(self._file(run), _encoded(own).encode())

    def _record(self, run: Run) -> Record | None:
        """The kept one first, so that a figure is the same wherever it is drawn."""
        return next((record for read in (self._in_file, self._in_folder) if (record := read(run)) and record.covers(run)), None)

    def _in_folder(self, run: Run) -> Record | None:
        path = self.path(run)
        if not (path / 'settings.yaml').exists():
            return None
        columns = _columns(path / 'metrics.csv')
        metrics = {STEPS: columns[STEPS], **{name: columns[name] for name in METRICS if name in columns}}
        if len(columns[STEPS]):
            metrics[SECONDS] = sum(columns[name] for name in SPENT)
        measured = _columns(path / 'credit' / 'metrics.csv')
        credit = {name: measured[name] for name in (STEPS, *CREDIT)} if len(measured[STEPS]) else {}
        ends = {}
        for file in path.glob('finished_*.json'):
            facts = json.loads(file.read_text(encoding='utf-8'))
            facts.pop('settings')
            ends[facts['environment_steps']] = facts
        return Record(_settings(config.from_flat(settings_yaml.load(path / 'settings.yaml'))), metrics, credit, ends)

    def _file(self, run: Run) -> Path:
        return self._kept / f'{run.name}.json'

    def _in_file(self, run: Run) -> Record | None:
        file = self._file(run)
        try:
            return _decoded(file.read_text(encoding='utf-8')) if file.exists() else None
        except SettingsError:  # of a setting that is no more: no run of today
            return None


def _settings(settings: Settings) -> dict[str, Any]:
    """Those that make it another run: not what a reward network would be like that it does not have."""
    values = config.flatten(config.from_flat(OF_THE_FOLDER_ALONE, settings))
    if settings.learner.estimator == 'dae' and settings.learner.beta == 0:
        return _without_reward_network(values)
    if settings.reward_network.architecture == 'per_agent':
        del values['reward_network.trunk_size']
    return values


def _without_reward_network(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if not name.startswith('reward_network.')}


def _columns(file: Path) -> dict[str, np.ndarray]:
    return read_metrics(file) if file.exists() else {STEPS: np.empty(0)}


def _encoded(record: Record) -> str:
    """As JSON, a column or an end on each line; five digits are more than any figure shows."""
    def column(name: str, values: np.ndarray) -> str:
        numbers = values.astype(int).tolist() if name == STEPS else [
            None if math.isnan(value) else float(f'{value:.{DIGITS}g}') for value in values]
        return json.dumps(numbers, separators=(',', ':'))

    def block(entries: Mapping[str, str]) -> str:
        return '{' + ','.join(f'\n  {json.dumps(name)}: {text}' for name, text in entries.items()) + '}'

    parts = {'settings': json.dumps(record.settings),
             'ends': block({str(steps): json.dumps(facts) for steps, facts in sorted(record.ends.items())}),
             'metrics': block({name: column(name, values) for name, values in record.metrics.items()}),
             'credit': block({name: column(name, values) for name, values in record.credit.items()})}
    return '{' + ',\n'.join(f'{json.dumps(name)}: {text}' for name, text in parts.items()) + '}\n'


def _decoded(text: str) -> Record:
    """What `_encoded` wrote. A setting that has been declared since had its default then."""
    content = json.loads(text)
    columns = {part: {name: np.array(values, dtype=np.float64) for name, values in content[part].items()}
               for part in ('metrics', 'credit')}
    return Record(_settings(config.from_flat(content['settings'])), columns['metrics'], columns['credit'],
                  {int(steps): facts for steps, facts in content['ends'].items()})
