"""Writes rollouts that were played in one process into a bag, without ROS: the messages a recorder would have heard."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Iterable, Iterator

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dae_ros.replay.recording import Recording, Topic
from dae_ros.types import RolloutRequest, Trajectory

STEP_TIME = 10**6  # ns from message to message; a bag of the same rollouts is the same bag
_NONE = QosTime(0, 0)
_QOS = Qos(QosHistory.KEEP_LAST, 1024, QosReliability.RELIABLE, QosDurability.VOLATILE, _NONE, _NONE,
           QosLiveliness.SYSTEM_DEFAULT, _NONE, False)


def write_rollouts(path: Path, played: Iterable[tuple[RolloutRequest, Trajectory]], schemas: Path) -> None:
    """Writes the rollouts into a new bag. `schemas`: the folder of the message definitions. BagError if it cannot be written."""
    store = _typestore(schemas)
    recording: Recording | None = None
    time = 0
    for request, trajectory in played:
        if recording is None:
            kinds = {'rollout_request': 'RolloutRequest', 'joint_state': 'JointState', 'shared_reward': 'SharedReward',
                     **{f'robot_{robot}/action': 'Action' for robot in range(trajectory.actions.shape[2])}}
            recording = Recording(path, [_topic(store, name, kind) for name, kind in kinds.items()])
        for name, kind, fields in _messages(store, request, trajectory):
            time += STEP_TIME
            kind = f'dae_ros_msgs/msg/{kind}'
            recording.write(f'/{name}', time, bytes(store.serialize_cdr(store.types[kind](**fields), kind)))
    if recording is not None:
        recording.close()


@functools.lru_cache
def _typestore(schemas: Path):
    store = get_typestore(Stores.EMPTY)
    for path in sorted(schemas.glob('*.msg')):
        store.register(get_types_from_msg(path.read_text(encoding='utf-8'), f'dae_ros_msgs/msg/{path.stem}'))
    return store


def _topic(store, name: str, kind: str) -> Topic:
    kind = f'dae_ros_msgs/msg/{kind}'
    return Topic(f'/{name}', kind, store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind), _QOS)


def _messages(store, request: RolloutRequest, trajectory: Trajectory) -> Iterator[tuple[str, str, dict]]:
    """Topic, type and fields of each message of a rollout, in the order they are sent."""
    T, W, N, O = trajectory.observations.shape
    S, A = trajectory.states.shape[2], trajectory.probabilities.shape[3]
    finals = np.split(trajectory.final_states, np.cumsum(trajectory.truncated.sum(1))[:-1])
    # Nobody acts on what is seen after the last action, and a trajectory leaves it out.
    observations = np.concatenate([trajectory.observations, trajectory.observations[-1:]])

    def flags(values: np.ndarray | None, step: int) -> np.ndarray:
        """An optional field; of what comes after the last action nothing is known."""
        return np.empty(0, np.uint8) if values is None or step == T else values[step].astype(np.uint8).ravel()

    yield 'rollout_request', 'RolloutRequest', request._asdict()
    for step in range(T + 1):
        stamp = store.types['dae_ros_msgs/msg/Stamp'](request.run, request.rollout, request.attempt, step)
        yield 'joint_state', 'JointState', {
            'stamp': stamp, 'num_worlds': W, 'num_agents': N, 'observation_size': O, 'state_size': S,
            'num_actions': 0 if trajectory.available is None else A, 'observations': observations[step].ravel(),
            'episode_start': trajectory.episode_start[step].astype(np.uint8), 'state': trajectory.states[step].ravel(),
            'available': flags(trajectory.available, step), 'present': flags(trajectory.present, step)}
        if step == T:
            return
        for robot in range(N):
            yield f'robot_{robot}/action', 'Action', {
                'stamp': stamp, 'robot': robot, 'policy_version': request.policy_version, 'num_worlds': W, 'num_actions': A,
                'actions': trajectory.actions[step, :, robot].astype(np.uint16),
                'probabilities': trajectory.probabilities[step, :, robot].ravel()}
        yield 'shared_reward', 'SharedReward', {
            'stamp': stamp, 'num_worlds': W, 'state_size': S, 'reward': trajectory.rewards[step],
            'terminated': trajectory.terminated[step].astype(np.uint8),
            'truncated': trajectory.truncated[step].astype(np.uint8), 'final_states': finals[step].ravel(),
            'won': flags(trajectory.won, step)}
