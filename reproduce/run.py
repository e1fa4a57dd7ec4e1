"""python -m reproduce.run FOLDER SETTINGS [exact] [pretrained=STEPS]: one training in this process, in one thread, resumed where
it was interrupted.

SETTINGS is a JSON object of settings by their names. The folder is a run's folder as bringup makes it, and holds beside it
`finished_<steps>.json`, the facts of every end it came to, and credit/metrics.csv, how well its reward network tells credit.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Mapping

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes
import numpy as np
import torch

from benchmarks.machine import description
from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.credit_probe import AlternativesRecorder, accuracy, probe
from dae_ros.errors import DaeRosError, RunFolderError
from dae_ros.files import hold, write_atomically
from dae_ros.report.metrics import MetricsLog
from dae_ros.rollout.in_process import train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds
from dae_ros.worlds.synchronous import SynchronousWorlds
from reproduce.figures import EXACT, PRETRAINED
from reproduce.pretraining import pretrained_file
from reproduce.records import finished_file

NICENESS = 10  # whoever works on this machine comes first
PROBE_INTERVAL = 50_000  # environment steps between two measurements of the credit


class Stopped(Exception):
    """The run was asked to stop before its end; its checkpoint is written."""


def run(path: Path, settings: Settings, stopping: Callable[[], bool], exact: bool = False, pretrained: int = 0) -> None:
    """Trains and evaluates in the folder `path` and writes its facts. exact: the simulator tells E[r], no network learns it.
    pretrained: steps its reward networks learn from first.

    Raises Stopped once `stopping` holds, and RunFolderError if the folder is another run's or is in use.
    """
    path.mkdir(parents=True, exist_ok=True)
    lock = hold(path / 'lock')
    if lock is None:
        raise RunFolderError(f'{path} is being trained by another process')
    with lock:
        if pretrained:
            def check() -> None:
                if stopping():
                    raise Stopped

            file = pretrained_file(path.parent, settings, pretrained, check)
            settings = config.from_flat({'reward_network.path': str(file)}, settings)
        _train(path, settings, stopping, exact)


def _train(path: Path, settings: Settings, stopping: Callable[[], bool], exact: bool) -> None:
    ran_on = description()  # the commit may be another one by the end
    _adopt(path, settings)
    worlds = make_worlds(settings.task)
    recorder = AlternativesRecorder(worlds) if exact else None
    training = Training(settings, worlds.spec, RunFolder(path, settings), recorder and recorder.expected_rewards)
    learns_reward = settings.learner.estimator == 'dae' and settings.learner.beta > 0 and not exact
    knows_truth = isinstance(worlds, SynchronousWorlds)
    credit = CreditLog(path / 'credit', training, worlds) if learns_reward and knows_truth else None

    def on_update() -> None:
        if credit is not None:
            credit.on_update()
        # Only between updates is there a state that the run can go on from with the same weights.
        if stopping():
            training.save()
            raise Stopped

    try:
        train(training, recorder or worlds, on_update)
        facts = {**_result(training), 'machine': ran_on, 'versions': versions(), 'settings': config.flatten(settings)}
        write_atomically(finished_file(path, training.environment_steps), (json.dumps(facts, indent=2) + '\n').encode())
    finally:
        training.close()
        worlds.close()
        if credit is not None:
            credit.close()


class CreditLog:
    """Measures every PROBE_INTERVAL steps how well the reward network tells credit, on rollouts that leave no trace."""

    def __init__(self, folder: Path, training: Training, worlds: SynchronousWorlds):
        self._training = training
        self._worlds = worlds
        self._log = MetricsLog(folder, training.environment_steps or None)
        self._probed_at = training.environment_steps

    def on_update(self) -> None:
        """Measures if it is time to, or the training is over."""
        training, run = self._training, self._training.settings.run
        steps = training.environment_steps
        if steps == self._probed_at or (steps // PROBE_INTERVAL == self._probed_at // PROBE_INTERVAL and not training.evaluating):
            return
        found = probe(self._worlds, training.policy, training.expected_rewards, run.seed, training.policy_version, run.num_steps)
        self._log.write(steps, accuracy(found.trajectory.rewards, found.expected, found.predicted)._asdict())
        self._probed_at = steps

    def close(self) -> None:
        self._log.close()


def _adopt(path: Path, settings: Settings) -> None:
    """Lets a run go on that was begun for fewer steps, or before a setting was declared that has its default here: nothing a
    run does depends on how long it is to be."""
    file = path / 'settings.yaml'
    if file.exists() and _but_for_length(config.from_flat(settings_yaml.load(file))) == _but_for_length(settings):
        write_atomically(file, settings_yaml.dump(settings).encode())


def _but_for_length(settings: Settings) -> Settings:
    return config.from_flat({'total_steps': 1}, settings)


def _result(training: Training) -> Mapping[str, Any]:
    returns = training.evaluation
    return {'environment_steps': training.environment_steps, 'seconds': training.seconds,
            'steps_per_second': training.environment_steps / training.seconds,
            'evaluation_return': float(returns.mean()) if len(returns) else None, 'evaluation_episodes': len(returns),
            'evaluation_win_rate': training.evaluation_win_rate,
            'weights_sha256': training.weights_sha256()}


def versions() -> dict[str, str]:
    """Of what the numbers may depend on."""
    return {'python': platform.python_version(), 'numpy': np.__version__, 'torch': torch.__version__}


def main() -> None:
    os.nice(NICENESS)
    asked, parent = [], os.getppid()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: asked.append(True))
    try:
        # Without its parent nobody would stop it, and it would hold the lock.
        run(Path(sys.argv[1]), config.from_flat(json.loads(sys.argv[2])), lambda: bool(asked) or os.getppid() != parent,
            EXACT in sys.argv[3:], sum(int(text.removeprefix(f'{PRETRAINED}=')) for text in sys.argv[3:] if text != EXACT))
    except Stopped:
        sys.exit('stopped; it goes on from here when it is started again')
    except DaeRosError as error:
        sys.exit(f'error: {error}')


if __name__ == '__main__':
    main()
