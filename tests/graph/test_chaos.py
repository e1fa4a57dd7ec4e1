"""Whatever is killed, whenever: the run ends with the weights of the run that nothing disturbed, bit for bit.

`make chaos` kills more often: CHAOS_KILLS says how often, CHAOS_SEED in which arrangement, whom and when.
"""

from __future__ import annotations

import os
import random
import signal
import time

import pytest
from dae_ros_msgs.msg import PolicyWeights, TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray
from harness import LASTING, Listener, bringup, finish, oracle, pid_of, processes_naming

from dae_ros import config
from dae_ros.report.metrics import read_metrics
from dae_ros.report.summary import Summary
from dae_ros.ros import names, qos
from dae_ros.ros.graph import training_graph
from dae_ros.run_folder import RunFolder
from dae_ros.weights.codec import decode_policy

UPDATES = 40
VALUES = {**LASTING, 'total_steps': UPDATES * 8 * 25}
KILLS = int(os.environ.get('CHAOS_KILLS', 5))
SEED = int(os.environ.get('CHAOS_SEED', 1))
ARRANGEMENTS = ({'world_groups': 2, 'robots_per_process': 2}, {}, {'robots_per_process': 1})


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    """SHA-256 of the final weights and mean return of the evaluation, by number of updates."""
    results = {}

    def find(updates: int, **changed) -> tuple[str, float]:
        key = updates, *changed.items()
        if key not in results:
            values = {**VALUES, 'total_steps': updates * 8 * 25, **changed}
            results[key] = oracle(tmp_path_factory.mktemp('alone') / 'run', values)
        return results[key]

    return find


class Disturbed:
    """A training by bringup whose nodes a test kills."""

    def __init__(self, folder, updates: int, changed: dict):
        self.folder, self.updates = folder, updates
        values = {**VALUES, 'total_steps': updates * 8 * 25, **changed}
        self.process = bringup(folder, values)
        settings = config.from_flat(values)
        self.names = [process.name for process in training_graph(settings, RunFolder(folder, settings))]

    def kill(self, *nodes: str, by: int = signal.SIGKILL) -> list[str]:
        """Kills those of the nodes that run, or sends them another signal; their names."""
        found = {node: pid for node in nodes if (pid := pid_of(node, self.folder)) is not None}
        for pid in found.values():
            os.kill(pid, by)
        return list(found)

    def assert_ends_with(self, expected: tuple[str, float]) -> str:
        """The run ends by itself with this result and leaves everything it should and no process; what it said."""
        code, output, errors = finish(self.process)
        logs = self._logs()
        assert code == 0, output + errors
        summary = Summary.read(self.folder / 'summary.json')
        assert (summary.weights_sha256, summary.evaluation_return) == expected
        assert 'Traceback' not in output + errors + ''.join(logs.values())
        assert list(read_metrics(self.folder / 'metrics.csv')['environment_steps']) == [
            200 * (update + 1) for update in range(self.updates)]
        assert not processes_naming(str(self.folder))
        return output

    def end(self) -> None:
        """Ends what is left of it and prints what was said, for a test that failed."""
        self.process.kill()
        print(*finish(self.process)[1:])
        for name, log in self._logs().items():
            print(f'--- {name}\n{log[-3000:]}')

    def _logs(self) -> dict[str, str]:
        return {path.stem: path.read_text() for path in (self.folder / 'logs').glob('*')}  # none where bringup refused


@pytest.fixture
def disturb(domain, tmp_path):
    """Begins such trainings, and ends what is left of them."""
    runs: list[Disturbed] = []

    def begin(updates: int = UPDATES, **changed) -> Disturbed:
        runs.append(Disturbed(tmp_path / f'run_{len(runs)}', updates, changed))
        return runs[-1]

    yield begin
    for run in runs:
        run.end()


def victims(processes: list[str], kills: int, draw: random.Random) -> list[tuple[str, ...]]:
    """Whom to kill at once, as often: each kind of process, the trainer twice in a row, and then anyone, sometimes two."""
    worlds, agents = ([name for name in processes if name.startswith(kind)] for kind in ('world', 'agent'))
    first = [(draw.choice(worlds),), (draw.choice(agents),), ('parameter_server',), ('trainer',), ('trainer',)]
    anyone = [tuple(draw.sample(processes, draw.choice((1, 1, 2)))) for _ in range(kills - len(first))]
    return (first + anyone)[:kills]


def test_the_run_ends_with_the_same_weights_whoever_is_killed_whenever(disturb, undisturbed):
    """Kills when the training has come to versions drawn at random, and a moment later."""
    draw = random.Random(SEED)
    updates = max(UPDATES, 8 * KILLS)
    arrangement = ARRANGEMENTS[SEED % len(ARRANGEMENTS)]
    run, killed = disturb(updates, **arrangement), []
    with Listener() as listener:
        moments = sorted(draw.sample(range(updates - 3), KILLS - 1))
        for version, nodes in zip([*moments, updates], victims(run.names, KILLS, draw)):  # the last one while it is evaluated
            listener.wait_for_status(lambda status: status.policy_version >= version)
            time.sleep(draw.uniform(0, 0.3))
            killed += run.kill(*nodes) or run.kill('trainer')  # which has just spoken
    print(f'{len(killed)} killed in {updates} updates: {", ".join(killed)}')
    assert len(killed) >= KILLS
    run.assert_ends_with(undisturbed(updates, **arrangement))


def test_the_server_serves_from_disk_before_a_trainer_is_back_that_lost_its_newest_checkpoint(make_graph, undisturbed, tmp_path):
    graph = make_graph(tmp_path / 'run', VALUES)
    graph.start(*graph.names)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 6)
        graph.kill('trainer', 'parameter_server', 'world')
        *_, before, newest = sorted(graph.folder.checkpoints.glob('checkpoint_*'))
        newest.write_bytes(newest.read_bytes()[:-100])
        served: list[PolicyWeights] = []
        told: list[TrainingStatus] = []
        listener.node.create_subscription(PolicyWeights, names.POLICY, served.append, qos.LATCHED_INPUT)
        listener.node.create_subscription(TrainingStatus, names.TRAINING_STATUS, told.append, qos.LATCHED_INPUT)
        graph.start('parameter_server')
        listener.spin_until(lambda: bool(served))
        assert served[0].version >= 5 and len(decode_policy(bytes(served[0].data)).tensors)
        graph.start('trainer')
        listener.spin_until(lambda: bool(told))
        assert f'checkpoint_{told[0].policy_version:08d}' == before.stem  # without a world it goes no further
        graph.start('world')
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == undisturbed(UPDATES)


def test_a_node_that_is_alive_but_silent_is_replaced_and_named(disturb, undisturbed):
    run, told = disturb(silence_timeout=30.0, robots_per_process=2), []
    with Listener() as listener:
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, lambda report: told.extend(report.status),
                                          qos.EVENTS)
        listener.wait_for_status(lambda status: status.policy_version >= 3)
        assert run.kill('agents_0-1', by=signal.SIGSTOP)
        sentence = 'agents_0-1 has said nothing for 30 s and is killed'
        listener.spin_until(lambda: {status.name for status in told if status.message == sentence} == {'/agent_0', '/agent_1'})
    assert sentence in run.assert_ends_with(undisturbed(UPDATES))


def test_a_trainer_whom_nobody_answers_says_so_and_gives_up_with_everything_saved(make_graph, undisturbed, tmp_path):
    values = {**VALUES, 'rollout_timeout': 1.0, 'max_silent_attempts': 4}
    graph = make_graph(tmp_path / 'run', values)
    graph.start(*graph.names)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 3)
        os.kill(graph.pids['world'], signal.SIGSTOP)
        listener.wait_for_status(lambda status: status.detail.startswith('nothing heard for 1 s; missing: '))
    assert graph.wait('trainer') == 2
    assert 'error: given up after 4 attempts at a rollout: nothing heard for 1 s' in graph.log('trainer')
    assert 'Traceback' not in graph.log('trainer')
    os.kill(graph.pids['world'], signal.SIGCONT)
    graph.start('trainer')
    assert graph.wait('trainer') == 0, graph.log('trainer')
    assert graph.result() == undisturbed(UPDATES)
