"""SMAX, the StarCraft-like battles of JaxMARL (Rutherford et al., 2023), as W worlds stepped at once by JAX on the CPU.

Needs the packages of requirements/smax.txt (`make smax`). Time in steps; positions and all else as JaxMARL has them.
"""

from __future__ import annotations

import contextlib
import io
import os
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds, check_actions

PREFIX = 'smax:'
REWARD_SCALE = 10.0  # to JaxMARL's

_MARINE, _MARAUDER, _STALKER, _ZEALOT, _ZERGLING, _HYDRALISK = range(6)
# Maps of the paper that JaxMARL does not have, as far as its units allow: allies, enemies.
OWN_MAPS = {
    'corridor': ([_ZEALOT] * 6, [_ZERGLING] * 24),  # on open ground
    'MMM': ([_MARAUDER] * 2 + [_MARINE] * 7,) * 2,  # without the medivacs that heal
    'MMM2': ([_MARAUDER] * 2 + [_MARINE] * 7, [_MARAUDER] * 3 + [_MARINE] * 8),  # likewise
}


class Shown(NamedTuple):
    """What W worlds show, as JAX's arrays."""

    observations: Any  # [W, N, O] float32
    state: Any         # [W, S] float32
    available: Any     # [W, N, A] bool
    alive: Any         # [W, N] bool


class SmaxWorlds(Worlds):
    """W battles of the task `smax:MAP` against JaxMARL's heuristic enemies.

    - A fallen unit has left the team; its action is JaxMARL's `stop`. The others' actions are JaxMARL's, in its order.
    - The reward is JaxMARL's, the share of the enemies' health taken and 1 for a victory, times 10: a victory is worth 20 in
      all, as in SMAC, for which the paper's settings of the reward network, which learns raw rewards, were made.
    - A battle that lasts `episode_steps` (0: JaxMARL's 100) is truncated; one that a side has lost is terminated.
    - Everything random in a step of a rollout comes from JAX keys drawn for it, a pair for each world.
    """

    def __init__(self, task: TaskSettings):
        if task.observe_others or task.reward_delay:
            raise SettingsError(f'observe_others and reward_delay do not belong to {task.task}')
        self._map = task.task, task.episode_steps
        self.num_worlds = task.num_worlds
        environment = _environment(*self._map)
        if environment.num_agents != task.num_agents:
            raise SettingsError(f'{task.task} has {environment.num_agents} units; set num_agents to {environment.num_agents}')
        self.spec = WorldSpec(environment.num_agents, environment.num_ally_actions, environment.obs_size, environment.state_size,
                              state_is_observations=False, has_wins=True)
        self._programs: tuple[Any, Any] | None = None
        self._battles: Any = None
        self._rollout_key: tuple[int, int] | None = None
        self._steps = 0

    def reset(self, seed: int, rollout: int) -> JointObservation:
        if self._programs is None:  # compiled where they are needed: who only wants the sizes need not wait
            self._programs = _programs(*self._map)
        self._rollout_key, self._steps = (seed, rollout), 0
        shown, self._battles = self._programs[0](self._keys())
        return _joint_observation(shown, np.ones(self.num_worlds, bool))

    def step(self, actions: np.ndarray) -> Transition:
        """As `Worlds.step`. Raises ValueError on actions of another shape, type or range, WorldError before `reset`."""
        if self._rollout_key is None:
            raise WorldError('the worlds must be reset before their first step')
        actions = check_actions(actions, self.num_worlds, self.spec)
        self._steps += 1
        outcome, shown, self._battles = self._programs[1](self._keys(), self._battles, actions.astype(np.int32))
        reward, ended, truncated, won, final_states = map(np.asarray, outcome)
        return Transition(reward, ended & ~truncated, truncated, final_states[truncated], _joint_observation(shown, ended), won)

    def _keys(self) -> np.ndarray:
        """JAX keys [W, 2, 2] for a step of each world and for the battle that may begin after it."""
        seed, rollout = self._rollout_key
        return draws.generator(seed, 'smax', rollout, self._steps).integers(2**32, size=(self.num_worlds, 2, 2), dtype=np.uint32)


def _joint_observation(shown: Shown, episode_start: np.ndarray) -> JointObservation:
    observations, state, available, alive = map(np.asarray, shown)
    return JointObservation(observations, state, episode_start, available, alive)


@lru_cache(maxsize=None)
def _environment(task: str, episode_steps: int) -> Any:
    """JaxMARL's environment of the task's map."""
    name = task.removeprefix(PREFIX)
    os.environ.setdefault('JAX_PLATFORMS', 'cpu')
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it greets
            import jax.numpy as jnp
            from jaxmarl.environments.smax import HeuristicEnemySMAX, Scenario, map_name_to_scenario
    except ImportError as error:
        raise WorldError(f'{task} needs JaxMARL ({error}); `make smax` installs it, with CPython 3.11 or newer') from error
    if name in OWN_MAPS:
        allies, enemies = OWN_MAPS[name]
        scenario = Scenario(jnp.array(allies + enemies, jnp.uint8), len(allies), len(enemies), False, False)
    else:
        try:
            scenario = map_name_to_scenario(name)
        except KeyError as error:
            also = '; 1c3s5z needs a colossus, which SMAX has not' if name == '1c3s5z' else ''
            raise SettingsError(f'SMAX has no map {name!r}; there are those of JaxMARL, such as 2s3z, and '
                                f'{", ".join(OWN_MAPS)}{also}') from error
    limit = {'max_steps': episode_steps} if episode_steps else {}
    return HeuristicEnemySMAX(scenario=scenario, **limit)


@lru_cache(maxsize=None)  # worlds of equal sizes need not wait for the compiler again
def _programs(task: str, episode_steps: int) -> tuple[Any, Any]:
    """Compiled programs: keys [W, 2, 2] to first battles, and keys, battles and actions [W, N] to what comes after."""
    import jax
    import jax.numpy as jnp

    environment = _environment(task, episode_steps)
    stop = environment.num_movement_actions - 1
    agents, N = environment.agents, environment.num_agents

    def show(observed: dict, battle: Any) -> Shown:
        alive = battle.state.unit_alive[:N]
        offered = environment.get_avail_actions(battle)
        available = jnp.stack([offered[agent] for agent in agents]) > 0
        nothing = jnp.arange(available.shape[1]) == 0
        return Shown(jnp.stack([observed[agent] for agent in agents]), observed['world_state'],
                     jnp.where(alive[:, None], available, nothing), alive)

    def begin(keys: Any) -> tuple[Shown, Any]:
        observed, battle = environment.reset(keys[1])
        # Of the types that `step` gives, lest it is compiled once for first battles and once for others: neither is weak then.
        return jax.tree.map(lambda leaf: leaf.astype(leaf.dtype), (show(observed, battle), battle))

    def step(keys: Any, battle: Any, actions: Any) -> tuple[tuple, Shown, Any]:
        actions = jnp.where(battle.state.unit_alive[:N], actions, stop)
        observed, battle, rewards, ended, _ = environment.step_env(keys[0], battle, dict(zip(agents, actions)))
        alive = battle.state.unit_alive
        won, lost = ~alive[N:].any(), ~alive[:N].any()
        ended = ended['__all__']
        outcome = REWARD_SCALE * rewards[agents[0]], ended, ended & ~won & ~lost, won & ~lost, observed['world_state']
        fresh = begin(keys)
        shown, battle = jax.tree.map(lambda new, old: jnp.where(ended, new, old).astype(new.dtype), fresh,
                                     (show(observed, battle), battle))
        return outcome, shown, battle

    return jax.jit(jax.vmap(begin)), jax.jit(jax.vmap(step))
