"""JaxMARL's simple_spread with random actions; arguments: worlds, robots, steps of an episode. A unit is one episode.

Episodes end together, so worlds are reset once per episode: with the environment's own `step`, which draws a new episode
for every world in every step and mostly throws it away, JaxMARL would be several times slower.
"""

from __future__ import annotations

import sys

import jax
import jaxmarl
from clock import Clock

num_worlds, num_agents, num_steps = map(int, sys.argv[1:])
clock = Clock(num_worlds * num_steps, 'jaxmarl', 'jax', 'jaxlib')
environment = jaxmarl.make('MPE_simple_spread_v3', num_agents=num_agents, num_landmarks=num_agents, max_steps=num_steps)


@jax.jit
def episode(key, actions):
    """Observations, rewards and ends of an episode, as a rollout keeps them."""
    def step(state, now):
        keys, joint_action = now
        observations, state, rewards, ends, _ = jax.vmap(environment.step_env)(keys, state, joint_action)
        return state, (observations, rewards, ends)

    first, *others = jax.random.split(key, num_steps + 1)
    observations, state = jax.vmap(environment.reset)(jax.random.split(first, num_worlds))
    keys = jax.vmap(lambda key: jax.random.split(key, num_worlds))(jax.numpy.stack(others))
    return observations, jax.lax.scan(step, state, (keys, actions))[1]


key, drawn = jax.random.split(jax.random.PRNGKey(0))
actions = {name: jax.random.randint(jax.random.fold_in(drawn, robot), (num_steps, num_worlds), 0,
                                    environment.action_space(name).n) for robot, name in enumerate(environment.agents)}
while True:
    key, now = jax.random.split(key)
    jax.block_until_ready(episode(now, actions))
    clock.tick()
