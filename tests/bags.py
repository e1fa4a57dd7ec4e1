"""Writes bags of teams that play in this process, with rosbags' own serialiser, so that ours is not tested against itself."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dae_ros import config
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import Action, JointState, RolloutRequest, SharedReward
from dae_ros.worlds import make_worlds

SCHEMAS = Path(__file__).parents[1] / 'msg_schemas' / 'msg'
RUN = 7


def unchanged(text):
    return text


@functools.lru_cache
def typestore(change=unchanged):
    """Our message types as they stand in msg_schemas, each definition passed through `change`."""
    store = get_typestore(Stores.EMPTY)
    for path in sorted(SCHEMAS.glob('*.msg')):
        store.register(get_types_from_msg(change(path.read_text()), f'dae_ros_msgs/msg/{path.stem}'))
    return store


class Team:
    """A team with a random policy, whose data are written down as they come."""

    def __init__(self, policy_seed: int = 0, **values):
        self.settings = config.from_flat({'num_worlds': 4, 'num_steps': 5, **values})
        self._worlds = make_worlds(self.settings.task)
        self.spec = self._worlds.spec
        sizes = PolicyArchitecture(self.spec.observation_size, self.spec.num_actions, 8, 1, 'relu')
        draw = np.random.default_rng(policy_seed)
        self._policy = Policy(sizes, {name: draw.normal(size=shape).astype(np.float32) * 0.5
                                      for name, shape in sizes.shapes().items()})
        self._data: list = []

    def play(self, rollout: int, attempt: int = 0, run: int = RUN):
        """The trajectory of one rollout and all data it consists of, in the order a recorder would hear them."""
        request = RolloutRequest(run, rollout, attempt, 0, self.settings.run.seed, self.settings.run.num_steps, False)
        collector, data = InProcessCollector(self._worlds), [request]
        (assembler,) = collector._assembler.groups
        for name in ('on_joint_state', 'on_action', 'on_reward'):
            setattr(assembler, name, self._noting(data, getattr(assembler, name)))
        return collector.collect(request, self._policy), data

    @staticmethod
    def _noting(data, take):
        def noted(datum):
            data.append(datum)
            take(datum)

        return noted


def write_bag(path: Path, data, *, storage='mcap', compression='none', namespace='', group='', store=None, omit_state=True):
    """Writes data into a bag, in their order."""
    store = store or typestore()
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for time, datum in enumerate(data):
            topic, name, message = as_message(store, datum, omit_state)
            topic = f'{namespace}/{topic}' if isinstance(datum, RolloutRequest) else f'{namespace}{group}/{topic}'
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], 10**18 + time, store.serialize_cdr(message, name))
    return path


def as_message(store, datum, omit_state):
    """Topic, type and message of a datum."""
    def make(kind, **fields):
        return f'dae_ros_msgs/msg/{kind}', store.get_msgdef(f'dae_ros_msgs/msg/{kind}').cls(**fields)

    if isinstance(datum, RolloutRequest):
        return 'rollout_request', *make('RolloutRequest', **datum._asdict())
    stamp = make('Stamp', **datum.stamp._asdict())[1]
    if isinstance(datum, JointState):
        W, N, O = datum.observations.shape
        state = datum.state[:0] if omit_state and datum.state.shape[1] == N * O else datum.state
        return 'joint_state', *make(
            'JointState', stamp=stamp, num_worlds=W, num_agents=N, observation_size=O, state_size=datum.state.shape[1],
            num_actions=0 if datum.available is None else datum.available.shape[2],
            episode_start=datum.episode_start.astype(np.uint8), observations=datum.observations.ravel(), state=state.ravel(),
            available=flags(datum.available), present=flags(datum.present))
    if isinstance(datum, Action):
        return f'robot_{datum.robot}/action', *make(
            'Action', stamp=stamp, robot=datum.robot, policy_version=datum.policy_version, num_worlds=len(datum.actions),
            num_actions=datum.probabilities.shape[1], actions=datum.actions.astype(np.uint16),
            probabilities=datum.probabilities.ravel())
    assert isinstance(datum, SharedReward)
    return 'shared_reward', *make(
        'SharedReward', stamp=stamp, num_worlds=len(datum.reward), state_size=datum.final_states.shape[1], reward=datum.reward,
        terminated=datum.terminated.astype(np.uint8), truncated=datum.truncated.astype(np.uint8),
        final_states=datum.final_states.ravel(), won=flags(datum.won))


def flags(values):
    """An optional field of flags."""
    return np.empty(0, np.uint8) if values is None else values.astype(np.uint8).ravel()
