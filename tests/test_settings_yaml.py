"""Settings as people write them: what files and overrides say, the same again when written, and what is wrong with them."""

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings

from dae_ros import config, settings_yaml
from dae_ros.errors import SettingsError
from tests.test_config import SOME_VALUES, refusal

REPOSITORY = Path(__file__).parent.parent
TASK_FILES = sorted((REPOSITORY / 'config').glob('*.yaml'))


def read_text(text: str | bytes) -> dict:
    """What `load` makes of a file with this content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'task.yaml'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return settings_yaml.load(path)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(SOME_VALUES)
def test_settings_come_back_from_yaml_as_they_were(values):
    written = config.from_flat(values)
    assert config.from_flat(read_text(settings_yaml.dump(written))) == written


def test_there_is_a_task_file_for_every_task_of_the_paper():
    assert {'navigation.yaml', 'formation.yaml', 'line.yaml', 'matrix_game.yaml'} <= {path.name for path in TASK_FILES}


@pytest.mark.parametrize('path', TASK_FILES, ids=lambda path: path.name)
def test_every_task_file_loads_and_sets_what_it_says(path):
    values = settings_yaml.load(path)
    of_robots = {name: values.pop(name) for name in list(values) if name in config.ROBOT_SETTINGS}
    flattened = config.flatten(config.from_flat(values))
    assert values and {name: flattened[name] for name in values} == values
    assert {name: config.ROBOT_SETTINGS[name].check(value) for name, value in of_robots.items()} == of_robots


def test_a_task_file_may_nest_a_group_or_write_its_names_with_dots():
    nested = '/**:\n  ros__parameters:\n    beta: 1\n    reward_network:\n      epochs: 3\n'
    dotted = '/**:\n  ros__parameters:\n    beta: 1\n    reward_network.epochs: 3\n'
    assert read_text(nested) == read_text(dotted) == {'beta': 1, 'reward_network.epochs': 3}


def under_parameters(text: str) -> str:
    return f'/**:\n  ros__parameters:\n    {text}\n'


MALFORMED = {
    'empty': '',
    'a comment': '# nothing\n',
    'a number': '5',
    'a list': '- beta: 1',
    'no parameter file': 'beta: 1',
    'of one node': 'trainer:\n  ros__parameters:\n    beta: 1',
    'two nodes': under_parameters('beta: 1') + 'trainer:\n  ros__parameters:\n    beta: 1\n',
    'no parameters': '/**:',
    'parameters that are a number': '/**: 3',
    'parameters under another key': '/**:\n  parameters:\n    beta: 1',
    'parameters that are a list': '/**:\n  ros__parameters: [beta, 1]',
    'two keys under the node': under_parameters('beta: 1') + '  more: 1\n',
    'an open bracket': under_parameters('beta: [1'),
    'a tabulator': '/**:\n\tros__parameters:\n\t\tbeta: 1\n',
    'an object of a language': under_parameters('beta: !!python/object/apply:os.getcwd []'),
    'an unknown anchor': under_parameters('beta: *nowhere'),
    'a key that is a list': under_parameters('? [a, b]\n    : 1'),
    'not UTF-8': b'/**:\n  ros__parameters:\n    task: \xff\xfe\n',
    'a control character': '/**:\n  ros__parameters:\n    task: "\x00"\n',
    'a day that is not in the calendar': under_parameters('seed: 2024-13-45'),
    'a number that is none': under_parameters('beta: !!float abc'),
    'a truth that is none': under_parameters('observe_others: !!bool perhaps'),
    'an integer of no digits': under_parameters('seed: !!int ""'),
    'brackets without end': '[' * 1000,
    'parameters that hold themselves': '/**:\n  ros__parameters: &all\n    more: *all\n',
}


@pytest.mark.parametrize('content', MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_task_file_is_answered_with_one_sentence_that_names_it(content, tmp_path):
    path = tmp_path / 'task.yaml'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SettingsError) as caught:
        settings_yaml.load(path)
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


def test_a_task_file_that_cannot_be_read_is_answered_with_one_sentence(tmp_path):
    for path in (tmp_path / 'missing.yaml', tmp_path):
        with pytest.raises(SettingsError, match=f'^cannot read the task file {path}: '):
            settings_yaml.load(path)


@pytest.mark.parametrize('content, sentence', [
    ('bta: 1', "unknown setting 'bta'; did you mean 'beta'?"),
    ('reward_network: 5', "unknown setting 'reward_network'"),
    ('beta: {epochs: 3}', "unknown setting 'beta.epochs'"),
    ('reward_network: {beta: 1}', "unknown setting 'reward_network.beta'"),
    ('7: 1', "unknown setting '7'"),
    ('beta: "1"', "beta must be a number, not '1'"),
    ('num_agents: 2.0', 'num_agents must be an integer, not 2.0')])
def test_a_wrong_entry_of_a_task_file_is_an_error_that_names_it(content, sentence):
    assert refusal(read_text(under_parameters(content))).startswith(sentence)


@pytest.mark.parametrize('text, override', [
    ('beta:=1', ('beta', 1)), ('beta:=0.5', ('beta', 0.5)), ('observe_others:=true', ('observe_others', True)),
    ('task:=pettingzoo:mpe2.simple_spread_v3', ('task', 'pettingzoo:mpe2.simple_spread_v3'))])
def test_an_override_is_a_name_and_a_value_read_as_yaml(text, override):
    assert settings_yaml.parse_override(text) == override


@pytest.mark.parametrize('text, number', [
    ('7e-4', 7e-4), ('1e-05', 1e-5), ('1E2', 100.0), ('-2.5e1', -25.0), ('+1.e+3', 1000.0), ('.5', 0.5)])
def test_a_number_may_be_written_with_an_exponent_as_in_any_parameter_file(text, number):
    assert read_text(under_parameters(f'learning_rate: {text}')) == {'learning_rate': number}
    assert settings_yaml.parse_override(f'learning_rate:={text}') == ('learning_rate', number)


@pytest.mark.parametrize('value', ['[', '{a', '*nowhere', '"', '!!float x', '2024-13-45'])
def test_an_override_whose_value_is_no_yaml_is_an_error_that_shows_it(value):
    with pytest.raises(SettingsError) as caught:
        settings_yaml.parse_override(f'beta:={value}')
    assert value in str(caught.value) and '\n' not in str(caught.value)


@pytest.mark.parametrize('text', ['', 'beta', 'beta=1', ':=1', 'beta:1'])
def test_an_override_of_another_form_is_an_error_that_shows_the_form(text):
    with pytest.raises(SettingsError, match='^expected name:=value, not '):
        settings_yaml.parse_override(text)
