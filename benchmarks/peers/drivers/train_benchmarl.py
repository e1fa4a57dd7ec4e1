"""BenchMARL's MAPPO with a GRU in actor and critic on VMAS's simple_spread; arguments: worlds, steps, epochs, width.

Threads are torch's default, with which it is faster than with one; compiling the GRU changed nothing and takes a minute.
"""

from __future__ import annotations

import sys

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import GruConfig, MlpConfig, SequenceModelConfig
from clock import Clock

num_worlds, num_steps, epochs, hidden_size = map(int, sys.argv[1:])
clock = Clock(num_worlds * num_steps, 'benchmarl', 'torchrl', 'tensordict', 'vmas', 'torch')


class Tick(Callback):
    """Ends a unit with each update; all robots are one group."""

    def on_train_end(self, training_td, group: str) -> None:
        clock.tick()


def model() -> SequenceModelConfig:
    """A hidden layer, the GRU, another hidden layer: the layers of JaxMARL's networks, and as many as ours have."""
    layers = {'layer_class': torch.nn.Linear, 'activation_class': torch.nn.ReLU}
    gru = GruConfig(hidden_size=hidden_size, n_layers=1, bias=True, dropout=0.0, compile=False, mlp_num_cells=[hidden_size],
                    **{f'mlp_{name}': value for name, value in layers.items()})
    return SequenceModelConfig([MlpConfig(num_cells=[], **layers), gru], intermediate_sizes=[hidden_size])


experiment = ExperimentConfig.get_from_yaml()
experiment.prefer_continuous_actions = False
experiment.on_policy_n_envs_per_worker = num_worlds
experiment.on_policy_collected_frames_per_batch = num_worlds * num_steps
experiment.on_policy_minibatch_size = num_worlds * num_steps
experiment.on_policy_n_minibatch_iters = epochs
experiment.max_n_frames = 10**12
experiment.evaluation = experiment.render = experiment.create_json = False
experiment.loggers = []
task = VmasTask.SIMPLE_SPREAD.get_from_yaml()
task.config['max_steps'] = num_steps
Experiment(task, MappoConfig.get_from_yaml(), model(), seed=1, config=experiment, critic_model_config=model(),
           callbacks=[Tick()]).run()
