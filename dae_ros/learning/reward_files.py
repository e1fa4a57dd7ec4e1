"""Reward networks as files: what `train_reward` writes and a training may begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Iterable, NamedTuple

import numpy as np
import torch

from dae_ros import config
from dae_ros.config import RewardNetworkSettings
from dae_ros.errors import SettingsError
from dae_ros.learning.networks import RewardNetwork, make_reward_network
from dae_ros.types import WorldSpec
from dae_ros.weights.codec import decode_reward_network, encode_reward_network, read_file

LARGEST = 2**24  # size that a file may ask for


class RewardNetworks(NamedTuple):
    """The networks of a file, and what they are made for."""

    spec: WorldSpec  # of which they know no observation_size
    recurrent: bool
    members: list[RewardNetwork]


def encode(networks: Iterable[RewardNetwork], spec: WorldSpec, settings: RewardNetworkSettings) -> bytes:
    """The file; equal networks give equal bytes."""
    tensors = {f'{member}.{name}': parameter.detach().cpu().numpy() for member, network in enumerate(networks)
               for name, parameter in network.named_parameters()}
    return encode_reward_network(tensors, _schema(spec, settings))


def read(spec: WorldSpec, settings: RewardNetworkSettings) -> list[dict[str, np.ndarray]]:
    """Each network's parameters by name, from the file that `settings` names.

    SettingsError if they name none, if it cannot be read or if its networks are of another kind.
    """
    if not settings.path:
        raise SettingsError('reward_network.freeze keeps the networks of a file: name it in reward_network.path')
    path = Path(settings.path)
    tensors, found = read_file(path, decode_reward_network, 'reward_network.path', 'file of train_reward')
    asked = _schema(spec, settings)
    different = [f'{name} is {found.get(name)!r} there and {value!r} here' for name, value in asked.items()
                 if found.get(name) != value]
    if different:
        raise SettingsError(f'the reward networks in {path} do not fit this run: {", ".join(different)}; train some from bags of '
                            'this task, or change the settings')
    return _members(path, tensors, spec, settings)


def load(path: Path) -> RewardNetworks:
    """The networks in a file, whatever they are made for. SettingsError if it cannot be read or holds none."""
    tensors, found = read_file(path, decode_reward_network, 'reward_network_file', 'file of train_reward')
    members = found.pop('members', None)
    sizes = [found.pop(name, None) for name in ('num_agents', 'num_actions', 'state_size')]
    try:
        if not all(type(size) is int and 0 < size < LARGEST for size in sizes):
            raise SettingsError('sizes that no team has')
        values = {f'reward_network.{name}': value for name, value in {**found, 'ensemble_size': members}.items()}
        settings = config.from_flat(values).reward_network
    except SettingsError as error:
        raise SettingsError(f'{path} holds no reward networks that are known here: {error}') from error
    spec = WorldSpec(sizes[0], sizes[1], 0, sizes[2], False)
    networks = []
    for parameters in _members(path, tensors, spec, settings):
        network = make_reward_network(spec, settings, 0, 0)
        network.load_state_dict({name: torch.from_numpy(tensor.copy()) for name, tensor in parameters.items()})
        networks.append(network)
    return RewardNetworks(spec, settings.recurrent, networks)


def _members(path: Path, tensors: dict[str, np.ndarray], spec: WorldSpec,
             settings: RewardNetworkSettings) -> list[dict[str, np.ndarray]]:
    """Each network's parameters by name."""
    expected = {name: tuple(parameter.shape)
                for name, parameter in make_reward_network(spec, settings, 0, 0).named_parameters()}
    members = [{name: tensors.get(f'{member}.{name}', np.empty(0)) for name in expected}
               for member in range(settings.ensemble_size)]
    if any(tensor.shape != expected[name] for member in members for name, tensor in member.items()):
        raise SettingsError(f'{path} lacks tensors of the networks it says it holds: train it anew')
    return members


def _schema(spec: WorldSpec, settings: RewardNetworkSettings) -> dict[str, Any]:
    """All that the parameters depend on, as JSON values."""
    trunk = {'trunk_size': settings.trunk_size} if settings.architecture == 'shared_trunk' else {}
    return {'num_agents': spec.num_agents, 'num_actions': spec.num_actions, 'state_size': spec.state_size,
            'members': settings.ensemble_size, 'architecture': settings.architecture, 'hidden_size': settings.hidden_size,
            'recurrent': settings.recurrent, **trunk}
