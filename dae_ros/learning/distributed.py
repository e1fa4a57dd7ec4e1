"""The learner on several processes, started by torchrun: the leader's gradient steps, computed by all of them.

Rank 0 leads: it collects the rollouts and holds the state that counts. For every update it sends the rollout and its state
to the others, so they keep nothing that could be lost. Each rank then computes its share of every gradient step's shards
and the gradients are added up; they equal the single learner's to rounding.
"""

from __future__ import annotations

import json

import numpy as np
import torch
import torch.distributed
from safetensors.numpy import load, save
from torch import Tensor

from dae_ros import config, torchrun
from dae_ros.config import Settings
from dae_ros.errors import DaeRosError
from dae_ros.learning.device import chosen_device
from dae_ros.learning.estimators import ExpectedRewards
from dae_ros.learning.learner import Learner
from dae_ros.types import Trajectory, WorldSpec


class Team:
    """The processes that learn together, as torchrun's environment variables describe them."""

    def __init__(self):
        torch.distributed.init_process_group('gloo')
        self.rank = torch.distributed.get_rank()
        self.size = torch.distributed.get_world_size()

    def add_up(self, vector: Tensor) -> None:
        """Replaces `vector` by its sum over all ranks."""
        torch.distributed.all_reduce(vector)

    def send(self, arrays: dict[str, np.ndarray]) -> None:
        """The leader's arrays, for `receive` of all others. Never pickled."""
        data = torch.from_numpy(np.frombuffer(save(arrays), np.uint8).copy())
        torch.distributed.broadcast(torch.tensor([len(data)]), 0)
        torch.distributed.broadcast(data, 0)

    def receive(self) -> dict[str, np.ndarray]:
        """What the leader sent."""
        size = torch.zeros(1, dtype=torch.int64)
        torch.distributed.broadcast(size, 0)
        data = torch.empty(int(size), dtype=torch.uint8)
        torch.distributed.broadcast(data, 0)
        return load(data.numpy().tobytes())

    def leave(self) -> None:
        """Ends this process's part."""
        torch.distributed.destroy_process_group()


class LeadingLearner(Learner):
    """The learner of rank 0."""

    def __init__(self, spec: WorldSpec, settings: Settings, team: Team):
        super().__init__(spec, settings.learner, settings.reward_network, settings.run.seed, team,
                         chosen_device(spec, settings))
        self._team = team
        team.send({'settings': np.frombuffer(json.dumps(config.flatten(settings)).encode(), np.uint8),
                   'spec': np.array(spec, np.int64)})

    def update(self, trajectory: Trajectory, rollout: int) -> dict[str, float]:
        parts = {f'trajectory.{name}': np.ascontiguousarray(part) for name, part in trajectory._asdict().items()
                 if part is not None}
        self._team.send({'rollout': np.array(rollout)} | parts | {f'state.{n}': part for n, part in self.state().items()})
        return super().update(trajectory, rollout)

    def close(self) -> None:
        self._team.send({})
        self._team.leave()
        super().close()


def make_learner(spec: WorldSpec, settings: Settings, exact_rewards: ExpectedRewards | None = None) -> Learner:
    """The learner of this process, which leads a team if torchrun started several; only a learner alone takes exact rewards."""
    if torchrun.size() > 1:
        return LeadingLearner(spec, settings, Team())
    return Learner(spec, settings.learner, settings.reward_network, settings.run.seed, device=chosen_device(spec, settings),
                   exact_rewards=exact_rewards)


def help_to_learn() -> None:
    """What every process but the leader does, until the leader is done. Raises DaeRosError if it is lost."""
    team = Team()
    try:
        first = team.receive()
        settings = config.from_flat(json.loads(first['settings'].tobytes()))
        numbers = first['spec'].tolist()
        spec = WorldSpec(*numbers[:4], *map(bool, numbers[4:]))
        learner = Learner(spec, settings.learner, settings.reward_network, settings.run.seed, team,
                          chosen_device(spec, settings))
        while arrays := team.receive():
            learner.load_state(_named(arrays, 'state.'))
            learner.update(Trajectory(**_named(arrays, 'trajectory.')), int(arrays['rollout']))
        learner.close()
    except RuntimeError as error:  # what torch raises when a connection breaks
        raise DaeRosError(f'lost the leading learner: {str(error).splitlines()[0]}') from error
    finally:
        team.leave()  # the connection's threads must end before the interpreter: met at its end, they abort the process


def _named(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
