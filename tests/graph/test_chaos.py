"""Whatever is killed, whenever: the run ends with the weights of the run that nothing disturbed, bit for bit.

`make chaos` kills more often: CHAOS_KILLS says how often, CHAOS_SEED whom and when.
"""

from __future__ import annotations

import os
import random
import signal
import time

import pytest
from dae_ros_msgs.msg import TrainingStatus
from harness import SMALL, Listener, bringup, finish, oracle, pid_of, processes_naming

from dae_ros.report.metrics import read_metrics
from dae_ros.report.summary import Summary

AGENTS = ('agent_0', 'agent_1', 'agent_2')
NODES = ('world', *AGENTS, 'parameter_server', 'trainer')
UPDATES = 40
VALUES = {**SMALL, 'total_steps': UPDATES * 8 * 25}
KILLS = int(os.environ.get('CHAOS_KILLS', 5))
SEED = int(os.environ.get('CHAOS_SEED', 1))


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    """SHA-256 of the final weights and mean return of the evaluation, by number of updates."""
    results = {}

    def find(updates: int) -> tuple[str, float]:
        if updates not in results:
            results[updates] = oracle(tmp_path_factory.mktemp('alone') / 'run', {**VALUES, 'total_steps': updates * 8 * 25})
        return results[updates]

    return find


class Disturbed:
    """A training by bringup whose nodes a test kills."""

    def __init__(self, folder, updates: int):
        self.folder, self.updates = folder, updates
        self.process = bringup(folder, {**VALUES, 'total_steps': updates * 8 * 25})

    def kill(self, *nodes: str) -> list[str]:
        """Kills those of the nodes that run; their names."""
        found = {node: pid for node in nodes if (pid := pid_of(node, self.folder)) is not None}
        for pid in found.values():
            os.kill(pid, signal.SIGKILL)
        return list(found)

    def assert_ends_with(self, expected: tuple[str, float]) -> None:
        """The run ends by itself with this result, and everything a run leaves, and nothing else."""
        code, output, errors = finish(self.process)
        logs = {path.stem: path.read_text() for path in (self.folder / 'logs').iterdir()}
        assert code == 0, output + errors + '\n'.join(f'--- {name}\n{log[-3000:]}' for name, log in logs.items())
        summary = Summary.read(self.folder / 'summary.json')
        assert (summary.weights_sha256, summary.evaluation_return) == expected
        assert 'Traceback' not in output + errors + ''.join(logs.values())
        assert list(read_metrics(self.folder / 'metrics.csv')['environment_steps']) == [
            200 * (update + 1) for update in range(self.updates)]
        assert not processes_naming(str(self.folder))


@pytest.fixture
def disturb(domain, tmp_path):
    """Begins such trainings, and ends what is left of them."""
    runs: list[Disturbed] = []

    def begin(updates: int = UPDATES) -> Disturbed:
        runs.append(Disturbed(tmp_path / f'run_{len(runs)}', updates))
        return runs[-1]

    yield begin
    for run in runs:
        run.process.kill()
        run.process.communicate()


def victims(kills: int, draw: random.Random) -> list[tuple[str, ...]]:
    """Whom to kill at once, as often: each kind of node, the trainer twice in a row, and then anyone, sometimes two."""
    first = [('world',), (draw.choice(AGENTS),), ('parameter_server',), ('trainer',), ('trainer',)]
    anyone = [tuple(draw.sample(NODES, draw.choice((1, 1, 2)))) for _ in range(kills - len(first))]
    return (first + anyone)[:kills]


def test_the_run_ends_with_the_same_weights_whoever_is_killed_whenever(disturb, undisturbed):
    """Kills when the training has come to versions drawn at random, and a moment later."""
    draw = random.Random(SEED)
    updates = max(UPDATES, 8 * KILLS)
    run, killed = disturb(updates), []
    with Listener() as listener:
        moments = sorted(draw.sample(range(updates - 3), KILLS - 1))
        for version, nodes in zip([*moments, updates], victims(KILLS, draw)):  # the last one while it is evaluated
            listener.wait_for_status(lambda status: status.policy_version >= version)
            time.sleep(draw.uniform(0, 0.3))
            killed += run.kill(*nodes)
    print(f'{len(killed)} killed in {updates} updates: {", ".join(killed)}')
    assert len(killed) >= KILLS
    run.assert_ends_with(undisturbed(updates))
