"""One game of SMAC in a process of its own, which is given a map and a seed and spoken to over its pipes.

It first writes a line of JSON, the sizes that `get_env_info` gives. Then a byte `r` begins an episode and `s`, followed by an
int32 for each agent, steps it; `Reply` is the answer to both. A game that ended has begun anew. End of input ends the process.
"""

from __future__ import annotations

import json
import os
import struct
import sys
from typing import Any, BinaryIO, NamedTuple

import numpy as np

_HEADER = struct.Struct('<d3?')


class Sizes(NamedTuple):
    """Of a map."""

    n_agents: int     # N
    n_actions: int    # A
    obs_shape: int    # O
    state_shape: int  # S


class Reply(NamedTuple):
    """What a step did, and what the game shows next."""

    reward: float
    ended: bool
    cut_off: bool            # ended by its time limit alone
    won: bool
    final_state: np.ndarray  # [S] float32, of a game that ended
    observations: np.ndarray  # [N, O] float32
    state: np.ndarray        # [S] float32
    available: np.ndarray    # [N, A] bool

    def to_bytes(self) -> bytes:
        arrays = (self.final_state, self.observations, self.state)
        return b''.join([_HEADER.pack(*self[:4]), *(np.ascontiguousarray(array, '<f4').tobytes() for array in arrays),
                         np.ascontiguousarray(self.available, bool).tobytes()])

    @classmethod
    def size(cls, sizes: Sizes) -> int:
        """Bytes of a reply."""
        N, A, O, S = sizes
        return _HEADER.size + 4 * (2 * S + N * O) + N * A

    @classmethod
    def from_bytes(cls, data: bytes, sizes: Sizes) -> Reply:
        N, A, O, S = sizes
        numbers = np.frombuffer(data, '<f4', 2 * S + N * O, _HEADER.size)
        final_state, observations, state = np.split(numbers, [S, S + N * O])
        available = np.frombuffer(data, bool, N * A, _HEADER.size + numbers.nbytes)
        return cls(*_HEADER.unpack_from(data), final_state, observations.reshape(N, O), state, available.reshape(N, A))


def play(environment: Any, commands: BinaryIO, replies: BinaryIO) -> None:
    """Answers commands until there are no more."""
    info = environment.get_env_info()
    sizes = Sizes(*(int(info[name]) for name in Sizes._fields))
    replies.write(json.dumps(sizes._asdict()).encode() + b'\n')
    replies.flush()
    nothing = np.zeros(sizes.state_shape, np.float32)
    while command := commands.read(1):
        reward, ended, told, final_state = 0.0, True, {}, nothing
        if command == b's':
            actions = np.frombuffer(commands.read(4 * sizes.n_agents), '<i4')
            reward, ended, told = environment.step(actions.tolist())
            final_state = np.asarray(environment.get_state(), np.float32) if ended else nothing
        if ended:
            environment.reset()
        reply = Reply(float(reward), bool(ended) and command == b's', bool(told.get('episode_limit')),
                      bool(told.get('battle_won')), final_state,
                      *(np.asarray(shown(), np.float32) for shown in (environment.get_obs, environment.get_state)),
                      np.asarray(environment.get_avail_actions()) > 0)
        replies.write(reply.to_bytes())
        replies.flush()


def main() -> None:
    """The process."""
    name, seed = sys.argv[1:]
    replies = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what the game prints must not mix with what it says
    from smac.env import StarCraft2Env

    environment = StarCraft2Env(map_name=name, seed=int(seed))
    try:
        play(environment, sys.stdin.buffer, replies)
    finally:
        environment.close()
