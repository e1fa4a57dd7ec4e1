"""SMAC (Samvelyan et al., 2019): battles in StarCraft II itself, a process for each world.

Unlike all other worlds these are not drawn from our keys alone: StarCraft II has randomness of its own, so two runs of the same
seed differ.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from typing import Sequence

import numpy as np

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds.base import JointObservation, Transition, Worlds, check_actions
from dae_ros.worlds.smac_game import Reply, Sizes

PREFIX = 'smac:'
FAREWELL = 10.0  # s for a game to end by itself


class SmacWorlds(Worlds):
    """W games of the task `smac:MAP`.

    Action 0 is SMAC's no-op, which only the fallen have, and they have no other. A game that ends by SMAC's time limit is
    truncated, any other end terminates it.
    """

    def __init__(self, task: TaskSettings):
        self._name = task.task
        if task.observe_others or task.reward_delay or task.episode_steps:
            raise SettingsError(f'observe_others, reward_delay and episode_steps do not belong to {task.task}')
        if importlib.util.find_spec('smac') is None:
            raise WorldError(f'{task.task} needs SMAC, the Python package of oxwhirl/smac, and StarCraft II 4.10 with its maps, '
                             'where SC2PATH says')
        self.num_worlds = task.num_worlds
        self._games = [_Game(task.task.removeprefix(PREFIX), world) for world in range(task.num_worlds)]
        try:
            sizes = [game.sizes() for game in self._games][0]
        except BaseException:
            self.close()
            raise
        if sizes.n_agents != task.num_agents:
            self.close()
            raise SettingsError(f'{task.task} has {sizes.n_agents} units; set num_agents to {sizes.n_agents}')
        self.spec = WorldSpec(*sizes, state_is_observations=False, has_wins=True)

    def reset(self, seed: int, rollout: int) -> JointObservation:
        replies = self._ask([b'r'] * self.num_worlds)
        return _joint_observation(replies, np.ones(self.num_worlds, bool))

    def step(self, actions: np.ndarray) -> Transition:
        """As `Worlds.step`. Raises ValueError on actions of another shape, type or range, WorldError if a game dies."""
        actions = check_actions(actions, self.num_worlds, self.spec)
        replies = self._ask([b's' + row.astype('<i4').tobytes() for row in actions])
        ended, cut_off, won = (np.array([getattr(reply, name) for reply in replies]) for name in ('ended', 'cut_off', 'won'))
        truncated = ended & cut_off
        finals = np.array([reply.final_state for reply in replies], np.float32)[truncated]
        return Transition(np.array([reply.reward for reply in replies], np.float32), ended & ~cut_off, truncated, finals,
                          _joint_observation(replies, ended), ended & won)

    def close(self) -> None:
        for game in self._games:
            game.begin_to_close()
        for game in self._games:
            game.close()
        self._games = []

    def _ask(self, commands: Sequence[bytes]) -> list[Reply]:
        """All games play at once."""
        for game, command in zip(self._games, commands):
            game.send(command)
        return [game.reply() for game in self._games]


class _Game:
    """A process of `smac_game`."""

    def __init__(self, name: str, world: int):
        self._what = f'game {world} of {name}'
        seed = str(draws.key(0, 'smac', world) % 2**31)
        command = [sys.executable, '-c', 'from dae_ros.worlds import smac_game; smac_game.main()', name, seed]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def sizes(self) -> Sizes:
        line = self._process.stdout.readline()
        if not line:
            self._died()
        self._sizes = Sizes(**json.loads(line))
        return self._sizes

    def send(self, command: bytes) -> None:
        try:
            self._process.stdin.write(command)
            self._process.stdin.flush()
        except BrokenPipeError:
            self._died()

    def reply(self) -> Reply:
        size = Reply.size(self._sizes)
        data = self._process.stdout.read(size)
        if len(data) < size:
            self._died()
        return Reply.from_bytes(data, self._sizes)

    def _died(self) -> None:
        raise WorldError(f'{self._what} ended unexpectedly, with exit code {self._process.wait()}; its last words are above')

    def begin_to_close(self) -> None:
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            pass  # it has died

    def close(self) -> None:
        try:
            self._process.wait(FAREWELL)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def _joint_observation(replies: Sequence[Reply], episode_start: np.ndarray) -> JointObservation:
    observations, state, available = (np.array([getattr(reply, name) for reply in replies])
                                      for name in ('observations', 'state', 'available'))
    return JointObservation(observations, state, episode_start, available, ~available[..., 0])
