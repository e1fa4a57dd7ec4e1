"""make bench ARGS=bags: whether a recorder keeps up and what it costs, how fast bags are read, what is learnt from them.

Recording: a graph of five robots and 128 worlds, by turns with a recorder and without, as little learnt as possible, so that
messages come as fast as they can. Every message that the requests in the bag ask for is looked for in it by its stamp.
Reading: bags of 200,000 steps, in processor time of one thread. Learning: from the same bags, with `train_reward`'s settings.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, Iterator

from benchmarks.machine import ROOT
from dae_ros import config
from dae_ros.config import RewardTrainingSettings, Settings
from dae_ros.learning.learner import Learner
from dae_ros.replay.bag import Bag
from dae_ros.replay.cdr import MESSAGE_TYPES
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.played import write_rollouts
from dae_ros.replay.reward_training import RewardTraining
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.types import RolloutRequest
from dae_ros.worlds import make_worlds

SCHEMAS = ROOT / 'msg_schemas' / 'msg'
STEPS = 200_000  # environment steps of the bags that are read and learnt from
TICKS = 10_000   # steps of all worlds that are recorded
RECORDED = {'task': 'navigation', 'num_agents': 5, 'num_worlds': 128, 'num_steps': 25, 'beta': 0.0, 'epochs': 1,
            'evaluation_episodes': 0}
LEARNT = {'matrix_game': {'task': 'matrix_game', 'num_agents': 16, 'num_steps': 16, 'reward_network.learning_rate': 0.003},
          'navigation': {'task': 'navigation', 'reward_network.learning_rate': 0.001}}
NETWORK = {'reward_network.architecture': 'shared_trunk', 'reward_network.recurrent': False}  # neither reward is delayed
BATCH_CHUNKS = {'matrix_game': 64, 'navigation': 16}
MAX_EPOCHS = 20  # some minutes of one core


def played(settings: Settings, steps: int) -> Iterator[tuple[RolloutRequest, Any]]:
    """Rollouts of a team that has learnt nothing."""
    worlds = make_worlds(settings.task)
    learner = Learner(worlds.spec, settings.learner, settings.reward_network, settings.run.seed)
    collector, num_steps = InProcessCollector(worlds), settings.run.num_steps
    for rollout in range(-(-steps // (worlds.num_worlds * num_steps))):
        request = RolloutRequest(1, rollout, 0, 0, settings.run.seed, num_steps, False)
        yield request, collector.collect(request, learner.policy)
    learner.close()
    worlds.close()


def reading(bag: Path, repeats: int) -> float:
    """Environment steps read and joined in a second of processor time, the median."""
    speeds = []
    for _ in range(repeats):
        dataset, began = Dataset(bag), time.process_time()
        for _ in dataset:
            pass
        speeds.append(dataset.environment_steps / (time.process_time() - began))
    return statistics.median(speeds)


def learning(bag: Path, settings: Settings, batch_chunks: int, max_epochs: int) -> dict[str, float]:
    """Squared errors on episodes that were held out: the mean reward's, the network's, and how many times smaller it is."""
    own = RewardTrainingSettings(max_epochs=max_epochs, batch_chunks=batch_chunks)
    training = RewardTraining(Dataset(bag), settings, own)
    errors = [epoch.held_out_error for epoch in training.run()]
    best = min(errors)
    training.close()
    baseline = training.baseline.held_out_error
    return {'mean_reward_error': baseline, 'held_out_error': best, 'times_better': baseline / best,
            'passes': len(errors)}


def lost(bag: Path, settings: Settings) -> tuple[int, int]:
    """How many messages a bag holds of the rollouts of a whole run, and how many of them it lacks, counted by their stamps."""
    T, found = settings.run.num_steps, Counter()
    rollouts = settings.run.total_steps // (settings.task.num_worlds * T)
    for message in Bag(bag, Counter()).messages():
        datum = MESSAGE_TYPES[message.type].decode(message.data)
        where = (datum.rollout, 0) if isinstance(datum, RolloutRequest) else (datum.stamp.rollout, datum.stamp.step)
        found[(message.topic, *where)] += 1
    wanted = {(f'/{topic}', rollout, step) for rollout in range(rollouts)
              for topic, steps in (('rollout_request', 1), ('joint_state', T + 1), ('shared_reward', T),
                                   *((f'robot_{robot}/action', T) for robot in range(settings.task.num_agents)))
              for step in range(steps)}
    return len(wanted & set(found)), len(wanted - set(found))


def recording(rounds: int) -> dict[str, Any]:
    """Steps per second of the graph with and without a recorder, by turns; needs ROS."""
    from benchmarks.graph import run_graph, timing
    from dae_ros.ros.graph import node_environment

    os.environ.update(node_environment())
    settings = config.from_flat(RECORDED)
    updates = -(-TICKS // settings.run.num_steps)
    settings = config.from_flat({'total_steps': updates * settings.task.num_worlds * settings.run.num_steps}, settings)
    speeds: dict[str, list[float]] = {'without': [], 'with': []}
    messages, missing = [], []
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(rounds):
            for name in speeds:
                bag = Path(scratch, f'bag{turn}') if name == 'with' else None
                run_graph(settings, Path(scratch, f'{name}{turn}'), updates, bag)
                speeds[name].append(timing(Path(scratch, f'{name}{turn}'))['steps_per_second'])
            counts = lost(bag, settings)
            messages.append(counts[0])
            missing.append(counts[1])
    slower = [1 - with_it / without for with_it, without in zip(speeds['with'], speeds['without'])]
    return {'ticks': updates * settings.run.num_steps, 'messages': messages, 'missing': missing, 'steps_per_second': speeds,
            'slower': statistics.median(slower)}


def measure(rounds: int) -> dict[str, Any]:
    """All of it."""
    result: dict[str, Any] = {'reading': {}, 'learning': {}}
    with tempfile.TemporaryDirectory() as scratch:
        for name, changes in LEARNT.items():
            settings, bag = config.from_flat({**NETWORK, **changes}), Path(scratch, name)
            write_rollouts(bag, played(settings, STEPS), SCHEMAS)
            result['reading'][name] = reading(bag, rounds)
            print(f'  {name}: {result["reading"][name]:,.0f} environment steps read and joined a second', flush=True)
            result['learning'][name] = found = learning(bag, settings, BATCH_CHUNKS[name], MAX_EPOCHS)
            print(f'  {name}: held-out error {found["held_out_error"]:.3g}, {found["times_better"]:.1f} times smaller than the '
                  f"mean reward's {found['mean_reward_error']:.3g}", flush=True)
    result['recording'] = found = recording(rounds)
    print(f'  recorder: {found["ticks"]:,} ticks in each of {rounds} runs, {sum(found["messages"]):,} messages recorded, '
          f'{sum(found["missing"]):,} missing; the run is {100 * found["slower"]:.1f} % slower', flush=True)
    return result
