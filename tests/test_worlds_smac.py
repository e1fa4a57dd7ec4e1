"""SMAC's worlds against a small game with the same interface, in processes of their own."""

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds import make_worlds

GAME = '''
import sys

class StarCraft2Env:
    """Two units and a timer; unit 1 falls at step 2, and the battle is won by attacking (action 3) twice."""

    def __init__(self, map_name, seed):
        assert map_name == 'duel'
        self._seed = seed

    def get_env_info(self):
        return {'n_agents': 2, 'n_actions': 4, 'obs_shape': 3, 'state_shape': 5, 'episode_limit': 6}

    def reset(self):
        self._step = self._hits = 0

    def _alive(self, unit):
        return unit == 0 or self._step < 2

    def get_obs(self):
        return [[self._step, unit, self._hits] if self._alive(unit) else [0, 0, 0] for unit in range(2)]

    def get_state(self):
        return [self._step, self._hits, self._seed % 7, 8, 9]

    def get_avail_actions(self):
        return [[0, 1, 1, 1] if self._alive(unit) else [1, 0, 0, 0] for unit in range(2)]

    def step(self, actions):
        print('StarCraft II talks on standard output')
        for unit, action in enumerate(actions):
            assert self.get_avail_actions()[unit][action], (unit, action)
        if actions[0] == 2 and self._step == 3:
            sys.exit(7)
        self._step += 1
        self._hits += actions[0] == 3
        won, limit = self._hits == 2, self._step == 6
        info = {'battle_won': True} if won else {'episode_limit': True} if limit else {}
        return float(actions[0]), won or limit, info

    def close(self):
        pass
'''


@pytest.fixture
def smac(tmp_path, monkeypatch):
    """Makes worlds of the small game."""
    package = tmp_path / 'smac'
    package.mkdir()
    (package / '__init__.py').touch()
    (package / 'env.py').write_text(GAME)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    monkeypatch.syspath_prepend(str(tmp_path))
    made = []

    def make(num_worlds=2, num_agents=2, task='smac:duel', **settings):
        made.append(make_worlds(TaskSettings(task=task, num_agents=num_agents, num_worlds=num_worlds, **settings)))
        return made[-1]

    yield make
    for worlds in made:
        worlds.close()


def actions_of(shown, first):
    """Unit 0 takes these actions, unit 1 what it may."""
    return np.stack([first, np.where(shown.present[:, 1], 1, 0)], 1)


def test_battles_are_played_as_smac_plays_them_and_begin_anew_where_they_end(smac):
    worlds = smac()
    assert worlds.spec == WorldSpec(2, 4, 3, 5, state_is_observations=False, has_wins=True)
    shown = worlds.reset(1, 0)
    assert shown.episode_start.all() and shown.present.all() and not shown.available[..., 0].any()
    for step in range(1, 7):
        transition = worlds.step(actions_of(shown, np.array([1, 3 if step in (1, 3) else 1])))
        shown = transition.next
        assert transition.reward.tolist() == [1.0, 3.0 if step in (1, 3) else 1.0]
        assert transition.terminated.tolist() == transition.won.tolist() == [False, step == 3]
        assert transition.truncated.tolist() == [step == 6, False]
        assert (shown.episode_start == (transition.terminated | transition.truncated)).all()
        steps = np.array([step % 6, step % 3 if step <= 3 else step - 3])
        np.testing.assert_array_equal(shown.state[:, 0], steps)
        np.testing.assert_array_equal(shown.present[:, 1], steps < 2)
        assert shown.available[~shown.present].tolist() == [[True, False, False, False]] * int((~shown.present).sum())
        assert transition.final_states[:, 0].tolist() == ([6.0] if step == 6 else [])


def test_a_reset_begins_all_battles_anew(smac):
    worlds = smac()
    shown = worlds.reset(1, 0)
    worlds.step(actions_of(shown, np.array([1, 1])))
    assert (worlds.reset(1, 1).state[:, 0] == 0).all()


def test_a_game_that_dies_is_told_in_one_sentence_and_no_process_is_left(smac):
    worlds = smac()
    shown = worlds.reset(1, 0)
    games = [game._process for game in worlds._games]
    with pytest.raises(WorldError, match='game 1 of duel ended unexpectedly, with exit code 7'):
        for _ in range(4):
            shown = worlds.step(actions_of(shown, np.array([1, 2]))).next
    worlds.close()
    assert [game.poll() for game in games] == [0, 7]


@pytest.mark.parametrize('settings, complaint', [({'num_agents': 3}, 'smac:duel has 2 units; set num_agents to 2'),
                                                 ({'reward_delay': 1}, 'reward_delay'), ({'episode_steps': 5}, 'episode_steps')])
def test_settings_that_do_not_fit_are_told(smac, settings, complaint):
    with pytest.raises(SettingsError, match=complaint):
        smac(**settings)


def test_a_map_that_the_game_does_not_take_is_an_error(smac):
    with pytest.raises(WorldError, match='game 0 of nowhere ended unexpectedly'):
        smac(task='smac:nowhere')


def test_without_smac_one_sentence_says_what_to_install():
    with pytest.raises(WorldError, match='needs SMAC, .* and StarCraft II'):
        make_worlds(TaskSettings(task='smac:2s3z', num_agents=5))
