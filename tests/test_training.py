"""A training in one process: the same settings give the same weights, also when it was interrupted in between."""

import math
import threading

import numpy as np
import pytest
from hypothesis import given, settings, strategies

from dae_ros import config
from dae_ros.errors import FileError
from dae_ros.report.metrics import read_metrics
from dae_ros.rollout.in_process import InProcessCollector, train
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training, episode_returns
from dae_ros.types import Trajectory
from dae_ros.weights.codec import decode_policy, encode_policy, tensors_sha256
from dae_ros.worlds import make_worlds, world_spec

UPDATES = 5
SMALL = {'seed': 3, 'learner_threads': 1, 'hidden_size': 8, 'reward_network.hidden_size': 8, 'reward_network.trunk_size': 8,
         'epochs': 2, 'reward_network.epochs': 2, 'chunk_length': 4, 'evaluation_episodes': 10, 'checkpoint_interval': 2}
NAVIGATION = {**SMALL, 'task': 'navigation', 'num_agents': 3, 'num_worlds': 4, 'num_steps': 10, 'episode_steps': 5,
              'total_steps': 40 * UPDATES, 'num_mini_batches': 2}
MATRIX_GAME = {**SMALL, 'task': 'matrix_game', 'num_agents': 4, 'num_worlds': 3, 'num_steps': 8,
               'total_steps': 24 * UPDATES}
TASKS = pytest.mark.parametrize('values', [NAVIGATION, MATRIX_GAME], ids=['navigation', 'matrix game'])


class Interrupted(Exception):
    """Stands for whatever kills a process."""


class Run:
    """A training in a folder of its own, closed at the end of the test."""

    def __init__(self, path, values):
        self.settings = config.from_flat(values)
        self.folder = RunFolder(path, self.settings)
        self.training = Training(self.settings, world_spec(self.settings.task), self.folder)
        self.updates = 0

    def train(self, stop_after=None):
        """Goes on to the end, or is interrupted right after so many rollouts."""
        def on_update():
            self.updates += 1
            if self.updates == stop_after:
                raise Interrupted

        try:
            train(self.training, make_worlds(self.settings.task), on_update)
        except Interrupted:
            self.training.close()
        return self

    def collect(self):
        """One rollout asked for, collected and consumed; its request."""
        request = self.training.request()
        collector = InProcessCollector(make_worlds(self.settings.task))
        self.training.consume(collector.collect(request, self.training.policy))
        return request

    def metrics(self):
        """Every metric that does not tell the time."""
        columns = read_metrics(self.folder.metrics_file)
        return {name: column.tolist() for name, column in columns.items()
                if not name.startswith('seconds') and name != 'steps_per_second'}


@pytest.fixture
def begin(tmp_path):
    """Begins runs, each in a folder of its own unless it is told which."""
    runs = []

    def begin_one(values, name=None, **changed):
        runs.append(Run(tmp_path / (name or f'run_{len(runs)}'), {**values, **changed}))
        return runs[-1]

    yield begin_one
    for run in runs:
        run.training.close()


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    """Gives the run of some settings that nothing disturbed; one serves all tests."""
    runs = {}

    def find(values):
        if values['task'] not in runs:
            runs[values['task']] = Run(tmp_path_factory.mktemp('undisturbed') / 'run', values).train()
        return runs[values['task']]

    yield find
    for run in runs.values():
        run.training.close()


def assert_same_end(one, other):
    """Both trainings learnt and evaluated the same, bit for bit."""
    assert one.training.weights_sha256() == other.training.weights_sha256()
    assert encode_policy(one.training.policy) == encode_policy(other.training.policy)
    np.testing.assert_array_equal(one.training.evaluation, other.training.evaluation)
    assert one.metrics() == other.metrics()
    assert one.training.environment_steps == other.training.environment_steps


# Determinism.


@TASKS
def test_the_same_seed_ends_with_the_same_weights_and_another_seed_with_others(begin, undisturbed, values):
    first, again, other = undisturbed(values), begin(values).train(), begin(values, seed=4).train()
    assert_same_end(first, again)
    assert other.training.weights_sha256() != first.training.weights_sha256()
    assert encode_policy(other.training.policy) != encode_policy(first.training.policy)
    assert other.metrics()['mean_return'] != first.metrics()['mean_return']


@pytest.mark.parametrize('values, stop_after, saved', [
    pytest.param(NAVIGATION, 1, 0, id='before a checkpoint'), pytest.param(NAVIGATION, 3, 2, id='after a checkpoint'),
    pytest.param(NAVIGATION, 4, 4, id='right at a checkpoint'), pytest.param(NAVIGATION, 6, 5, id='in the evaluation'),
    pytest.param(MATRIX_GAME, 3, 2, id='matrix game')])
def test_an_interrupted_training_ends_as_if_nothing_had_happened(begin, undisturbed, values, stop_after, saved):
    begin(values, 'disturbed').train(stop_after)
    resumed = begin(values, 'disturbed')
    assert resumed.training.policy_version == saved
    assert_same_end(resumed.train(), undisturbed(values))


def test_a_resumed_training_knows_how_far_it_was_and_how_long_it_took(begin):
    killed = begin(NAVIGATION, 'disturbed', checkpoint_interval=1).train(stop_after=3)
    resumed = begin(NAVIGATION, 'disturbed', checkpoint_interval=1).training
    assert resumed.run == killed.training.run and resumed.environment_steps == 3 * 40
    assert resumed.mean_return == killed.training.mean_return
    assert 0 < resumed.seconds <= killed.training.seconds
    assert resumed.steps_per_second == 0
    assert resumed.request().rollout == 3


def test_a_training_may_be_interrupted_again_and_again(begin, undisturbed):
    for _ in range(UPDATES):
        begin(NAVIGATION, 'disturbed', checkpoint_interval=1).train(stop_after=1)
    last = begin(NAVIGATION, 'disturbed', checkpoint_interval=1)
    assert last.training.evaluating
    assert_same_end(last.train(), undisturbed(NAVIGATION))


def test_a_training_whose_newest_checkpoint_is_damaged_goes_on_from_the_one_before(begin, undisturbed):
    disturbed = begin(NAVIGATION, 'disturbed').train(stop_after=4)
    newest = max(disturbed.folder.checkpoints.iterdir())
    newest.write_bytes(newest.read_bytes()[:-1])
    resumed = begin(NAVIGATION, 'disturbed')
    assert resumed.training.policy_version == 2
    assert_same_end(resumed.train(), undisturbed(NAVIGATION))


def test_a_rollout_begun_anew_changes_no_weight(begin, undisturbed):
    disturbed = begin(NAVIGATION)
    while not disturbed.training.finished:
        for _ in range(disturbed.training.policy_version % 3):
            disturbed.training.request()
        disturbed.collect()
    assert_same_end(disturbed, undisturbed(NAVIGATION))


# What is asked for.


def test_rollouts_are_asked_for_one_after_the_other_with_the_version_learnt_from_the_one_before(begin):
    run = begin(NAVIGATION)
    requests = []
    while not run.training.finished:
        requests.append(run.collect())
        assert run.training.policy_version == min(len(requests), UPDATES)
    assert [request.rollout for request in requests] == list(range(UPDATES + 2))  # 8 of 10 episodes, then 8 more
    assert [request.policy_version for request in requests] == [0, 1, 2, 3, 4, 5, 5]
    assert [request.greedy for request in requests] == [False] * UPDATES + [True] * 2
    assert {(request.run, request.attempt, request.seed, request.num_steps) for request in requests} == {
        (run.folder.run, 0, 3, 10)}


def test_a_rollout_asked_for_twice_is_the_next_attempt_of_the_same_rollout(begin):
    run = begin(NAVIGATION)
    first, second, third = (run.training.request() for _ in range(3))
    assert [request.attempt for request in (first, second, third)] == [0, 1, 2]
    assert first == second._replace(attempt=0) == third._replace(attempt=0)
    assert run.collect().attempt == 3
    request = run.training.request()
    assert (request.rollout, request.attempt, request.policy_version) == (1, 3, 1)


def test_a_training_that_comes_back_at_an_earlier_rollout_supersedes_what_it_asked_for_before(begin):
    killed = begin(NAVIGATION, 'disturbed').train(stop_after=3)
    before = killed.training.request()
    after = begin(NAVIGATION, 'disturbed').training.request()
    assert (before.rollout, after.rollout) == (3, 2)
    assert after.order > before.order


@pytest.mark.parametrize('greedy', [True, False])
def test_the_trained_team_is_evaluated_greedily_or_not_as_the_settings_say(begin, greedy):
    run = begin(NAVIGATION, evaluation_greedy=greedy, total_steps=80)
    for _ in range(2):
        assert not run.training.evaluating and not run.training.request().greedy
        run.collect()
    assert run.training.evaluating and run.training.request().greedy == greedy


@pytest.mark.parametrize('asked, steps', [(1, 40), (40, 40), (41, 80)])
def test_a_training_lasts_as_many_whole_rollouts_as_its_steps_need(begin, asked, steps):
    run = begin(NAVIGATION, total_steps=asked, evaluation_episodes=0)
    assert run.training.total_steps == steps and run.training.environment_steps == 0
    run.train()
    assert run.training.environment_steps == steps == 40 * run.training.policy_version
    assert run.metrics()['environment_steps'] == list(range(40, steps + 1, 40))


# Evaluation.


@pytest.mark.parametrize('episodes, played', [(0, 0), (1, 8), (8, 8), (9, 16)])
def test_the_evaluation_ends_when_enough_episodes_are_played(begin, episodes, played):
    run = begin(NAVIGATION, evaluation_episodes=episodes, total_steps=40).train()
    assert run.training.finished and len(run.training.evaluation) == played
    assert run.training.policy_version == 1
    assert run.training.environment_steps == run.training.total_steps == 40


def test_the_evaluation_plays_fresh_episodes_with_the_trained_team_and_learns_nothing_from_them(begin):
    run = begin(NAVIGATION, total_steps=40)
    run.collect()
    weights = run.training.weights_sha256()
    collector = InProcessCollector(make_worlds(run.settings.task))
    returns = []
    while not run.training.finished:
        trajectory = collector.collect(run.training.request(), run.training.policy)
        run.training.consume(trajectory)
        returns.append(trajectory.rewards.reshape(2, 5, 4).sum(1, dtype=np.float64).ravel())
    assert len(np.unique(np.concatenate(returns))) == 16  # no episode twice
    np.testing.assert_allclose(run.training.evaluation, np.concatenate(returns), rtol=1e-6)
    assert run.training.weights_sha256() == weights
    assert len(run.metrics()['mean_return']) == 1


def test_the_mean_return_is_that_of_the_episodes_of_the_last_rollout_learnt_from(begin):
    run = begin(MATRIX_GAME)
    assert math.isnan(run.training.mean_return)
    collector = InProcessCollector(make_worlds(run.settings.task))
    trajectory = collector.collect(run.training.request(), run.training.policy)
    run.training.consume(trajectory)
    assert run.training.mean_return == pytest.approx(trajectory.rewards.sum() / 6)  # 3 worlds, 2 episodes each
    assert run.metrics()['mean_return'] == [run.training.mean_return]


def trajectory_of(rewards, terminated, truncated):
    empty = np.empty(0)
    return Trajectory(empty, empty, empty, empty, empty, rewards, terminated, truncated, empty)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32), steps=strategies.integers(1, 10), worlds=strategies.integers(1, 4))
def test_the_return_of_an_episode_is_the_sum_of_its_rewards_and_unfinished_ones_have_none(seed, steps, worlds):
    random = np.random.default_rng(seed)
    rewards = random.normal(size=(steps, worlds)).astype(np.float32)
    terminated = random.random((steps, worlds)) < 0.2
    truncated = ~terminated & (random.random((steps, worlds)) < 0.2)
    by_hand = []
    for world in range(worlds):
        begin = 0
        for step in range(steps):
            if terminated[step, world] or truncated[step, world]:
                by_hand.append(sum(float(reward) for reward in rewards[begin:step + 1, world]))
                begin = step + 1
    returns = episode_returns(trajectory_of(rewards, terminated, truncated))
    np.testing.assert_allclose(sorted(returns), sorted(by_hand), rtol=1e-12, atol=1e-12)


def test_a_rollout_in_which_no_episode_ended_has_no_returns_and_no_mean(begin):
    assert episode_returns(trajectory_of(np.ones((3, 2)), np.zeros((3, 2), bool), np.zeros((3, 2), bool))).shape == (0,)
    run = begin(NAVIGATION, episode_steps=0)  # 25 steps, in rollouts of 10
    run.collect()
    assert math.isnan(run.training.mean_return) and run.training.policy_version == 1


# What it leaves.


def test_checkpoints_are_written_at_their_interval_and_at_the_end(begin):
    run = begin(NAVIGATION)
    updates = []
    while not run.training.finished:
        run.collect()
        found = sorted(int(path.stem[11:]) for path in run.folder.checkpoints.glob('checkpoint_*'))
        updates.append(found)
    run.training.close()
    assert updates[-1] == [2, 4, 5]
    assert all(update in (2, 4, 5) for found in updates for update in found)


def test_the_last_checkpoint_is_whole_before_the_evaluation_begins_and_any_other_when_the_training_is_closed(begin):
    run = begin(NAVIGATION)
    while not run.training.evaluating:
        run.collect()
    assert run.folder.newest_checkpoint()[1]['updates'] == UPDATES
    stopped = begin(NAVIGATION).train(stop_after=2)
    assert stopped.folder.newest_checkpoint()[1]['updates'] == 2


def test_a_checkpoint_holds_the_training_as_it_was_however_late_it_is_written(begin, monkeypatch):
    writing, released = [], threading.Event()
    save_checkpoint = RunFolder.save_checkpoint

    def late(*arguments):
        writing.append(arguments)
        assert released.wait(60)
        save_checkpoint(*arguments)

    run, undelayed = (begin(NAVIGATION, checkpoint_interval=1) for _ in range(2))
    undelayed.collect()
    weights = undelayed.training.weights_sha256()
    monkeypatch.setattr(RunFolder, 'save_checkpoint', late)
    run.collect()
    trajectory = InProcessCollector(make_worlds(run.settings.task)).collect(run.training.request(), run.training.policy)
    run.training._learner.update(trajectory, 1)
    assert run.training.weights_sha256() != weights
    released.set()
    run.training.close()
    assert tensors_sha256(run.folder.newest_checkpoint()[0]) == weights


def test_a_checkpoint_that_cannot_be_written_ends_the_training_with_an_error_that_names_it(begin, monkeypatch):
    def full(*_):
        raise OSError(28, 'No space left on device')

    run = begin(NAVIGATION, checkpoint_interval=1)
    with monkeypatch.context() as patch:
        patch.setattr('os.fsync', full)
        run.collect()
        with pytest.raises(FileError, match='checkpoint_00000001.safetensors: No space left on device'):
            run.training.save()
    assert not any(run.folder.checkpoints.iterdir())
    run.training.save()
    assert run.folder.newest_checkpoint()[1]['updates'] == 1


def test_the_trained_policy_is_left_as_a_file(undisturbed):
    run = undisturbed(NAVIGATION)
    data = run.folder.policy_file.read_bytes()
    assert data == encode_policy(run.training.policy)
    architecture = decode_policy(data).architecture
    assert (architecture.observation_size, architecture.num_actions, architecture.hidden_size) == (18, 5, 8)


def test_a_finished_training_opened_again_learns_nothing_more_and_is_evaluated_anew(begin, undisturbed):
    begin(NAVIGATION, 'finished').train().training.close()
    again = begin(NAVIGATION, 'finished')
    assert again.training.evaluating and not again.training.finished
    assert_same_end(again.train(), undisturbed(NAVIGATION))


def test_a_training_tells_its_time_and_its_pace(begin):
    run = begin(NAVIGATION)
    assert run.training.seconds == run.training.steps_per_second == 0
    run.collect()
    assert run.training.seconds > 0 and run.training.steps_per_second > 0
