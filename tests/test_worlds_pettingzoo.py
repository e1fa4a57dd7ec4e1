"""PettingZoo environments as worlds: one from mpe2, one from butterfly, and tiny ones with every oddity."""

import random
import sys
from types import ModuleType

import numpy as np
import pytest
from gymnasium import spaces
from mpe2 import simple_spread_v3
from pettingzoo import ParallelEnv

from dae_ros import draws
from dae_ros.config import TaskSettings
from dae_ros.errors import SettingsError, WorldError
from dae_ros.types import WorldSpec
from dae_ros.worlds import make_worlds, world_spec


class TinyTeam(ParallelEnv):
    """Two agents; both observe noise of the global generators. Subclasses and arguments bend it."""

    metadata = {'name': 'tiny_team'}
    lengths = (2, 3)                                  # of the observations
    actions = (spaces.Discrete(3), spaces.Discrete(3))
    ends = {'terminations': (4, 4), 'truncations': (9, 9)}  # step after which each agent ends

    def __init__(self):
        self.possible_agents = ['left', 'right']
        self.taken = []

    def observation_space(self, agent):
        return spaces.Box(-1.0, 1.0, (self.lengths[self.possible_agents.index(agent)],))

    def action_space(self, agent):
        return self.actions[self.possible_agents.index(agent)]

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents[:]
        self.steps = 0
        return self._observe(), {agent: {} for agent in self.agents}

    def _observe(self):
        return {agent: np.full(length, np.random.random() + random.random(), dtype=np.float32)
                for agent, length in zip(self.possible_agents, self.lengths)}

    def step(self, actions):
        self.steps += 1
        self.taken.append(actions)
        ended = {name: dict(zip(self.possible_agents, (self.steps >= step for step in steps)))
                 for name, steps in self.ends.items()}
        rewards = {'left': 1.0, 'right': 2.0}
        observations = self._observe()
        here, self.agents = self.agents, [agent for agent in self.agents if not any(ends[agent] for ends in ended.values())]
        told = [{agent: numbers[agent] for agent in here} for numbers in (observations, rewards, *ended.values())]
        return *told, {}


@pytest.fixture
def tiny(monkeypatch):
    """Makes worlds of a TinyTeam with other class attributes."""

    def make(num_worlds=2, num_agents=2, **attributes):
        team = type('Team', (TinyTeam,), attributes)
        module = ModuleType('tiny_team')
        module.parallel_env = team
        monkeypatch.setitem(sys.modules, 'tiny_team', module)
        return make_worlds(TaskSettings(task='pettingzoo:tiny_team', num_agents=num_agents, num_worlds=num_worlds))

    return make


def spread(num_worlds=3, num_agents=3, **settings):
    return make_worlds(TaskSettings(task='pettingzoo:mpe2.simple_spread_v3', num_agents=num_agents,
                                    num_worlds=num_worlds, **settings))


def no_actions(worlds):
    return np.zeros((worlds.num_worlds, worlds.spec.num_agents), dtype=np.int64)


def test_an_environment_of_mpe2_runs_as_it_does_by_itself():
    worlds = spread(num_agents=4, episode_steps=5)
    assert worlds.spec == WorldSpec(4, 5, 24, 96, state_is_observations=False)
    environment = simple_spread_v3.parallel_env(N=4, max_cycles=5)
    joint = worlds.reset(seed=7, rollout=2)
    seen, _ = environment.reset(seed=draws.key(7, 'reset', 2, 0, 1) % 2**31)
    assert joint.episode_start.all()
    for step, actions in enumerate(np.random.default_rng(0).integers(5, size=(12, 3, 4)), start=1):
        np.testing.assert_array_equal(joint.observations[1], list(seen.values()))
        np.testing.assert_array_equal(joint.state[1], environment.state())
        transition = worlds.step(actions)
        seen, rewards, *_ = environment.step(dict(zip(environment.possible_agents, actions[1])))
        assert transition.reward[1] == pytest.approx(np.mean(list(rewards.values())))
        ended = step % 5 == 0
        assert (transition.truncated == ended).all() and not transition.terminated.any()
        assert (transition.next.episode_start == ended).all()
        assert transition.final_states.shape == ((3 if ended else 0), 96)
        if ended:
            np.testing.assert_array_equal(transition.final_states[1], environment.state())
            seen, _ = environment.reset(seed=draws.key(7, 'reset', 2, step, 1) % 2**31)
        joint = transition.next
    worlds.close()


def test_a_world_of_mpe2_does_not_depend_on_how_many_others_there_are():
    few, many = spread(num_worlds=1), spread(num_worlds=3)
    np.testing.assert_array_equal(few.reset(1, 0).state[0], many.reset(1, 0).state[0])


def test_the_spec_of_an_environment_is_that_of_its_worlds():
    assert world_spec(TaskSettings(task='pettingzoo:mpe2.simple_spread_v3')) == spread().spec


def test_an_environment_of_butterfly_with_images_plugs_in():
    worlds = make_worlds(TaskSettings(task='pettingzoo:pettingzoo.butterfly.cooperative_pong_v6', num_agents=2,
                                      num_worlds=1))
    joint = worlds.reset(seed=1, rollout=0)
    assert joint.observations.shape == (1, 2, worlds.spec.observation_size)
    assert joint.state.shape == (1, worlds.spec.state_size)
    assert worlds.step(np.array([[1, 2]])).reward > 0.0
    worlds.close()


def test_short_observations_are_padded_and_make_the_state_where_there_is_none(tiny):
    worlds = tiny()
    assert worlds.spec == WorldSpec(2, 3, 3, 6, state_is_observations=True)
    joint = worlds.reset(seed=1, rollout=0)
    assert joint.observations[:, 0, :2].all() and joint.observations[:, 1].all()
    assert not joint.observations[:, 0, 2].any()
    np.testing.assert_array_equal(joint.state, joint.observations.reshape(2, 6))


def test_observations_that_are_no_vectors_are_flattened(tiny):
    worlds = tiny(observation_space=lambda self, agent: spaces.Discrete(4),
                  _observe=lambda self: {'left': 1, 'right': 3})
    np.testing.assert_array_equal(worlds.reset(1, 0).observations[0], np.eye(4)[[1, 3]])


def test_actions_that_do_not_begin_at_zero_are_shifted(tiny):
    worlds = tiny(num_worlds=1, actions=(spaces.Discrete(3, start=5), spaces.Discrete(3)))
    worlds.reset(1, 0)
    worlds.step(np.array([[2, 1]], dtype=np.uint16))
    assert worlds._environments[0].taken == [{'left': 7, 'right': 1}]


def test_the_reward_is_the_mean_and_the_end_for_all_terminates(tiny):
    worlds = tiny()
    worlds.reset(1, 0)
    for step in range(1, 9):
        transition = worlds.step(no_actions(worlds))
        assert (transition.reward == 1.5).all()
        assert (transition.terminated == (step % 4 == 0)).all()
        assert (transition.next.episode_start == transition.terminated).all()
        assert not transition.truncated.any() and transition.final_states.shape == (0, 6)


def test_an_end_that_terminates_only_some_counts_as_cut_off(tiny):
    worlds = tiny(ends={'terminations': (4, 9), 'truncations': (4, 4)})
    worlds.reset(1, 0)
    for _ in range(4):
        transition = worlds.step(no_actions(worlds))
    assert transition.truncated.all() and not transition.terminated.any()
    assert transition.final_states.shape == (2, 6)
    assert not np.array_equal(transition.final_states, transition.next.state)


def test_global_generators_neither_disturb_the_worlds_nor_are_disturbed(tiny):
    worlds = tiny()

    def rollout(seed, disturb):
        states = [worlds.reset(seed, rollout=3).state]
        for _ in range(6):
            if disturb:
                np.random.random(), random.random()
            states.append(worlds.step(no_actions(worlds)).next.state)
        return np.array(states)

    np.random.seed(0), random.seed(0)
    expected = np.random.random(), random.random()
    np.random.seed(0), random.seed(0)
    first = rollout(1, disturb=False)
    assert (np.random.random(), random.random()) == expected
    np.testing.assert_array_equal(rollout(1, disturb=True), first)
    assert not np.array_equal(rollout(2, disturb=False), first)


@pytest.mark.parametrize('attributes, error, complaint', [
    ({'num_agents': 3}, SettingsError, 'tiny_team has 2 agents; set num_agents to 2'),
    ({'actions': (spaces.Box(-1, 1), spaces.Box(-1, 1))}, WorldError, 'actions that are not discrete'),
    ({'actions': (spaces.Discrete(3), spaces.Discrete(4))}, WorldError, r'different numbers of actions \(\[3, 4\]\)'),
    ({'observation_space': lambda self, agent: spaces.Dict({'action_mask': spaces.MultiBinary(3)})},
     WorldError, 'shows its agents nothing'),
    ({'observation_space': lambda self, agent: spaces.Sequence(spaces.Discrete(2))}, WorldError, 'cannot be flattened'),
])
def test_an_environment_that_does_not_fit_is_refused_in_one_sentence(tiny, attributes, error, complaint):
    with pytest.raises(error, match=complaint) as caught:
        tiny(**attributes)
    assert '\n' not in str(caught.value)


MASK = np.array([0, 1, 1], np.int8)


def masked_space(self, agent):
    return spaces.Dict({'action_mask': spaces.MultiBinary(3), 'observation': spaces.Box(-1.0, 1.0, (2,))})


def masked_observation(self):
    return {agent: {'action_mask': MASK, 'observation': np.full(2, 0.25, np.float32)} for agent in self.possible_agents}


def infos_with_masks(self, seed=None, options=None):
    observations, infos = TinyTeam.reset(self, seed, options)
    return observations, {agent: {'action_mask': MASK} for agent in infos}


@pytest.mark.parametrize('attributes', [{'observation_space': masked_space, '_observe': masked_observation},
                                        {'reset': infos_with_masks}], ids=['observed', 'told'])
def test_masks_of_actions_are_passed_on_and_are_no_observation(tiny, attributes):
    worlds = tiny(**attributes)
    shown = worlds.reset(1, 0)
    assert (shown.available == MASK.astype(bool)).all() and shown.available.shape == (2, 2, 3)
    assert shown.present is None
    if 'observation_space' in attributes:
        assert worlds.spec.observation_size == 2 and (shown.observations == 0.25).all()
        assert (worlds.step(no_actions(worlds) + 1).next.available == MASK.astype(bool)).all()


def test_a_mask_that_leaves_an_agent_nothing_to_do_is_an_error(tiny, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], 'MASK', np.zeros(3, np.int8))
    with pytest.raises(WorldError, match='left of pettingzoo:tiny_team has no action it may choose'):
        tiny(reset=infos_with_masks).reset(1, 0)


def test_members_that_leave_before_the_others_are_absent_until_the_last_one_ends(tiny):
    worlds = tiny(num_worlds=1, ends={'terminations': (4, 2), 'truncations': (9, 9)})
    assert worlds.reset(1, 0).present is None
    for step in range(1, 9):
        transition = worlds.step(no_actions(worlds) + 1)
        if step % 4 in (2, 3):
            assert transition.next.present.tolist() == [[True, False]]
            assert transition.next.available.tolist() == [[[True, True, True], [True, False, False]]]
            assert transition.next.observations[0, 0].any() and not transition.next.observations[0, 1].any()
        else:
            assert transition.next.present is None and transition.next.available is None
        assert transition.terminated.all() == (step % 4 == 0) and not transition.truncated.any()
        assert transition.reward.tolist() == [0.5 if step % 4 in (3, 0) else 1.5]
    taken = worlds._environments[0].taken
    assert [sorted(actions) for actions in taken] == 2 * [['left', 'right'], ['left', 'right'], ['left'], ['left']]


def own_states(team):
    """The states of a `TinyTeam`'s agents: who, and how many steps there were."""
    return {agent: {'state': np.array([number, team.steps])} for number, agent in enumerate(team.possible_agents)}


def test_states_of_each_agent_are_put_one_after_another_and_are_zeros_for_one_that_has_left(tiny):
    def with_states(act):
        return lambda team, *arguments, **named: (*act(team, *arguments, **named)[:-1], own_states(team))

    worlds = tiny(num_worlds=1, ends={'terminations': (1, 3), 'truncations': (9, 9)}, reset=with_states(TinyTeam.reset),
                  step=with_states(TinyTeam.step))
    assert (worlds.spec.state_size, worlds.spec.states_per_agent, worlds.spec.num_values) == (4, True, 2)
    assert worlds.reset(1, 0).state.tolist() == [[0, 0, 1, 0]]
    assert worlds.step(np.zeros((1, 2), np.int64)).next.state.tolist() == [[0, 0, 1, 1]]  # left has left
    assert worlds.step(np.zeros((1, 2), np.int64)).next.state.tolist() == [[0, 0, 1, 2]]
    assert worlds.step(np.zeros((1, 2), np.int64)).next.state.tolist() == [[0, 0, 1, 0]]  # all are there again


def test_states_that_only_some_agents_have_are_refused(tiny):
    def reset(team, seed=None, options=None):
        seen, _ = TinyTeam.reset(team)
        return seen, {'left': {'state': [1.0]}}

    with pytest.raises(WorldError, match='do not all have states of the same size'):
        tiny(reset=reset)


def test_an_end_of_the_last_agents_that_terminates_not_all_of_them_is_cut_off(tiny):
    worlds = tiny(num_worlds=1, ends={'terminations': (9, 2), 'truncations': (3, 9)})
    worlds.reset(1, 0)
    for _ in range(3):
        transition = worlds.step(no_actions(worlds))
    assert transition.truncated.all() and transition.final_states.shape == (1, 6)
    assert transition.final_states[0, :3].any() and not transition.final_states[0, 3:].any()
    assert transition.next.present is None and transition.next.episode_start.all()


@pytest.mark.parametrize('name, complaint', [
    ('no_such_module', "cannot import 'no_such_module'"),
    ('', "cannot import ''"),
    ('json', 'json has no parallel_env'),
])
def test_a_module_that_is_no_environment_is_refused(name, complaint):
    with pytest.raises(WorldError, match=complaint):
        make_worlds(TaskSettings(task=f'pettingzoo:{name}'))


def test_an_episode_length_that_the_environment_does_not_take_is_refused(tiny):
    tiny()
    with pytest.raises(SettingsError, match='takes no max_cycles; set episode_steps to 0'):
        make_worlds(TaskSettings(task='pettingzoo:tiny_team', num_agents=2, episode_steps=7))


def test_settings_of_other_tasks_are_refused():
    with pytest.raises(SettingsError, match='observe_others'):
        spread(observe_others=True)
    with pytest.raises(SettingsError, match='reward_delay belongs to the built-in tasks; set it to 0'):
        spread(reward_delay=1)


def test_actions_are_checked_and_a_reset_comes_first(tiny):
    worlds = tiny()
    with pytest.raises(WorldError, match='reset'):
        worlds.step(no_actions(worlds))
    worlds.reset(1, 0)
    with pytest.raises(ValueError, match=r'0 \.\. 2, not 3'):
        worlds.step(no_actions(worlds) + 3)
