"""Earlier rollouts for the reward network alone: r(s, a) does not depend on the policy, so they stay valid data for it."""

from __future__ import annotations

from typing import Iterator, Mapping

import torch
from torch import Tensor

from dae_ros import draws
from dae_ros.config import RewardNetworkSettings
from dae_ros.learning.chunks import ActionChunks, chosen_chunks
from dae_ros.learning.passes import Batch


class RewardReplay:
    """The chunks of the newest `replay_rollouts` rollouts, all of one size.

    A chunk keeps the recurrent states it began with when it was collected, as the networks were then.
    """

    def __init__(self, settings: RewardNetworkSettings, seed: int):
        self._settings = settings
        self._seed = seed
        self._rollouts = 0                    # added so far
        self._parts: dict[str, Tensor] = {}   # by field of ActionChunks [L, room, ...], and by member of the ensemble [room, ...]

    def add(self, chunks: ActionChunks, firsts: list[Tensor]) -> None:
        """Takes in a rollout [L, C, ...] with each member's first states [C, ...], in the place of the oldest."""
        count = len(firsts[0])
        new = chunks._asdict() | {f'first.{member}': first.unsqueeze(0) for member, first in enumerate(firsts)}
        if not self._parts:
            room = self._settings.replay_rollouts * count
            self._parts = {name: part.new_zeros(len(part), room, *part.shape[2:]) for name, part in new.items()}
        begin = self._rollouts % self._settings.replay_rollouts * count
        for name, part in new.items():
            self._parts[name][:, begin:begin + count] = part
        self._rollouts += 1

    def batches(self, member: int, rollout: int) -> Iterator[Batch]:
        """`replay_steps` draws of `replay_chunks` chunks each, for one member of the ensemble."""
        settings, chunks = self._settings, ActionChunks(*(self._parts[name] for name in ActionChunks._fields))
        first = self._parts[f'first.{member}'][0]
        filled = len(first) * min(self._rollouts, settings.replay_rollouts) // settings.replay_rollouts
        for step in range(settings.replay_steps):
            draw = draws.generator(self._seed, f'reward_replay.{member}', rollout, step)
            chosen = torch.from_numpy(draw.integers(filled, size=settings.replay_chunks)).to(first.device)
            yield chosen_chunks(chunks, chosen), first[chosen]

    def state(self) -> dict[str, Tensor]:
        """All there is to save, by name."""
        return {'reward_replay.rollouts': torch.tensor(self._rollouts)} | {
            f'reward_replay.{name}': part for name, part in self._parts.items()}

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `state` gave; KeyError if it is another network's."""
        self._rollouts = int(tensors['reward_replay.rollouts'])
        self._parts = {name.removeprefix('reward_replay.'): tensor.clone() for name, tensor in tensors.items()
                       if name.startswith('reward_replay.') and tensor.dim()}
