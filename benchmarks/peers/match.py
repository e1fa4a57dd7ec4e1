"""What is compared with what: the contenders side by side, and the ratios that matter."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Mapping, NamedTuple

from benchmarks.peers.contender import Contender

NUM_AGENTS, NUM_WORLDS, NUM_STEPS, EPOCHS, HIDDEN = 3, 128, 25, 10, 64
MANY_WORLDS = 4096
TRAINING = {'task': 'navigation', 'num_agents': NUM_AGENTS, 'num_worlds': NUM_WORLDS, 'num_steps': NUM_STEPS, 'epochs': EPOCHS,
            'num_mini_batches': 1, 'hidden_size': HIDDEN}
MAPPO, DAE, DAE_SHARED = 'dae_ros MAPPO', 'dae_ros DAE', 'dae_ros DAE, shared trunk'
JAXMARL_MAPPO, BENCHMARL_MAPPO = 'JaxMARL MAPPO-RNN', 'BenchMARL MAPPO-GRU'
SCRIPT = 'baselines/MAPPO/mappo_rnn_mpe.py'


class Comparison(NamedTuple):
    """A ratio of speeds: ours over the fastest of `others`; `target` is what it should at least be, None where nothing is."""

    ours: str
    others: tuple[str, ...]
    target: float | None


class Match(NamedTuple):
    """Contenders that take turns."""

    title: str
    contenders: tuple[Contender, ...]
    comparisons: tuple[Comparison, ...]


def training(checkout: Path | None) -> Match:
    """Rollouts and learning together. `checkout`: JaxMARL's repository, whose script is no part of its package."""
    contenders = [_ours(MAPPO, {'beta': 0.0}), _ours(DAE, {'beta': 0.95, 'reward_network.architecture': 'per_agent'}),
                  _ours(DAE_SHARED, {'beta': 0.95, 'reward_network.architecture': 'shared_trunk'}),
                  Contender(BENCHMARL_MAPPO, 'benchmarl', 'train_benchmarl.py', _words(NUM_WORLDS, NUM_STEPS, EPOCHS, HIDDEN))]
    if checkout:
        settings = {'ENV_NAME': 'MPE_simple_spread_v3', 'NUM_ENVS': NUM_WORLDS, 'NUM_STEPS': NUM_STEPS, 'UPDATE_EPOCHS': EPOCHS,
                    'NUM_MINIBATCHES': 1, 'FC_DIM_SIZE': HIDDEN, 'GRU_HIDDEN_DIM': HIDDEN, 'TOTAL_TIMESTEPS': 2 * 10**9}
        contenders.append(Contender(JAXMARL_MAPPO, 'jaxmarl', 'train_jaxmarl.py',
                                    (str(checkout / SCRIPT), *(f'{name}={value}' for name, value in settings.items()))))
    # No peer has a reward network: ours with one are compared with theirs without.
    targets = {MAPPO: 2.0, DAE: 1.0, DAE_SHARED: 1.5}
    return Match(f'Rollouts and learning, {NUM_WORLDS} worlds', tuple(contenders), (
        *(Comparison(ours, (JAXMARL_MAPPO,), target) for ours, target in targets.items()),
        *(Comparison(ours, (BENCHMARL_MAPPO,), None) for ours in targets)))


def simulation(num_worlds: int) -> Match:
    """Simulators alone, random actions. mpe2 has one world at a time and takes part where the fewest are."""
    sizes = _words(num_worlds, NUM_AGENTS, NUM_STEPS)
    contenders = [Contender('dae_ros', '', 'worlds_ours.py', sizes), Contender('VMAS', 'benchmarl', 'worlds_vmas.py', sizes),
                  Contender('JaxMARL', 'jaxmarl', 'worlds_jaxmarl.py', sizes)]
    comparisons = [Comparison('dae_ros', ('VMAS', 'JaxMARL'), 1.0)]
    if num_worlds < MANY_WORLDS:
        contenders.append(Contender('mpe2, one world', 'mpe2', 'worlds_mpe2.py', _words(NUM_AGENTS, NUM_STEPS)))
        comparisons.append(Comparison('dae_ros', ('mpe2, one world',), None))
    return Match(f'Simulation alone, {num_worlds:,} worlds', tuple(contenders), tuple(comparisons))


def _ours(name: str, settings: Mapping[str, Any]) -> Contender:
    return Contender(name, '', 'train_ours.py', tuple(f'{key}:={value}' for key, value in {**TRAINING, **settings}.items()))


def _words(*numbers: int) -> tuple[str, ...]:
    return tuple(map(str, numbers))
