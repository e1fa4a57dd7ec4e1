"""python -m benchmarks.phases [name:=value ...]: what a training in one process spends its time on, rollout by rollout.

Wall-clock milliseconds, medians over the rollouts; the networks' gradients run side by side on several threads, so theirs
are processor milliseconds. Settings are given as for bringup; the defaults are the paper's navigation with three robots.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any, Callable
from unittest.mock import patch

import dae_ros_nodes  # noqa: F401  sets the threads of the numerical libraries, as for the nodes

from dae_ros import config, settings_yaml
from dae_ros.config import Settings
from dae_ros.learning import networks
from dae_ros.learning.learner import Learner
from dae_ros.learning.parallel import Workers
from dae_ros.learning.policy import Policy
from dae_ros.rollout import lockstep
from dae_ros.rollout.assembler import Assembler
from dae_ros.rollout.in_process import InProcessCollector, train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds

ROLLOUTS = 8
PHASES = ('collect', 'simulate', 'infer', 'join', 'learn', 'advantages', 'actor', 'critic', 'reward network', 'publish')


def timed(owner: Any, name: str, phase: Callable[..., str], spent: dict[str, float], clock: Callable[[], float]):
    """A patch of `owner.name` that adds the time of every call to `spent[phase(*arguments)]`."""
    function = getattr(owner, name)

    def measured(*arguments, **keywords):
        began = clock()
        try:
            return function(*arguments, **keywords)
        finally:
            spent[phase(*arguments)] += clock() - began

    return patch.object(owner, name, measured)


def network_name(network: networks.Network, *_: Any) -> str:
    if isinstance(network, networks.RewardNetwork):
        return 'reward network'
    return 'critic' if network.head.out_features == 1 else 'actor'


def measure(settings: Settings, rollouts: int = ROLLOUTS) -> dict[str, float]:
    """Milliseconds per rollout of each phase, and `steps_per_second` of all together."""
    steps = settings.task.num_worlds * settings.run.num_steps
    settings = config.from_flat({'total_steps': (rollouts + 1) * steps, 'evaluation_episodes': 0}, settings)
    worlds = make_worlds(settings.task)
    spent: dict[str, float] = defaultdict(float)
    rows: list[dict[str, float]] = []
    began = time.perf_counter()

    def end_of_rollout() -> None:
        nonlocal began
        spent['advantages'] = spent['learn'] - spent.pop('epochs', 0.0)
        rows.append({**spent, 'rollout': time.perf_counter() - began})
        spent.clear()
        began = time.perf_counter()

    wall = {'collect': [(InProcessCollector, 'collect')], 'simulate': [(type(worlds), 'reset'), (type(worlds), 'step')],
            'infer': [(Policy, 'act'), (lockstep, 'choose')],
            'join': [(Assembler, name) for name in ('begin', 'on_joint_state', 'on_action', 'on_reward', 'trajectory')],
            'learn': [(Learner, 'update')], 'epochs': [(Workers, 'run')]}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as patches:
        for phase, places in wall.items():
            for owner, name in places:
                patches.enter_context(timed(owner, name, lambda *_, phase=phase: phase, spent, time.perf_counter))
        patches.enter_context(timed(networks.Network, 'gradient', network_name, spent, time.thread_time))
        training = Training(settings, worlds.spec, RunFolder(Path(folder) / 'run', settings))
        train(training, worlds, end_of_rollout)
        training.close()
    worlds.close()
    rows = rows[1:]  # the first rollout warms up
    result = {phase: 1e3 * median(row.get(phase, 0.0) for row in rows) for phase in PHASES}
    rollout = median(row['rollout'] for row in rows)
    result['publish'] = 1e3 * rollout - result['collect'] - result['learn']
    return result | {'steps_per_second': steps / rollout}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('settings', nargs='*', metavar='name:=value')
    parser.add_argument('--rollouts', type=int, default=ROLLOUTS)
    options = parser.parse_args()
    settings = config.from_flat(dict(map(settings_yaml.parse_override, options.settings)))
    for phase, figure in measure(settings, options.rollouts).items():
        print(f'{phase:18}{figure:12,.1f}')


if __name__ == '__main__':
    main()
