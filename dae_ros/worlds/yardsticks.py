"""Returns of teams that learnt nothing, to hold a trained team's return against."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.worlds import BUILT_IN, make_worlds, side_by_side, world_spec
from dae_ros.worlds.base import JointObservation, Worlds
from dae_ros.worlds.matching import match
from dae_ros.worlds.matrix_game import MatrixGame
from dae_ros.worlds.particle import ACTION_FORCE, DAMPING, TIME_STEP, ParticleWorlds, squared_length

GREEDY_STEPS = 5          # how far the greedy controller looks ahead
FEATURES_AT_ONCE = 2**21  # of the state, over all worlds played side by side

Controller = Callable[[Worlds, JointObservation, np.random.Generator], np.ndarray]


def yardstick_returns(task: TaskSettings, num_episodes: int, seed: int) -> dict[str, tuple[float, float]]:
    """Mean return and its standard error over `num_episodes` episodes for each untrained team that fits the task.

    'no-op' always takes the first action available, 'random' draws uniformly among these. Particle tasks add 'greedy', a
    centralised controller that sees everything (`greedy_actions`; a yardstick, not a bound), the matrix game 'best', its
    optimum. All teams play the same episodes. The standard error of a single episode is nan. Raises as `make_worlds`.
    """
    if num_episodes < 1:
        raise ValueError(f'num_episodes must be at least 1, not {num_episodes}')
    at_once = max(1, FEATURES_AT_ONCE // world_spec(task).state_size) if task.task in BUILT_IN else task.num_worlds
    worlds = make_worlds(side_by_side(task, min(num_episodes, at_once)))
    controllers: dict[str, Controller] = {'no-op': _no_op, 'random': _random}
    if isinstance(worlds, ParticleWorlds):
        controllers['greedy'] = lambda worlds, seen, draw: greedy_actions(worlds)
    if isinstance(worlds, MatrixGame):
        controllers['best'] = _highest
    try:
        return {name: _mean_return(worlds, controller, num_episodes, seed) for name, controller in controllers.items()}
    finally:
        worlds.close()


def greedy_actions(worlds: ParticleWorlds) -> np.ndarray:
    """Actions [W, N] that bring every robot nearest to its target, if after this action it coasts for a few steps.

    Targets are matched to robots anew at every step so that the sum of the distances is least.
    """
    positions, velocities, targets = (array.transpose(2, 1, 0) for array in
                                      (worlds.positions, worlds.velocities, worlds.targets))
    taken = match(np.sqrt(squared_length(targets[:, None] - positions[:, :, None])))
    missing = targets[:, taken, np.arange(worlds.num_worlds)] - positions
    coasting_time = TIME_STEP * sum((1.0 - DAMPING) ** step for step in range(GREEDY_STEPS))
    reached = coasting_time * ((1.0 - DAMPING) * velocities[:, None] + TIME_STEP * ACTION_FORCE[:, :, None, None])
    return np.argmin(squared_length(missing[:, None] - reached), axis=0).T


def _no_op(worlds: Worlds, seen: JointObservation, draw: np.random.Generator) -> np.ndarray:
    if seen.available is not None:
        return seen.available.argmax(axis=-1)
    return np.zeros((worlds.num_worlds, worlds.spec.num_agents), dtype=np.int64)


def _random(worlds: Worlds, seen: JointObservation, draw: np.random.Generator) -> np.ndarray:
    if seen.available is not None:
        return (draw.random(seen.available.shape) * seen.available).argmax(axis=-1)
    return draw.integers(worlds.spec.num_actions, size=(worlds.num_worlds, worlds.spec.num_agents))


def _highest(worlds: Worlds, seen: JointObservation, draw: np.random.Generator) -> np.ndarray:
    return np.full((worlds.num_worlds, worlds.spec.num_agents), worlds.spec.num_actions - 1)


def _mean_return(worlds: Worlds, controller: Controller, num_episodes: int, seed: int) -> tuple[float, float]:
    """Mean and standard error over whole episodes: the first of every world in a rollout, so that short ones count no
    more often than long ones."""
    returns = np.empty(0)
    for rollout in count():
        seen = worlds.reset(seed, rollout)
        total, running = np.zeros(worlds.num_worlds), np.ones(worlds.num_worlds, dtype=bool)
        for step in count():
            transition = worlds.step(controller(worlds, seen, draws.generator(seed, 'yardstick', rollout, step)))
            seen = transition.next
            total[running] += transition.reward[running]
            running &= ~(transition.terminated | transition.truncated)
            if not running.any():
                break
        returns = np.concatenate([returns, total])[:num_episodes]
        if len(returns) == num_episodes:
            error = returns.std(ddof=1) / np.sqrt(num_episodes) if num_episodes > 1 else float('nan')
            return float(returns.mean()), float(error)
