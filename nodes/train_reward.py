"""train_reward: trains a reward network from bags, without ROS, and reports how well it predicts what it has not seen.

    ros2 run dae_ros train_reward --bag bags/* --output runs/reward_network.safetensors
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from dae_ros import config, settings_yaml
from dae_ros.command import run_command
from dae_ros.config import (
    SETTINGS,
    BodySettings,
    BridgeSettings,
    RewardTrainingSettings,
    RobotBagSettings,
    TaskSettings,
    declarations,
)
from dae_ros.errors import DaeRosError
from dae_ros.files import write_atomically
from dae_ros.replay.dataset import Dataset
from dae_ros.replay.robot_dataset import RobotDataset
from dae_ros.ros.graph import read_values
from dae_ros.weights.codec import sha256

OWN = {info.name: info for info in declarations(RewardTrainingSettings)}
SHARED = {name: SETTINGS[name] for name in (
    'reward_network.architecture', 'reward_network.hidden_size', 'reward_network.trunk_size', 'reward_network.recurrent',
    'reward_network.ensemble_size', 'reward_network.learning_rate', 'chunk_length', 'adam_epsilon', 'max_gradient_norm',
    'seed', 'device', 'learner_threads')}
KNOWN = {**OWN, **SHARED}
ROBOTS = {info.name: info for info in declarations(TaskSettings, BodySettings, BridgeSettings, RobotBagSettings)}


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    settings_help = '\n'.join(f'  {info.name} := {info.default!r}  {info.describe()}' for info in KNOWN.values())
    parser = argparse.ArgumentParser(prog='train_reward', description=__doc__.split('\n')[0].removeprefix('train_reward: '),
                                     epilog=f'settings:\n{settings_help}', formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--bag', nargs='+', action='extend', required=True, metavar='BAG',
                        help='bags (folders or files) and glob patterns')
    parser.add_argument('--output', type=Path, default=Path('runs/reward_network.safetensors'),
                        help='the file to write; the report goes to a folder beside it (default %(default)s)')
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument('--robots', type=Path, metavar='FILE',
                       help='task file of a team of robots whose odometry, velocity commands and landmarks the bags hold, '
                            'without any message of ours; -p then takes its settings too')
    kinds.add_argument('--task', type=Path, metavar='FILE',
                       help='task file, or settings.yaml of the run, that was recorded: its simulator then tells the true E[r], '
                            'and the report how far from it the predictions are')
    parser.add_argument('-p', '--parameter', action='append', default=[], metavar='NAME:=VALUE', help='change a setting')
    return parser.parse_args(arguments)


def read_settings(arguments: argparse.Namespace) -> tuple[config.Settings, RewardTrainingSettings]:
    """The settings with the overrides put in. Raises SettingsError."""
    values = dict(settings_yaml.parse_override(text) for text in arguments.parameter)
    known = {**KNOWN, **ROBOTS} if arguments.robots else KNOWN
    for name in values:
        if name not in known:
            raise config.unknown_setting(name, known)
    own = {name: OWN[name].check(value) for name, value in values.items() if name in OWN}
    return config.from_flat({name: value for name, value in values.items() if name in SHARED}), RewardTrainingSettings(**own)


def read_bags(arguments: argparse.Namespace) -> Dataset | RobotDataset:
    """The bags: ours, or those of robots. Raises BagError and SettingsError."""
    if not arguments.robots:
        return Dataset(*arguments.bag)
    of_robots = [text for text in arguments.parameter if settings_yaml.parse_override(text)[0] not in KNOWN]
    values = {name: info.default for name, info in ROBOTS.items()}
    return RobotDataset(*arguments.bag, settings={**values, **read_values(arguments.robots, of_robots)})


def read_task(path: Path) -> TaskSettings:
    """The task that a file of settings names. Raises SettingsError."""
    return config.from_flat(settings_yaml.load(path)).task


def train(dataset: Dataset | RobotDataset, arguments: argparse.Namespace, console: Console) -> None:
    """Trains, writes file and report, and says what came of it. Raises DaeRosError."""
    from dae_ros.credit_probe import accuracy, recorded_expected_rewards
    from dae_ros.replay.reward_training import RewardTraining  # torch takes seconds to load, and a wrong setting none
    from dae_ros.report.reward_training import write_report

    def say(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    settings, own = read_settings(arguments)
    columns = TextColumn('{task.description}'), BarColumn(bar_width=None), MofNCompleteColumn(), TextColumn('rollouts')
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task('reading', total=None)
        training = RewardTraining(dataset, settings, own,
                                  lambda done, total: progress.update(bar, completed=done, total=total or None))
        try:
            truth = recorded_expected_rewards(read_task(arguments.task), dataset.num_worlds) if arguments.task else None
            baseline, skipped, epochs = training.baseline, dataset.describe_skipped(), []
            say(f'{dataset.rollouts:,} rollouts, {dataset.environment_steps:,} environment steps, {baseline.episodes:,} episodes '
                f'with {baseline.held_out_episodes:,} held out{skipped and f"; skipped: {skipped}"}')
            for epoch in training.run():
                epochs.append(epoch)
                progress.update(bar, description=f'epoch {epoch.number + 1}')
                say(f'epoch {epoch.number}: held-out error {epoch.held_out_error:.4g}, that of the mean reward is '
                    f'{baseline.held_out_error:.4g}{" (best)" if epoch.best else ""}')
            data, held_out = training.file(), training.held_out(truth)
        finally:
            training.close()
    best = min(epochs, key=lambda epoch: epoch.held_out_error)
    times = baseline.held_out_error / best.held_out_error if best.held_out_error else None
    used = {name: value for name, value in config.flatten(settings).items() if name in SHARED}
    facts = {'rollouts': dataset.rollouts, 'environment_steps': dataset.environment_steps, 'skipped': dict(dataset.skipped),
             'episodes': baseline.episodes, 'held_out_episodes': baseline.held_out_episodes,
             'mean_reward_error': baseline.held_out_error, 'held_out_error': best.held_out_error, 'times_better': times,
             'best_epoch': best.number, 'epochs': [epoch._asdict() for epoch in epochs], 'sha256': sha256(data),
             'settings': {**dataclasses.asdict(own), **used}}
    if truth is not None:
        known = accuracy(held_out.rewards, held_out.true_expected, held_out.expected)
        facts['expected_reward'] = {name: value if math.isfinite(value) else None for name, value in known._asdict().items()}
        say(f'E[r] on held-out steps: root mean square error {known.error:.3g}, {100 * known.explained:.1f} % of its variance '
            f'and {100 * known.credit_explained:.1f} % of the credit explained')
    report = arguments.output.with_suffix('')
    try:
        report.mkdir(parents=True, exist_ok=True)
        write_atomically(arguments.output, data)
        write_report(report, facts, [epoch.held_out_error for epoch in epochs], baseline.held_out_error, held_out)
    except OSError as error:
        raise DaeRosError(f'cannot write {arguments.output}: {error.strerror}') from error
    say(f'{arguments.output}, SHA-256 {facts["sha256"]}; report in {report}')


def main(args: list[str] | None = None) -> int:
    arguments = parse_arguments(args)

    def act() -> int:
        read_settings(arguments)
        if arguments.task:
            read_task(arguments.task)
        train(read_bags(arguments), arguments, Console(highlight=False))
        return 0

    return run_command(act, 'stopped; nothing was written')


if __name__ == '__main__':
    sys.exit(main())
