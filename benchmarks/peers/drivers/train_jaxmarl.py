"""JaxMARL's MAPPO-RNN script, run as it is; arguments: its path and settings, NAME=value.

The script compiles its whole training into one program, which reports every update to Weights & Biases. A stand-in for
that package, which does nothing but tick, makes each report the end of a unit.
"""

from __future__ import annotations

import runpy
import sys
from types import ModuleType

from clock import Clock

script, *settings = sys.argv[1:]
values = dict(setting.split('=', 1) for setting in settings)
clock = Clock(int(values['NUM_ENVS']) * int(values['NUM_STEPS']), 'jaxmarl', 'jax', 'jaxlib', 'flax', 'optax', 'distrax')
stand_in = ModuleType('wandb')
stand_in.init = lambda **_: None
stand_in.log = lambda _: clock.tick()
sys.modules['wandb'] = stand_in
sys.argv[:] = [script, *settings, 'hydra.run.dir=hydra']
runpy.run_path(script, run_name='__main__')
