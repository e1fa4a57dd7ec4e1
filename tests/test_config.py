"""Settings: declared once, checked by name and range."""

import dataclasses

import pytest
from hypothesis import given, settings, strategies
from hypothesis.strategies import SearchStrategy

from dae_ros import config
from dae_ros.config import SETTINGS, SettingInfo, Settings
from dae_ros.errors import SettingsError

NODE_GROUPS = (config.RunBinding, config.AgentSettings, config.ParameterServerSettings, config.TrainerSettings,
               config.TeamKey)
DECLARATIONS = [*SETTINGS.values(), *config.declarations(*NODE_GROUPS)]
RANGED = [info for info in DECLARATIONS if info.minimum is not None]

# Reproduction facts: what is common to all experiments, and the step size and epochs of all but SMAC.
PAPER = {
    'gamma': 0.99, 'gae_lambda': 0.95, 'clip': 0.2, 'entropy_coefficient': 0.01, 'value_coefficient': 1.0,
    'huber_delta': 10.0, 'adam_epsilon': 1e-5, 'max_gradient_norm': 10.0, 'num_mini_batches': 1, 'chunk_length': 10,
    'epochs': 10, 'reward_network.epochs': 10, 'learning_rate': 7e-4, 'reward_network.learning_rate': 7e-4,
    'hidden_size': 64, 'reward_network.hidden_size': 128, 'reward_network.ensemble_size': 1, 'mlp_layers': 2,
    'activation': 'relu', 'value_target': 'difference', 'num_worlds': 128, 'num_steps': 25,
}


def by_name(declared: list[SettingInfo]):
    return pytest.mark.parametrize('info', declared, ids=lambda info: info.name)


def refusal(values: dict) -> str:
    with pytest.raises(SettingsError) as caught:
        config.from_flat(values)
    return str(caught.value)


def values_of(info: SettingInfo) -> SearchStrategy:
    """All values the setting may take."""
    if info.choices:
        return strategies.sampled_from(info.choices)
    if info.kind is bool:
        return strategies.booleans()
    if info.kind is int:
        return strategies.integers(info.minimum, info.maximum)
    if info.kind is float:
        return strategies.floats(info.minimum, info.maximum)
    return strategies.text()


def with_equal_groups(values):
    """The values with a number of worlds that can be split into the groups they say."""
    groups, worlds = values.get('world_groups', 1), values.get('num_worlds', 128)
    return values | {'num_worlds': max(groups, worlds - worlds % groups)} if groups > 1 else values


SOME_VALUES = strategies.fixed_dictionaries({}, optional={
    name: values_of(info) for name, info in SETTINGS.items()}).map(with_equal_groups)


def test_every_setting_has_a_public_name_of_its_own():
    names = [info.name for info in DECLARATIONS]
    assert len(names) == len(set(names))
    groups = [getattr(Settings(), field.name) for field in dataclasses.fields(Settings)] + list(NODE_GROUPS)
    assert len(names) == sum(len(dataclasses.fields(group)) for group in groups)


@by_name(DECLARATIONS)
def test_every_setting_is_explained_and_its_default_is_allowed(info):
    assert info.help
    assert info.help in info.describe() and info.unit in info.describe()
    assert all(choice in info.describe() for choice in info.choices)
    assert info.check(info.default) == info.default
    assert type(info.check(info.default)) is info.kind


def test_the_numbers_of_every_setting_are_bounded():
    assert {info.name for info in DECLARATIONS if info.kind in (int, float)} == {info.name for info in RANGED}


def test_the_defaults_are_those_of_the_paper():
    defaults = config.flatten(Settings())
    assert {name: defaults[name] for name in PAPER} == PAPER


def test_nothing_set_gives_the_defaults():
    assert config.from_flat({}) == Settings()


@pytest.mark.parametrize('beta', [0, 1])
def test_a_number_may_be_written_as_an_integer(beta):
    taken = config.from_flat({'beta': beta}).learner.beta
    assert taken == beta and type(taken) is float


@pytest.mark.parametrize('value', [True, '0.5', None, [0.5], {'a': 1}], ids=repr)
def test_a_number_takes_nothing_that_is_not_one_and_says_so(value):
    assert refusal({'beta': value}) == f'beta must be a number, not {value!r}'


@pytest.mark.parametrize('value', [True, 3.0, '3', None], ids=repr)
def test_an_integer_takes_nothing_that_is_not_one_and_says_so(value):
    assert refusal({'reward_network.epochs': value}) == f'reward_network.epochs must be an integer, not {value!r}'


@pytest.mark.parametrize('value', [0, 1, 'true', None], ids=repr)
def test_a_switch_takes_only_true_and_false(value):
    assert refusal({'observe_others': value}) == f'observe_others must be true or false, not {value!r}'


@pytest.mark.parametrize('value', [3, True, None], ids=repr)
def test_a_text_takes_only_text(value):
    assert refusal({'task': value}) == f'task must be a text, not {value!r}'


@pytest.mark.parametrize('value', ['ReLU', '', 'identity'])
def test_a_choice_takes_only_what_it_offers_and_names_that(value):
    assert refusal({'activation': value}) == f'activation must be one of relu, tanh, not {value!r}'


@by_name(RANGED)
def test_the_bounds_of_a_range_are_allowed_and_what_lies_beyond_is_refused_by_name(info):
    for bound in (info.minimum, info.maximum):
        assert info.check(bound) == bound
    for beyond in (info.minimum - 1, info.maximum * 2 + 1):
        with pytest.raises(SettingsError) as caught:
            info.check(beyond)
        beyond = info.kind(beyond)
        assert str(caught.value) == f'{info.name} must lie in {info.minimum} .. {info.maximum}, not {beyond!r}'


@pytest.mark.parametrize('value', [float('nan'), float('inf'), float('-inf')], ids=repr)
@by_name([info for info in RANGED if info.kind is float])
def test_a_number_that_is_not_finite_is_refused(info, value):
    with pytest.raises(SettingsError, match=f'^{info.name} must lie in .*, not {value!r}$'):
        info.check(value)


@pytest.mark.parametrize('wrong, meant', [
    ('bta', 'beta'), ('num_world', 'num_worlds'), ('reward_network.epoch', 'reward_network.epochs'),
    ('reward_network_learning_rate', 'reward_network.learning_rate'), ('value_targets', 'value_target')])
def test_an_unknown_key_is_an_error_with_the_nearest_name(wrong, meant):
    assert refusal({wrong: 1}) == f"unknown setting '{wrong}'; did you mean '{meant}'?"


@pytest.mark.parametrize('name', ['', 'xyzzy', 'learner.beta'])
def test_an_unknown_key_like_no_other_is_an_error_all_the_same(name):
    assert refusal({name: 1}).startswith(f'unknown setting {name!r}')


def test_a_setting_goes_to_the_group_it_belongs_to():
    taken = config.from_flat({'epochs': 3, 'reward_network.epochs': 4, 'learning_rate': 0.5,
                              'reward_network.hidden_size': 7})
    assert (taken.learner.epochs, taken.reward_network.epochs) == (3, 4)
    assert (taken.learner.learning_rate, taken.reward_network.learning_rate) == (0.5, 7e-4)
    assert (taken.learner.hidden_size, taken.reward_network.hidden_size) == (64, 7)


def test_what_is_not_set_stays_as_the_base_has_it():
    base = config.from_flat({'beta': 0.5, 'seed': 7, 'num_agents': 2})
    taken = config.from_flat({'beta': 0.25}, base)
    assert config.flatten(taken) == config.flatten(base) | {'beta': 0.25}
    assert base.learner.beta == 0.5


@settings(max_examples=50, deadline=None, derandomize=True)
@given(SOME_VALUES)
def test_flattened_settings_are_those_that_were_set(values):
    assert config.flatten(config.from_flat(values)) == config.flatten(Settings()) | values


@by_name([info for info in SETTINGS.values() if info.kind is not str])
def test_the_digest_tells_every_change_of_a_setting(info):
    changed = not info.default if info.kind is bool else info.maximum if info.default != info.maximum else info.minimum
    base = config.from_flat({'num_worlds': SETTINGS['world_groups'].maximum})
    assert config.digest(config.from_flat({info.name: changed}, base)) != config.digest(base)
    assert config.digest(config.from_flat({info.name: config.flatten(base)[info.name]}, base)) == config.digest(base)
