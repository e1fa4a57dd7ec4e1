"""Starts real node processes for the tests, in whatever order a test wants."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Callable

import pytest
import rclpy
from dae_ros_msgs.msg import TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.client import Client
from std_srvs.srv import Trigger

from dae_ros import config
from dae_ros.errors import Refused
from dae_ros.learning.native import build
from dae_ros.learning.networks import make_reward_network
from dae_ros.learning.reward_files import encode
from dae_ros.report.summary import Summary
from dae_ros.rollout.in_process import train
from dae_ros.ros import names, qos
from dae_ros.ros.farewell import leave
from dae_ros.ros.graph import NodeProcess, training_graph
from dae_ros.ros.node import Executor, look_for_overlooked
from dae_ros.ros.supervisor import Supervisor
from dae_ros.run_folder import RunFolder
from dae_ros.training import Training
from dae_ros.worlds import Worlds, make_worlds, world_spec

TIMEOUT = 120  # s for anything a test waits for; a run takes a tenth of it
ANSWER_TIMEOUT = 10  # s before a service is asked again
REPOSITORY = Path(__file__).parents[2]

SMALL = {'task': 'navigation', 'num_agents': 3, 'num_worlds': 8, 'num_steps': 25, 'total_steps': 5 * 8 * 25, 'epochs': 2,
         'reward_network.epochs': 2, 'reward_network.hidden_size': 16, 'reward_network.trunk_size': 16, 'hidden_size': 16,
         'evaluation_episodes': 8, 'rollout_timeout': 20.0}
"""Five updates of navigation with three robots."""
LASTING = {**SMALL, 'evaluation_episodes': 800}
"""Evaluated for seconds: a test that meddles with a run may take that long to hear of it, and must while it is on."""


class Graph:
    """Node processes of one run, started one by one in the order a test wants."""

    def __init__(self, path: Path, values: dict, namespace: str = '', key_file: str = ''):
        self.settings = settings = config.from_flat(values)
        self.folder = RunFolder(path, settings)
        self._namespace = namespace
        self.processes = {process.name: process for process in training_graph(settings, self.folder, key_file)}
        self._codes: dict[str, int] = {}
        self.pids: dict[str, int] = {}
        self.prefixes: dict[str, list[str]] = {}  # of commands, by node
        self._supervisor = Supervisor(path / 'logs', self._codes.__setitem__)

    @property
    def names(self) -> list[str]:
        return list(self.processes)

    def start(self, *names: str) -> None:
        for name in names:
            process = self.processes[name]
            command = [*self.prefixes.get(name, ()), sys.executable, '-m', f'dae_ros_nodes.{process.executable}',
                       *process.arguments(self.folder.settings_file, self._namespace)]
            self.pids[name] = self._supervisor.start(name, command, os.environ)

    def start_paused(self, listener: Listener) -> None:
        """Starts all nodes; the trainer waits for `names.RESUME` before the first rollout."""
        listener.client(Trigger, names.RESUME)
        self.start('trainer')
        assert listener.call(Trigger, names.PAUSE, Trigger.Request()).success
        self.start(*(name for name in self.names if name != 'trainer'))
        listener.wait_for_status(lambda status: status.state == TrainingStatus.PAUSED)

    def kill(self, *names: str) -> None:
        """Kills nodes that were started; they are gone when this returns."""
        for name in names:
            os.kill(self.pids[name], signal.SIGKILL)
        for name in names:
            self.wait(name)

    def wait(self, name: str = 'trainer') -> int:
        """The exit code of a node that ends by itself."""
        return self._supervisor.wait(name, TIMEOUT)

    def log(self, name: str) -> str:
        return self._supervisor.log_file(name).read_text()

    def refused(self) -> set[str]:
        """Why nodes that were started refused messages. That one came late or again does not count: a rollout may be begun anew
        while nodes are still finding each other."""
        said = ''.join(self.log(name) for name in self.pids)
        return set(re.findall(r'refused a message on \S+: (\w+): ', said)) - {Refused.STALE, Refused.DUPLICATE}

    def stop(self) -> None:
        self._supervisor.stop()

    def result(self) -> tuple[str, float]:
        """SHA-256 of the final weights and mean return of the evaluation."""
        summary = Summary.read(self.folder.summary_file)
        return summary.weights_sha256, summary.evaluation_return


def bringup(folder: Path, values: dict, *arguments: str) -> subprocess.Popen:
    """The bringup command in a process of its own, as a user would type it."""
    settings = [text for name, value in values.items() for text in ('-p', f'{name}:={json.dumps(value)}')]
    # Tests that were started in the background ignore SIGINT, and so would whatever they start.
    return subprocess.Popen([sys.executable, '-m', 'dae_ros_nodes.bringup', '--run-folder', str(folder), *settings, *arguments],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL))


def finish(process: subprocess.Popen, timeout: float = TIMEOUT) -> tuple[int, str, str]:
    """Exit code, output and errors of a command that ends by itself, within so many seconds."""
    output, errors = process.communicate(timeout=timeout)
    return process.returncode, output, errors


def end(*processes: subprocess.Popen) -> list[tuple[str, str | None]]:
    """Asks processes to end; what each said. None is left, also where one does not."""
    for process in processes:
        process.terminate()
    try:
        return [process.communicate(timeout=TIMEOUT) for process in processes]
    finally:
        for process in processes:
            process.kill()


def begin_alone(folder: Path, values: dict) -> tuple[Training, Worlds]:
    """The same run in this process, about to begin."""
    settings = config.from_flat(values)
    worlds = make_worlds(settings.task)
    return Training(settings, worlds.spec, RunFolder(folder, settings)), worlds


def oracle(folder: Path, values: dict) -> tuple[str, float]:
    """What the same run in this process ends with, as `Graph.result`."""
    training, worlds = begin_alone(folder, values)
    train(training, worlds, lambda: None)
    return result_of(training)


def result_of(training: Training) -> tuple[str, float]:
    """As `Graph.result`, of a training that is finished; closes it."""
    training.close()
    return training.weights_sha256(), float(training.evaluation.mean())


def preloadable(source: str, folder: Path) -> Path:
    """The library of a C file of this folder; the test is skipped where there is no compiler."""
    path, library = Path(__file__).with_name(source), (folder / source).with_suffix('.so')
    try:
        subprocess.run([*build.compiler(), '-O2', '-shared', '-fPIC', str(path), '-o', str(library), '-ldl'], check=True,
                       timeout=TIMEOUT)
    except build.BuildError as error:
        pytest.skip(str(error))
    return library


def processes_naming(text: str) -> list[str]:
    """Command lines of the live processes that mention `text`."""
    lines = []
    for entry in Path('/proc').iterdir():
        try:
            line = (entry / 'cmdline').read_bytes().replace(b'\0', b' ').decode(errors='replace')
        except (OSError, NotADirectoryError):
            continue
        if text in line and int(entry.name) != os.getpid():
            lines.append(line)
    return lines


def pid_of(name: str, folder: Path) -> int | None:
    """The process of that name of the run that lies in `folder`, by where its output goes; None where it is not running."""
    for entry in Path('/proc').iterdir():
        try:
            if os.readlink(entry / 'fd' / '1') == str(folder / 'logs' / f'{name}.log'):
                return int(entry.name)
        except (OSError, NotADirectoryError):
            continue
    return None


class Listener:
    """A node in the test process that hears what a team publishes."""

    def __init__(self, namespace: str = ''):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('listener', context=self.context, namespace=namespace)
        look_for_overlooked(self.node)
        self.executor = Executor(context=self.context)
        self.executor.add_node(self.node)
        self._clients: dict[str, Client] = {}

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_) -> None:
        self.executor.shutdown()
        leave([self.node])
        self.context.try_shutdown()

    def spin_until(self, condition: Callable[[], bool], missing: Callable[[], str] = lambda: 'waited in vain') -> None:
        """Takes messages in until `condition` holds; AssertionError that says what is `missing` if it never does."""
        assert self._holds_within(TIMEOUT, condition), missing()

    def _holds_within(self, seconds: float, condition: Callable[[], bool]) -> bool:
        """Takes messages in until `condition` holds, or does not for so long."""
        deadline = time.monotonic() + seconds
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self.executor.spin_once(timeout_sec=min(left, 1.0))
        return True

    def wait_for_status(self, condition: Callable[[TrainingStatus], bool]) -> TrainingStatus:
        """The first status that fulfils `condition`."""
        heard: list[TrainingStatus] = []
        subscription = self.node.create_subscription(TrainingStatus, names.TRAINING_STATUS, heard.append, qos.LATCHED_INPUT)
        self.spin_until(lambda: any(condition(status) for status in heard), lambda: f'waited in vain; heard {heard}')
        self.node.destroy_subscription(subscription)
        return next(status for status in heard if condition(status))

    def client(self, kind: type, name: str) -> Client:
        """The client of a service that `call` uses. A server may drop the answer to one it got to know within the last 100 ms:
        what bears no second asking, or cannot wait for it, has its client made long before."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        return self._clients[name]

    def call(self, kind: type, name: str, request):
        """The response of a service, which is asked again if none comes."""
        client = self.client(kind, name)
        assert client.wait_for_service(TIMEOUT), f'no service {name}'
        futures = []
        while not any(future.done() for future in futures):
            assert len(futures) < TIMEOUT / ANSWER_TIMEOUT, f'{name} does not answer'
            futures.append(client.call_async(request))
            self._holds_within(ANSWER_TIMEOUT, lambda: any(future.done() for future in futures))
        return next(future.result() for future in futures if future.done())


def network_file(path: Path, values: dict = SMALL) -> Path:
    """A file of reward networks that fit the task."""
    settings = config.from_flat(values)
    spec = world_spec(settings.task)
    path.write_bytes(encode([make_reward_network(spec, settings.reward_network, 3, 0)], spec, settings.reward_network))
    return path


class Refusals:
    """How many messages each node says it refused, from /diagnostics."""

    def __init__(self, listener: Listener):
        self.counted: dict[tuple[str, str, str], int] = {}  # by node, topic and reason
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._hear, qos.EVENTS)

    def _hear(self, report: DiagnosticArray) -> None:
        for status in report.status:
            for entry in status.values:
                if entry.key.startswith('refused '):
                    _, topic, reason = entry.key.split()
                    self.counted[status.name, topic, reason] = int(entry.value)


class Recorder:
    """A recorder beside a graph, and what it says of itself on /diagnostics."""

    def __init__(self, graph: Graph, listener: Listener, bag: Path, name: str = 'recorder', **parameters):
        self.sentence, self.values, self._name = '', {}, name
        self._graph = graph
        self._listener = listener
        graph.processes[name] = NodeProcess('recorder', name, {'bag': str(bag), **parameters})
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._hear, qos.EVENTS)

    def _hear(self, report: DiagnosticArray) -> None:
        for status in report.status:
            if status.name == f'/{self._name}':
                self.sentence, self.values = status.message, {value.key: value.value for value in status.values}

    def record_run(self) -> None:
        """Takes the graph through its whole run, of which the recorder hears everything."""
        graph, listener = self._graph, self._listener
        graph.start_paused(listener)
        listener.spin_until(lambda: self.sentence == 'recording', lambda: graph.log(self._name))
        assert listener.call(Trigger, names.RESUME, Trigger.Request()).success
        assert graph.wait() == 0, graph.log('trainer')
        # A rollout of T steps with N robots: a request, T + 1 states, T rewards, N T actions. The graph is past the last of them.
        task, run = graph.settings.task, graph.settings.run
        rollouts = -(-run.total_steps // (task.num_worlds * run.num_steps)) + -(-run.evaluation_episodes // task.num_worlds)
        least = rollouts * (1 + task.world_groups * (1 + run.num_steps * (2 + task.num_agents)))
        listener.spin_until(lambda: int(self.values['messages']) > least, lambda: str(self.values))
