"""Which device the learner computes on."""

from __future__ import annotations

import time

import numpy as np
import torch

from dae_ros.config import Settings
from dae_ros.errors import SettingsError
from dae_ros.learning.learner import Learner
from dae_ros.types import Trajectory, WorldSpec


def chosen_device(spec: WorldSpec, settings: Settings) -> torch.device:
    """The device the settings name; for `auto`, where there is a GPU, the one that learns from a random rollout faster.

    Which that is may change from one start to the next, and with it the last bits of the weights: whoever wants a resumed
    run to end bit for bit the same on a machine with a GPU names the device. Raises SettingsError for a GPU that is not
    there.
    """
    name = settings.learner.device
    if name == 'cuda' and not torch.cuda.is_available():
        raise SettingsError('device is cuda, but torch finds no CUDA device here; use cpu or auto')
    if name == 'auto' and torch.cuda.is_available():
        trajectory = random_trajectory(spec, settings.task.num_worlds, settings.run.num_steps)
        return min((torch.device('cpu'), torch.device('cuda')), key=lambda device: _seconds(spec, settings, trajectory, device))
    return torch.device('cpu' if name == 'auto' else name)


def _seconds(spec: WorldSpec, settings: Settings, trajectory: Trajectory, device: torch.device) -> float:
    """Time of one update on `device`, after one that warms up."""
    learner = Learner(spec, settings.learner, settings.reward_network, settings.run.seed, device=device)
    learner.update(trajectory, 0)
    began = time.perf_counter()
    learner.update(trajectory, 1)
    taken = time.perf_counter() - began
    learner.close()
    return taken


def random_trajectory(spec: WorldSpec, num_worlds: int, num_steps: int) -> Trajectory:
    """A rollout of one episode in the sizes of the run."""
    random = np.random.default_rng(0)
    T, W, (N, A, O, S, *_) = num_steps, num_worlds, spec
    episode_start, terminated = np.zeros((T + 1, W), bool), np.zeros((T, W), bool)
    episode_start[[0, -1]] = terminated[-1] = True
    return Trajectory(random.standard_normal((T, W, N, O), np.float32), random.standard_normal((T + 1, W, S), np.float32),
                      episode_start, random.integers(A, size=(T, W, N)),
                      random.dirichlet(np.ones(A), (T, W, N)).astype(np.float32), random.standard_normal((T, W), np.float32),
                      terminated, np.zeros((T, W), bool), np.zeros((0, S), np.float32))
