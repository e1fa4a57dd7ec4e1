"""SMAX's battles: as JaxMARL plays them by itself, with masks, fallen units and victories."""

from pathlib import Path

import numpy as np
import pytest

from dae_ros import config, draws, settings_yaml
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import make_worlds
from dae_ros.worlds.smax import OWN_MAPS

MAPS = Path(__file__).parents[1] / 'config' / 'smac'
W = 3


@pytest.mark.parametrize('path', sorted(MAPS.glob('*.yaml')), ids=lambda path: path.stem)
def test_the_maps_of_the_paper_have_their_settings(path):
    settings = config.from_flat(settings_yaml.load(path))
    assert settings.task.task.split(':')[1] == path.stem
    assert (settings.task.num_worlds, settings.run.num_steps, settings.learner.learning_rate) == (8, 400, 5e-4)
    epochs = {1_000_000: 15, 5_000_000: 10, 10_000_000: 5}[settings.run.total_steps]
    assert settings.learner.epochs == settings.reward_network.epochs == epochs
    assert settings.run.evaluation_episodes == 32


def test_all_maps_of_the_paper_are_there():
    assert {path.stem for path in MAPS.glob('*.yaml')} == {'2s3z', '1c3s5z', 'MMM', '3s5z', '3s_vs_5z', '5m_vs_6m',
                                                           '3s5z_vs_3s6z', 'MMM2', 'corridor'}


@pytest.fixture(scope='module')
def jaxmarl():
    """JaxMARL's module of SMAX."""
    try:
        worlds('2s3z', 5)
    except WorldError as error:
        pytest.skip(str(error))
    import jaxmarl.environments.smax

    return jaxmarl.environments.smax


def worlds(name, num_agents, num_worlds=W, **settings):
    return make_worlds(TaskSettings(task=f'smax:{name}', num_agents=num_agents, num_worlds=num_worlds, **settings))


def random_actions(shown, step):
    return (draws.generator(3, 'test', step).random(shown.available.shape) * shown.available).argmax(-1)


@pytest.mark.slow  # JAX compiles for half a minute
def test_battles_are_those_that_jaxmarl_plays_by_itself(jaxmarl):
    import jax

    ours = worlds('2s3z', 5, episode_steps=25)
    alone = jaxmarl.HeuristicEnemySMAX(scenario=jaxmarl.map_name_to_scenario('2s3z'), max_steps=25)
    reset, play = jax.jit(alone.reset), jax.jit(alone.step_env)
    shown, states = ours.reset(5, 2), [None] * W
    seen = {'fallen': 0, 'terminated': 0, 'truncated': 0, 'won': 0}

    def check(world, observed, state):
        np.testing.assert_allclose(shown.observations[world], [observed[agent] for agent in alone.agents], atol=1e-5)
        np.testing.assert_allclose(shown.state[world], observed['world_state'], atol=1e-5)
        alive = np.asarray(state.state.unit_alive[:5])
        np.testing.assert_array_equal(shown.present[world], alive)
        offered = alone.get_avail_actions(state)
        for unit, agent in enumerate(alone.agents):
            expected = np.asarray(offered[agent]) > 0 if alive[unit] else np.arange(10) == 0
            np.testing.assert_array_equal(shown.available[world, unit], expected)
        seen['fallen'] += 5 - alive.sum()

    for step in range(70):
        keys = draws.generator(5, 'smax', 2, step).integers(2**32, size=(W, 2, 2), dtype=np.uint32)
        if step:
            before, actions = shown, random_actions(shown, step)
            transition = ours.step(actions)
            shown = transition.next
        for world in range(W):
            begins = not step
            if step:
                chosen = {agent: action if before.present[world, unit] else 4
                          for unit, (agent, action) in enumerate(zip(alone.agents, actions[world]))}
                observed, states[world], rewards, ended, _ = play(keys[world, 0], states[world], chosen)
                assert transition.reward[world] == pytest.approx(10 * float(rewards['ally_0']), abs=1e-4)
                alive = np.asarray(states[world].state.unit_alive)
                won, lost = not alive[5:].any(), not alive[:5].any()
                begins = bool(ended['__all__'])
                found = transition.terminated[world], transition.truncated[world], transition.won[world]
                assert found == (begins and (won or lost), begins and not won and not lost, won and not lost)
                for name, flag in zip(('terminated', 'truncated', 'won'), found):
                    seen[name] += flag
                if transition.truncated[world]:
                    final = transition.final_states[transition.truncated[:world].sum()]
                    np.testing.assert_allclose(final, observed['world_state'], atol=1e-5)
            if begins:
                observed, states[world] = reset(keys[world, 1])
            assert shown.episode_start[world] == begins
            check(world, observed, states[world])
    assert seen['fallen'] and seen['truncated']


@pytest.mark.slow  # JAX compiles for half a minute
def test_a_rollout_is_the_same_again_and_a_training_tells_how_often_it_won(jaxmarl, tmp_path):
    settings = config.from_flat({'task': 'smax:5m_vs_6m', 'num_agents': 5, 'num_worlds': 2, 'num_steps': 30, 'beta': 0.6,
                                 'total_steps': 120, 'epochs': 1, 'reward_network.epochs': 1, 'evaluation_episodes': 0})
    battles = make_worlds(settings.task)
    training = Training(settings, battles.spec, RunFolder(tmp_path, settings))
    collector = InProcessCollector(battles)
    request = training.request()
    first, again = (collector.collect(request._replace(attempt=attempt), training.policy) for attempt in (0, 1))
    for one, other in zip(first, again):
        assert np.array_equal(one, other)
    assert not first.probabilities[~first.available].any()
    training.consume(again)
    training.close()
    assert 'win_rate' in (tmp_path / 'metrics.csv').read_text().splitlines()[0]


@pytest.mark.parametrize('name', OWN_MAPS)
def test_maps_that_jaxmarl_lacks_have_their_units(jaxmarl, name):
    allies, enemies = OWN_MAPS[name]
    spec = worlds(name, len(allies), 1).spec
    assert (spec.num_agents, spec.num_actions) == (len(allies), 5 + len(enemies))


@pytest.mark.parametrize('name, num_agents, complaint', [
    ('2s3z', 4, 'smax:2s3z has 5 units; set num_agents to 5'), ('nowhere', 5, "no map 'nowhere'"), ('1c3s5z', 9, 'colossus')])
def test_what_does_not_fit_is_told(jaxmarl, name, num_agents, complaint):
    with pytest.raises(SettingsError, match=complaint):
        worlds(name, num_agents)
