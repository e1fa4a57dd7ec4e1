"""Reward networks learn from bags, the same from the same bags, and far better than the mean reward predicts."""

import json
import random

import numpy as np
import pytest
from dae_ros_nodes import train_reward

from dae_ros import config
from dae_ros.config import RewardTrainingSettings
from dae_ros.errors import BagError, Refused
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.reward_training import RewardTraining
from dae_ros.weights.codec import decode_policy, decode_reward_network
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
    assert schema['spec'] == Team(**GAME).spec._asdict()
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
