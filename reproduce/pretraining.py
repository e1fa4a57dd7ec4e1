"""Reward networks that are trained before a run begins, from a bag of a team that has learnt nothing."""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
from pathlib import Path
from typing import Callable, Iterator

from benchmarks.machine import ROOT
from dae_ros import config, draws
from dae_ros.config import RewardTrainingSettings, Settings
from dae_ros.files import write_atomically
from dae_ros.learning.learner import Learner
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.played import write_rollouts
from dae_ros.replay.reward_training import RewardTraining
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest, Trajectory
from dae_ros.worlds import make_worlds

SCHEMAS = ROOT / 'msg_schemas' / 'msg'
FOLDER = 'pretrained'  # beside the runs
MOST_EPOCHS = 10  # passes over the bag: some minutes in one thread; a little more is to be had for very much more
OF_THE_RUN_ALONE = {'reward_network.path': '', 'reward_network.freeze': False, 'total_steps': 1}  # nothing of it enters here


def pretrained_file(runs: Path, settings: Settings, steps: int, check: Callable[[], None]) -> Path:
    """The reward networks for a run of these settings, trained now if they are not there yet.

    They learn from `steps` environment steps of a team whose policy has the weights it begins with. What is drawn is keyed apart
    from the run of that seed. `check` is called again and again meanwhile, and may raise.
    """
    settings = config.from_flat(OF_THE_RUN_ALONE, settings)
    task = settings.task
    # A setting that is declared later, and has its default here, does not make it another one.
    changed = {name: value for name, value in config.flatten(settings).items() if value != config.SETTINGS[name].default}
    digest = hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:12]
    folder = runs / FOLDER / f'{task.task}_n{task.num_agents}_seed{settings.run.seed}_{steps}_{digest}'
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / 'reward.safetensors'
    with open(folder / 'lock', 'w') as lock:  # runs that share it wait for the first
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            shutil.rmtree(folder / 'bag', ignore_errors=True)
            write_rollouts(folder / 'bag', _played(settings, steps, check), SCHEMAS)
            write_atomically(file, _trained(folder / 'bag', settings, check))
    return file


def _played(settings: Settings, steps: int, check: Callable[[], None]) -> Iterator[tuple[RolloutRequest, Trajectory]]:
    worlds = make_worlds(settings.task)
    learner = Learner(worlds.spec, settings.learner, settings.reward_network, settings.run.seed)
    collector = InProcessCollector(worlds)
    try:
        for rollout in range(-(-steps // (settings.task.num_worlds * settings.run.num_steps))):
            check()
            request = RolloutRequest(run=1, rollout=rollout, attempt=0, policy_version=0, num_steps=settings.run.num_steps,
                                     seed=draws.key(settings.run.seed, 'pretraining') % 2**63, greedy=False)
            yield request, collector.collect(request, learner.policy)
    finally:
        learner.close()
        worlds.close()


def _trained(bag: Path, settings: Settings, check: Callable[[], None]) -> bytes:
    training = RewardTraining(Dataset(bag), settings, RewardTrainingSettings(max_epochs=MOST_EPOCHS), lambda done, total: check())
    try:
        for epoch in training.run():
            print(f'epoch {epoch.number}: held-out error {epoch.held_out_error:.4g}, that of the mean reward is '
                  f'{training.baseline.held_out_error:.4g}', flush=True)
        return training.file()
    finally:
        training.close()
