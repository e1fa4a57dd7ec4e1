"""Ours: rollouts in one process and the learner. Arguments are settings, name:=value."""

from __future__ import annotations

import sys
from pathlib import Path

from clock import Clock

from dae_ros import config, settings_yaml
from dae_ros.rollout.in_process import train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds

settings = config.from_flat({'total_steps': 10**12, **dict(map(settings_yaml.parse_override, sys.argv[1:]))})
worlds = make_worlds(settings.task)
training = Training(settings, worlds.spec, RunFolder(Path('run'), settings))
train(training, worlds, Clock(settings.task.num_worlds * settings.run.num_steps, 'torch', 'numpy').tick)
