"""Reward networks learn from bags, the same from the same bags, and far better than the mean reward predicts."""

import json
import random

import numpy as np
import pytest
from dae_ros_nodes import train_reward

from dae_ros import config, settings_yaml
from dae_ros.config import RewardTrainingSettings
from dae_ros.credit_probe import AlternativesRecorder, recorded_expected_rewards
from dae_ros.errors import BagError, Refused, SettingsError
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.reward_training import RewardTraining
from dae_ros.report.metrics import read_metrics
from dae_ros.rollout.in_process import InProcessCollector, train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.weights.codec import decode_policy, decode_reward_network
from dae_ros.worlds import make_worlds
from tests.bags import Team, write_bag

GAME = {'task': 'matrix_game', 'num_agents': 3, 'num_steps': 9, 'num_worlds': 32}
QUICK = {'reward_network.hidden_size': 32, 'reward_network.learning_rate': 3e-3}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """8,640 steps of a team that draws its actions."""
    team = Team(**GAME)
    return write_bag(tmp_path_factory.mktemp('bags') / 'bag', [datum for rollout in range(30) for datum in team.play(rollout)[1]])


def trained(*bags, values=QUICK, **own):
    training = RewardTraining(Dataset(*bags), config.from_flat(values), RewardTrainingSettings(**own))
    epochs = list(training.run())
    file, held_out = training.file(), training.held_out()
    training.close()
    return training.baseline, epochs, file, held_out


def test_on_the_matrix_game_it_beats_the_mean_reward_by_ten_times(bag):
    baseline, epochs, file, held_out = trained(bag, max_epochs=12)
    best = min(epoch.held_out_error for epoch in epochs)
    assert baseline.held_out_error > 0.1 and baseline.held_out_error / best > 10
    assert 0.05 < baseline.held_out_episodes / baseline.episodes < 0.15
    # What is written are the best epoch's networks, and the report shows their predictions.
    assert np.square(held_out.predicted - held_out.rewards[:, None]).mean() == pytest.approx(best, rel=1e-4)
    assert held_out.credit.shape == (3, 3)


@pytest.mark.parametrize('values', [
    {'reward_network.architecture': 'shared_trunk'}, {'reward_network.recurrent': False}, {'reward_network.ensemble_size': 2},
    {'chunk_length': 4}])
def test_every_form_of_the_network_learns(values, bag):
    baseline, epochs, file, _ = trained(bag, values={**QUICK, **values}, max_epochs=4)
    assert epochs[-1].held_out_error < 0.8 * baseline.held_out_error
    tensors, schema = decode_reward_network(file)
    settings = config.from_flat({**QUICK, **values}).reward_network
    assert schema['architecture'] == settings.architecture and schema['members'] == settings.ensemble_size
    assert (schema['num_agents'], schema['num_actions'], schema['state_size']) == (3, 3, 3)
    assert {name.split('.')[0] for name in tensors} == {str(member) for member in range(settings.ensemble_size)}


def test_the_same_bags_give_the_same_file_and_another_seed_another(bag):
    one, again, other = (trained(bag, values={**QUICK, **values}, max_epochs=2, pool_chunks=300)[2]
                         for values in ({'learner_threads': 1}, {'learner_threads': 2}, {'seed': 2}))
    assert one == again and one != other


def test_bags_may_be_split_as_they_like(bag, tmp_path):
    team = Team(**GAME)
    data = [datum for rollout in range(30) for datum in team.play(rollout)[1]]
    write_bag(tmp_path / 'bag_0', data[:1000], storage='sqlite3')
    write_bag(tmp_path / 'bag_1', data[1000:], compression='storage')
    assert trained(bag, max_epochs=1)[1:3] == trained(tmp_path / 'bag_*', max_epochs=1)[1:3]


def test_it_ends_when_the_held_out_error_no_longer_falls(tmp_path):
    """Rewards that are noise: there is nothing to learn but their mean."""
    team, draw = Team(**GAME), np.random.default_rng(1)

    def noise(datum):
        return datum._replace(reward=draw.normal(size=32).astype(np.float32)) if hasattr(datum, 'reward') else datum

    write_bag(tmp_path / 'bag', [noise(datum) for rollout in range(6) for datum in team.play(rollout)[1]])
    _, epochs, _, held_out = trained(tmp_path / 'bag', max_epochs=60, patience=2)
    assert len(epochs) < 60 and [epoch.best for epoch in epochs[-2:]] == [False, False]
    best = min(epoch.held_out_error for epoch in epochs)
    assert np.square(held_out.predicted - held_out.rewards[:, None]).mean() == pytest.approx(best, rel=1e-4)


def test_too_few_episodes_are_refused(tmp_path):
    team = Team(task='matrix_game', num_agents=3, num_steps=3, num_worlds=1)
    with pytest.raises(BagError, match='1 episodes are too few'):
        trained(write_bag(tmp_path / 'bag', team.play(0)[1]))


def test_a_reward_network_is_no_policy_and_a_damaged_one_is_refused(bag):
    file = trained(bag, max_epochs=1)[2]
    with pytest.raises(Refused, match='dae_ros.reward_network/1'):
        decode_policy(file)
    draw = random.Random(1)
    for _ in range(100):
        spoilt = bytearray(file[:draw.randrange(1, len(file))])
        with pytest.raises(Refused):
            decode_reward_network(bytes(spoilt))


# A training that begins with such a file.

LIVE = {**GAME, **QUICK, 'num_worlds': 8, 'hidden_size': 16, 'epochs': 2, 'total_steps': 3 * 72, 'evaluation_episodes': 0}


def run_live(folder, **values):
    """Every update's metrics, and all of the reward network at the end."""
    settings = config.from_flat({**LIVE, **values})
    worlds = make_worlds(settings.task)
    training = Training(settings, worlds.spec, RunFolder(folder, settings))
    train(training, worlds, lambda: None)
    training.close()
    state = {name: tensor.copy() for name, tensor in training._learner.state().items() if 'reward_network' in name}
    return read_metrics(folder / 'metrics.csv'), state


@pytest.fixture(scope='module')
def file(bag, tmp_path_factory):
    path = tmp_path_factory.mktemp('networks') / 'reward.safetensors'
    path.write_bytes(trained(bag, max_epochs=8)[2])
    return path


def test_a_training_may_begin_with_the_networks_of_a_file_or_keep_them(file, tmp_path):
    before = {f'reward_network.{name.replace(".", ".parameters.", 1)}': tensor
              for name, tensor in decode_reward_network(file.read_bytes())[0].items()}
    cold, _ = run_live(tmp_path / 'cold')
    warm, learnt = run_live(tmp_path / 'warm', **{'reward_network.path': str(file)})
    frozen, kept = run_live(tmp_path / 'frozen', **{'reward_network.path': str(file), 'reward_network.freeze': True})
    explained = 'reward_network/explained_variance'
    assert warm[explained][0] == frozen[explained][0] > 0.7 > cold[explained][0]
    assert all(np.array_equal(kept[name], tensor) for name, tensor in before.items())
    assert not all(np.array_equal(learnt[name], tensor) for name, tensor in before.items())
    assert 'reward_network/loss' in warm and 'reward_network/loss' not in frozen


def test_a_resumed_run_needs_its_file_no_more(file, tmp_path):
    own = tmp_path / 'reward.safetensors'
    own.write_bytes(file.read_bytes())
    values = {'reward_network.path': str(own), 'checkpoint_interval': 1}
    _, expected = run_live(tmp_path / 'run', **values)
    for checkpoint in sorted((tmp_path / 'run/checkpoints').iterdir())[1:]:
        checkpoint.unlink()
    own.unlink()
    _, resumed = run_live(tmp_path / 'run', **values)
    assert all(np.array_equal(expected[name], tensor) for name, tensor in resumed.items())


@pytest.mark.parametrize('values, complaint', [
    ({'num_agents': 4}, 'num_agents is 3 there and 4 here, num_actions is 3 there and 4 here, state_size is 3'),
    ({'reward_network.hidden_size': 64}, 'do not fit this run: hidden_size is 32 there and 64 here; train some from bags'),
    ({'reward_network.ensemble_size': 2}, 'members is 1 there and 2 here'),
    ({'reward_network.recurrent': False}, 'recurrent is True there and False here'),
    ({'reward_network.architecture': 'shared_trunk'}, "architecture is 'per_agent' there and 'shared_trunk' here"),
    ({'beta': 0.0}, 'reward_network.path needs the reward network that estimator = dae has at beta above 0'),
    ({'estimator': 'coma'}, 'reward_network.path needs the reward network'),
])
def test_networks_that_do_not_fit_are_refused_in_one_sentence(values, complaint, file, tmp_path):
    with pytest.raises(SettingsError) as caught:
        run_live(tmp_path / 'run', **{'reward_network.path': str(file), **values})
    assert complaint in str(caught.value) and '\n' not in str(caught.value)


def test_a_file_that_is_missing_or_something_else_is_refused(bag, tmp_path):
    with pytest.raises(SettingsError, match='cannot read reward_network.path .*: No such file'):
        run_live(tmp_path / 'run', **{'reward_network.path': str(tmp_path / 'missing')})
    (tmp_path / 'other').write_bytes(b'something else')
    with pytest.raises(SettingsError, match='is no file of train_reward'):
        run_live(tmp_path / 'run2', **{'reward_network.path': str(tmp_path / 'other')})
    with pytest.raises(SettingsError, match='name it in reward_network.path'):
        run_live(tmp_path / 'run3', **{'reward_network.freeze': True})


# The command.

def test_the_command_writes_the_network_and_a_report(bag, tmp_path, capsys):
    output = tmp_path / 'out' / 'reward.safetensors'
    assert train_reward.main(['--bag', str(bag), '--output', str(output), '-p', 'reward_network.hidden_size:=16', '-p',
                              'max_epochs:=2', '-p', 'held_out:=0.2']) == 0
    assert '8,640 environment steps, 2,880 episodes' in capsys.readouterr().out
    report = json.loads((tmp_path / 'out/reward/report.json').read_text())
    assert report['rollouts'] == 30 and report['skipped'] == {} and len(report['epochs']) == 2
    assert report['settings']['reward_network.hidden_size'] == 16
    assert (tmp_path / 'out/reward/report.png').read_bytes().startswith(b'\x89PNG')
    assert decode_reward_network(output.read_bytes())[1]['hidden_size'] == 16


@pytest.mark.parametrize('values', [GAME, {'task': 'navigation', 'num_worlds': 4, 'num_steps': 25}], ids=['game', 'navigation'])
def test_where_the_task_is_known_the_report_tells_the_error_of_the_expected_reward(values, tmp_path, capsys):
    team, seen = Team(**values), []
    for rollout in range(8):
        seen += team.play(rollout)[1]
    bag = write_bag(tmp_path / 'bag', seen)
    (tmp_path / 'task.yaml').write_text(settings_yaml.dump(team.settings))
    command = ['--bag', str(bag), '--output', str(tmp_path / 'reward.safetensors'), '-p', 'reward_network.hidden_size:=16',
               '-p', 'max_epochs:=2', '-p', 'held_out:=0.2', '--task', str(tmp_path / 'task.yaml')]
    assert train_reward.main(command) == 0
    assert 'of its variance and' in capsys.readouterr().out
    report = json.loads((tmp_path / 'reward/report.json').read_text())
    assert report['expected_reward']['error'] > 0 and (tmp_path / 'reward/report.png').exists()
    (tmp_path / 'task.yaml').write_text(settings_yaml.dump(config.from_flat({'task': 'formation'}, team.settings)))
    assert train_reward.main(command) == 2
    assert 'was not played in this task' in capsys.readouterr().err


def test_the_true_expected_reward_of_a_recorded_rollout_is_the_one_it_was_played_with():
    team = Team(task='navigation')
    (trajectory, data), truth = team.play(3), recorded_expected_rewards(team.settings.task, 4)
    alternatives = AlternativesRecorder(make_worlds(team.settings.task))
    live = InProcessCollector(alternatives).collect(data[0], team._policy)
    assert np.array_equal(truth(data[0], 0, trajectory), alternatives.expected_rewards(live))
    assert truth(data[0], 0, trajectory).shape == (5, 4, 3)
    with pytest.raises(SettingsError, match='known of navigation, .*, not of pettingzoo:'):
        recorded_expected_rewards(config.from_flat({'task': 'pettingzoo:mpe2.simple_spread_v3'}).task, 4)


@pytest.mark.parametrize('arguments, complaint', [
    (['--bag', 'nowhere/*'], "there is no bag 'nowhere/*'"),
    (['--bag', '.'], 'is not a rosbag2 bag'),
    (['--bag', '.', '-p', 'held_outt:=0.1'], "unknown setting 'held_outt'; did you mean 'held_out'?"),
    (['--bag', '.', '-p', 'num_worlds:=3'], "unknown setting 'num_worlds'"),
    (['--bag', '.', '-p', 'held_out:=2.0'], 'held_out must lie in'),
])
def test_what_the_command_cannot_do_it_says_in_one_sentence(arguments, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train_reward.main(arguments) == 2
    said = capsys.readouterr()
    assert complaint in said.err and said.err.count('\n') == 1 and not said.out
