"""Any PettingZoo parallel environment with discrete actions as W worlds in this process."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Iterator

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds, check_actions
from dae_ros.worlds.modules import module_of

PREFIX = 'pettingzoo:'


class PettingZooWorlds(Worlds):
    """W instances of the environment `MODULE.parallel_env`, for the task `pettingzoo:MODULE`.

    - Observations are flattened to float32 and padded with zeros to the longest among the agents.
    - The state is the environment's `state()`; where there is none, the padded observations one after another. Where agents
      have a `state` in their infos, each is valued by its own; it is zeros for one that has left.
    - The team's reward is the mean of the agents' rewards; one that has left gets none.
    - An agent that ends before the others has left the team: it observes zeros, and its action is not passed on.
    - An episode ends with its last agents: terminated if these all are, truncated if not.
    - Masks of actions are taken from `action_mask` in an agent's observation or info.
    - `N` and `max_cycles` are passed on to environments that take them (num_agents, and episode_steps if it is not 0).
    - Every episode is seeded from (seed, 'reset', rollout, step, world). Python's and NumPy's global generators, which
      some environments use, are seeded from (seed, 'global', rollout, step) while the environments run, and put back.

    Raises WorldError for what cannot be simulated, SettingsError for settings that do not fit.
    """

    def __init__(self, task: TaskSettings):
        self._name = task.task
        if task.observe_others:
            raise SettingsError(f'observe_others belongs to formation and line; set it to false for {self._name}')
        if task.reward_delay:
            raise SettingsError(f'reward_delay belongs to the built-in tasks; set it to 0 for {self._name}')
        build = _find_parallel_env(task.task)
        self.num_worlds = task.num_worlds
        self._environments: list[Any] = []
        self._present: list[list[str]] = [[] for _ in range(task.num_worlds)]  # who has not left, by world
        self._rollout_key: tuple[int, int] | None = None
        self._steps = 0
        try:
            with _private_global_generators(0):
                self._environments.append(_build(build, task))
                self.spec = self._inspect(self._environments[0], task)
                self._environments += [_build(build, task) for _ in range(task.num_worlds - 1)]
        except BaseException:
            self.close()
            raise

    def _inspect(self, environment: Any, task: TaskSettings) -> WorldSpec:
        """Sizes of `environment`, and how to flatten what its agents observe."""
        from gymnasium import spaces

        if not hasattr(environment, 'possible_agents'):
            raise WorldError(f'{self._name} does not list its possible_agents, so its team is not known beforehand')
        self._agents = list(environment.possible_agents)
        if len(self._agents) != task.num_agents:
            raise SettingsError(f'{self._name} has {len(self._agents)} agents; set num_agents to {len(self._agents)}')
        actions = [environment.action_space(agent) for agent in self._agents]
        if not all(isinstance(space, spaces.Discrete) for space in actions):
            raise WorldError(f'{self._name} has actions that are not discrete ({actions[0]}); they must be Discrete')
        counts = [int(space.n) for space in actions]
        if len(set(counts)) > 1:
            raise WorldError(f'the agents of {self._name} have different numbers of actions ({counts}); '
                             'they must all have the same')
        self._first_actions = [int(space.start) for space in actions]
        self._spaces = [_without_mask(environment.observation_space(agent)) for agent in self._agents]
        try:
            observation_size = max(spaces.utils.flatdim(space) for space in self._spaces)
        except (NotImplementedError, ValueError) as error:
            raise WorldError(f'the observations of {self._name} cannot be flattened: {error}') from error
        if observation_size == 0:
            raise WorldError(f'{self._name} shows its agents nothing')

        _, infos = environment.reset(seed=0)
        own = [np.size(infos[agent]['state']) for agent in self._agents if 'state' in infos.get(agent, {})]
        self._has_own_states = bool(own)
        if own:
            if len(own) < task.num_agents or len(set(own)) > 1:
                raise WorldError(f'the agents of {self._name} do not all have states of the same size in their infos')
            return WorldSpec(task.num_agents, counts[0], observation_size, sum(own), state_is_observations=False,
                             states_per_agent=True)
        try:
            state_size = np.asarray(environment.state(), dtype=np.float32).size
        except (NotImplementedError, AttributeError):
            state_size = 0
        self._has_state = state_size > 0
        return WorldSpec(task.num_agents, counts[0], observation_size,
                         state_size or task.num_agents * observation_size, state_is_observations=not self._has_state)

    def reset(self, seed: int, rollout: int) -> JointObservation:
        self._rollout_key = (seed, rollout)
        self._steps = 0
        shown = self._empty()
        with self._own_generators():
            for world in range(self.num_worlds):
                self._begin_episode(world, shown)
        return _joint_observation(shown, np.ones(self.num_worlds, dtype=bool))

    def step(self, actions: np.ndarray) -> Transition:
        """As `Worlds.step`. Raises ValueError on actions of another shape, type or range, and WorldError before `reset`."""
        if self._rollout_key is None:
            raise WorldError('the worlds must be reset before their first step')
        actions = check_actions(actions, self.num_worlds, self.spec) + np.array(self._first_actions)
        self._steps += 1
        shown = self._empty()
        reward = np.empty(self.num_worlds, dtype=np.float32)
        terminated, truncated = np.zeros((2, self.num_worlds), dtype=bool)
        final_states = []
        with self._own_generators():
            for world, environment in enumerate(self._environments):
                acting = self._present[world]
                joint_action = {agent: action for agent, action in zip(self._agents, actions[world].tolist()) if agent in acting}
                seen, rewards, terminations, truncations, infos = environment.step(joint_action)
                reward[world] = sum(float(rewards[agent]) for agent in acting) / self.spec.num_agents
                staying = [agent for agent in acting if not (terminations[agent] or truncations[agent])
                           and agent in environment.agents]
                terminated[world] = all(terminations[agent] for agent in acting)
                truncated[world] = not staying and not terminated[world]
                self._present[world] = staying
                if not terminated[world]:
                    self._show(world, staying or acting, seen, infos, shown)
                if truncated[world]:
                    final_states.append(shown.state[world].copy())
                if not staying:
                    self._begin_episode(world, shown)
        return Transition(reward, terminated, truncated,
                          np.array(final_states, dtype=np.float32).reshape(-1, self.spec.state_size),
                          _joint_observation(shown, terminated | truncated))

    def close(self) -> None:
        for environment in self._environments:
            environment.close()
        self._environments = []

    def _empty(self) -> JointObservation:
        W, (N, A, O, S, *_) = self.num_worlds, self.spec
        return JointObservation(np.empty((W, N, O), np.float32), np.empty((W, S), np.float32), np.empty(W, bool),
                                np.empty((W, N, A), bool), np.empty((W, N), bool))

    def _own_generators(self):
        seed, rollout = self._rollout_key
        return _private_global_generators(draws.key(seed, 'global', rollout, self._steps))

    def _begin_episode(self, world: int, shown: JointObservation) -> None:
        seed, rollout = self._rollout_key
        environment = self._environments[world]
        seen, infos = environment.reset(seed=draws.key(seed, 'reset', rollout, self._steps, world) % 2**31)
        if set(environment.agents) != set(self._agents):
            raise WorldError(f'{self._name} begins an episode with {len(environment.agents)} of its '
                             f'{self.spec.num_agents} agents; all must be there')
        self._present[world] = self._agents
        self._show(world, self._agents, seen, infos, shown)

    def _show(self, world: int, present: Sequence[str], seen: Mapping[str, Any], infos: Mapping[str, Any],
              shown: JointObservation) -> None:
        """Write what the agents `present` in a world see and may do, and its state, into the world's part of `shown`."""
        from gymnasium import spaces

        observations, available = shown.observations[world], shown.available[world]
        observations[:], available[:] = 0.0, True
        for row, agent, space, mask in zip(observations, self._agents, self._spaces, available):
            if agent not in present:
                mask[1:] = False
                continue
            values, info = seen[agent], infos.get(agent, {})
            given = info.get('action_mask', values.get('action_mask') if isinstance(values, Mapping) else None)
            if given is not None:
                mask[:] = np.asarray(given).astype(bool)
                if not mask.any():
                    raise WorldError(f'{agent} of {self._name} has no action it may choose')
            if isinstance(space, spaces.Dict):
                values = {name: values[name] for name in space.spaces}
            flat = np.ravel(values) if isinstance(space, spaces.Box) else spaces.utils.flatten(space, values)
            row[:flat.size] = flat
        shown.present[world] = [agent in present for agent in self._agents]
        if self._has_own_states:
            states = shown.state[world].reshape(len(self._agents), -1)
            states[:] = 0.0
            for agent in present:
                states[self._agents.index(agent)] = np.ravel(infos[agent]['state'])
        else:
            shown.state[world] = np.ravel(self._environments[world].state()) if self._has_state else np.ravel(observations)


def _without_mask(space: Any) -> Any:
    """An observation's space less its mask of actions."""
    from gymnasium import spaces

    if not isinstance(space, spaces.Dict) or 'action_mask' not in space.spaces:
        return space
    return spaces.Dict({name: part for name, part in space.spaces.items() if name != 'action_mask'})


def _joint_observation(shown: JointObservation, episode_start: np.ndarray) -> JointObservation:
    """What was written, without flags that say nothing."""
    return shown._replace(episode_start=episode_start, available=None if shown.available.all() else shown.available,
                          present=None if shown.present.all() else shown.present)


def _find_parallel_env(task: str) -> Any:
    module = module_of(task, PREFIX)
    build = getattr(module, 'parallel_env', None)
    if not callable(build):
        raise WorldError(f'{module.__name__} has no parallel_env, so it is not a PettingZoo parallel environment')
    return build


def _build(build: Any, task: TaskSettings) -> Any:
    """The environment, with those of our settings that it takes: only trying tells, as most hide behind **kwargs."""
    arguments = {'N': task.num_agents}
    if task.episode_steps:
        arguments['max_cycles'] = task.episode_steps
    while True:
        try:
            return build(**arguments)
        except TypeError as error:
            refused = next((name for name in arguments if f"unexpected keyword argument '{name}'" in str(error)), None)
            if refused is None:
                raise
            if refused == 'max_cycles':
                raise SettingsError(f'{task.task} takes no max_cycles; set episode_steps to 0') from error
            del arguments[refused]


@contextmanager
def _private_global_generators(seed: int) -> Iterator[None]:
    """Python's and NumPy's global generators seeded for the block, and as they were afterwards."""
    python_state, numpy_state = random.getstate(), np.random.get_state()
    random.seed(seed)
    np.random.seed(seed % 2**32)
    try:
        yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)
