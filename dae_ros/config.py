"""Every tunable once: typed, with default, unit, range and help. YAML files, ROS parameters, command-line overrides and
checkpoints derive from these dataclasses.

A setting's public name is its field's name, with the group's name before it where the group is nested:
`beta`, `num_worlds`, `reward_network.hidden_size`.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any, Iterator, Mapping, get_type_hints

from dae_ros.errors import SettingsError


def setting(default, help_text: str, *, unit: str = '', minimum=None, maximum=None, choices: tuple[str, ...] = ()):
    """A dataclass field that knows its help, unit, range and choices."""
    metadata = {'help': help_text, 'unit': unit, 'minimum': minimum, 'maximum': maximum, 'choices': choices}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class TaskSettings:
    """What is simulated. World and trainer need it."""

    task: str = setting('navigation', "navigation, formation, line, matrix_game, particle:MODULE for a task of robots in the "
                                      "plane of your own, pettingzoo:MODULE for a PettingZoo parallel environment with discrete "
                                      "actions, e.g. pettingzoo:mpe2.simple_spread_v3, or smax:MAP and smac:MAP for battles, "
                                      "e.g. smax:2s3z")
    num_agents: int = setting(3, 'robots of the team (N)', unit='robots', minimum=1, maximum=1000)
    num_worlds: int = setting(128, 'worlds simulated side by side (W); a real team has 1', unit='worlds',
                              minimum=1, maximum=65536)
    world_groups: int = setting(1, 'groups of equal size the worlds are split into; each has a world and agents of its own, on '
                                   'any host', unit='groups', minimum=1, maximum=1024)
    episode_steps: int = setting(0, 'steps after which an episode ends; 0 takes the task\'s own (25 in the particle tasks, '
                                    'N in the matrix game)', unit='steps', minimum=0, maximum=1_000_000)
    observe_others: bool = setting(False, 'formation and line: each robot also observes the other robots\' relative positions')
    reward_delay: int = setting(0, 'steps after which a reward is paid; what is still owed at an episode\'s end is paid with its '
                                   'last step. Built-in tasks only', unit='steps', minimum=0, maximum=1_000_000)

    def __post_init__(self):
        if self.num_worlds % self.world_groups:
            raise SettingsError(f'num_worlds = {self.num_worlds} worlds cannot be split into world_groups = {self.world_groups} '
                                'groups of equal size')

    @property
    def worlds_per_group(self) -> int:
        """How many worlds one group simulates."""
        return self.num_worlds // self.world_groups


@dataclass(frozen=True)
class RewardNetworkSettings:
    """The learnt reward behind the credit (paper section 3.3), unused at beta = 0; with COMA its action values instead."""

    architecture: str = setting('per_agent', 'the paper\'s network, recurrent for each agent, or one recurrent pass per world '
                                             'that tells what each agent\'s action adds; not for delayed rewards',
                                choices=('per_agent', 'shared_trunk'))
    hidden_size: int = setting(128, 'width of the reward network', unit='units', minimum=1, maximum=4096)
    trunk_size: int = setting(96, 'width of the recurrent layer of shared_trunk', unit='units', minimum=1, maximum=4096)
    recurrent: bool = setting(True, 'the reward network remembers earlier steps of the episode, which delayed rewards depend on')
    ensemble_size: int = setting(1, 'networks averaged: 1 as in the paper, 2 as in its authors\' code', minimum=1, maximum=16)
    learning_rate: float = setting(7e-4, 'step size of the reward network\'s Adam', minimum=0.0, maximum=1.0)
    epochs: int = setting(10, 'passes over a rollout per update', minimum=1, maximum=1000)
    replay_rollouts: int = setting(0, 'newest rollouts the reward network learns from, by replay_steps steps per update instead '
                                      'of epochs; 0 takes the last alone. They are part of every checkpoint',
                                   unit='rollouts', minimum=0, maximum=100_000)
    replay_steps: int = setting(40, 'gradient steps per update on replayed rollouts', unit='steps', minimum=1, maximum=100_000)
    replay_chunks: int = setting(64, 'chunks drawn for each of these steps', unit='chunks', minimum=1, maximum=1_000_000)
    learns_first: bool = setting(False, 'learn from a rollout before its credit is told: of use sooner, and biased a little, as '
                                        'each agent\'s own action is then among what was learnt from')
    path: str = setting('', 'file of train_reward with the reward networks to begin with; empty for untrained ones. A run '
                            'that is resumed no longer reads it')
    freeze: bool = setting(False, 'keep the reward networks as they are in the file that path names')


@dataclass(frozen=True)
class LearnerSettings:
    """Recurrent MAPPO with DAE. Only the trainer needs it. Defaults: the paper's appendix C and its authors' code."""

    estimator: str = setting('dae', 'advantages: DAE (at beta 0 GAE, which is plain MAPPO), the counterfactual ones of COMA, or '
                                    'those with the first rewards as they were', choices=('dae', 'coma', 'coma_nstep'))
    coma_steps: int = setting(5, 'rewards that stand for the action value in coma_nstep (n of eq. 41)', unit='steps', minimum=1,
                              maximum=1000)
    beta: float = setting(0.95, 'credit against bias: 0 is GAE (plain MAPPO), 1 difference rewards', minimum=0.0, maximum=1.0)
    gamma: float = setting(0.99, 'discount per step', minimum=0.0, maximum=1.0)
    gae_lambda: float = setting(0.95, 'bias against variance of the advantages (lambda of GAE)', minimum=0.0, maximum=1.0)
    value_target: str = setting('difference', 'what the critic regresses on: A + V with the credit baseline subtracted, as '
                                              'in the authors\' code, or the plain lambda return, as in the paper\'s appendix B',
                                choices=('difference', 'gae'))
    hidden_size: int = setting(64, 'width of actor and critic', unit='units', minimum=1, maximum=4096)
    mlp_layers: int = setting(2, 'hidden layers before the recurrent one in actor and critic', minimum=1, maximum=8)
    activation: str = setting('relu', 'activation of actor and critic', choices=('relu', 'tanh'))
    learning_rate: float = setting(7e-4, 'step size of Adam for actor and critic', minimum=0.0, maximum=1.0)
    adam_epsilon: float = setting(1e-5, 'epsilon of Adam', minimum=1e-12, maximum=1.0)
    epochs: int = setting(10, 'passes over a rollout per update', minimum=1, maximum=1000)
    num_mini_batches: int = setting(1, 'parts a rollout is split into per epoch', minimum=1, maximum=1024)
    chunk_length: int = setting(10, 'steps backpropagated through time', unit='steps', minimum=1, maximum=10_000)
    clip: float = setting(0.2, 'clip range of the probability ratio and of the value', minimum=0.0, maximum=10.0)
    entropy_coefficient: float = setting(0.01, 'weight of the entropy bonus', minimum=0.0, maximum=10.0)
    value_coefficient: float = setting(1.0, 'weight of the value loss', minimum=0.0, maximum=100.0)
    huber_delta: float = setting(10.0, 'where the value loss turns from quadratic to linear, on normalised values',
                                 minimum=1e-6, maximum=1e6)
    max_gradient_norm: float = setting(10.0, 'gradients longer than this are shortened, per network', minimum=1e-6, maximum=1e9)
    device: str = setting('auto', 'where the learner computes; auto takes the GPU if there is one and it is the faster',
                          choices=('auto', 'cpu', 'cuda'))
    learner_threads: int = setting(0, 'processor threads of the learner; 0 takes all cores. The weights do not depend on it',
                                   minimum=0, maximum=1024)


@dataclass(frozen=True)
class RunSettings:
    """How long a run is and what it leaves. Only the trainer needs it."""

    seed: int = setting(1, 'seed of the run: same seed, same weights', minimum=0, maximum=2**63 - 1)
    total_steps: int = setting(1_000_000, 'environment steps to train for, all worlds together', unit='steps',
                               minimum=1, maximum=10**12)
    num_steps: int = setting(25, 'steps of a rollout (T); every rollout begins with new episodes', unit='steps',
                             minimum=1, maximum=1000)
    rollout_timeout: float = setting(30.0, 'without any message for this long a rollout is begun anew', unit='s',
                                     minimum=0.1, maximum=86_400.0)
    evaluation_episodes: int = setting(512, 'fresh episodes played with the trained team at the end; 0 for none',
                                       unit='episodes', minimum=0, maximum=1_000_000)
    evaluation_greedy: bool = setting(True, 'evaluate with each robot\'s most probable action instead of a drawn one')
    checkpoint_interval: int = setting(1, 'updates between checkpoints', unit='updates', minimum=1, maximum=1_000_000)
    keep_checkpoints: int = setting(3, 'newest checkpoints and policy versions kept on disk', minimum=1, maximum=1_000_000)
    max_restarts: int = setting(5, 'times in a row, with nothing learnt in between, that a node which died is started again',
                                minimum=0, maximum=1_000_000)
    max_silent_attempts: int = setting(20, 'attempts in a row at a rollout that fell silent before its end, after which the '
                                           'trainer gives up', minimum=1, maximum=1_000_000)
    robots_per_process: int = setting(0, 'robots of a group whose agents share a process of bringup\'s or ros2 launch\'s; 0 for '
                                         'all. The weights do not depend on it', unit='robots', minimum=0, maximum=1000)
    silence_timeout: float = setting(300.0, 'a node that has given no sign of life for this long, longer than any update takes, '
                                            'is replaced by bringup', unit='s', minimum=1.0, maximum=86_400.0)
    keep_every: int = setting(1000, 'checkpoints of every so many updates are kept for good; 0 for none', unit='updates',
                              minimum=0, maximum=1_000_000)


@dataclass(frozen=True)
class Settings:
    """All settings of a run, by group. `flatten` gives them by their public names."""

    task: TaskSettings = field(default_factory=TaskSettings)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    reward_network: RewardNetworkSettings = field(default_factory=RewardNetworkSettings)
    run: RunSettings = field(default_factory=RunSettings)


@dataclass(frozen=True)
class RunBinding:
    """Which run a node belongs to. Every node but the trainer, which begins the run, has it."""

    run: int = setting(0, 'identity of the run to belong to; 0 joins the first run heard of', minimum=0, maximum=2**63 - 1)


@dataclass(frozen=True)
class GroupBinding:
    """Which group a node belongs to. Worlds and agents have it."""

    group: int = setting(0, 'group of worlds the node belongs to, from 0', minimum=0, maximum=1023)


@dataclass(frozen=True)
class TeamKey:
    """Whose policies are taken. Trainer, parameter server and agents have it."""

    key_file: str = setting('', 'file with the key that policies are signed with, the same for trainer, parameter server and '
                                'agents; empty for none')


@dataclass(frozen=True)
class AgentSettings:
    """What is particular to one agent."""

    robot: int = setting(0, 'index of the robot this agent acts for, from 0', minimum=0, maximum=65535)
    robots: int = setting(1, 'robots this process acts for, from that one on; if several, each by a node of its own, named '
                             'agent_<robot>, or agent_<group>_<robot> where there are groups', unit='robots', minimum=1,
                          maximum=1000)


@dataclass(frozen=True)
class ExecutionSettings:
    """How a robot's agent acts once the team is trained."""

    execute: bool = setting(False, 'act as a trained team does: on whatever is observed, with no trainer and no world')
    policy_file: str = setting('', 'safetensors file with the policy to execute; empty takes what the parameter server has')
    greedy: bool = setting(True, 'take the most probable action instead of drawing one')


@dataclass(frozen=True)
class BodySettings:
    """How the task's plane lies in the robots' world, and what a robot of the team can do. Bridges and our own simulator, when
    it plays the robots, share them."""

    world_frame: str = setting('map', 'frame_id of the odometry and the landmarks of the whole team')
    control_rate: float = setting(10.0, 'steps of the task per second; the simulated ones have 10. At another rate the policy '
                                        'lives faster or slower', unit='Hz', minimum=0.1, maximum=1000.0)
    scale: float = setting(1.0, 'metres that the robots see as one unit of the task', unit='m', minimum=1e-6, maximum=1e6)
    origin_x: float = setting(0.0, 'where the task has its origin in the world frame', unit='m', minimum=-1e9, maximum=1e9)
    origin_y: float = setting(0.0, 'where the task has its origin in the world frame', unit='m', minimum=-1e9, maximum=1e9)
    drive: str = setting('differential', 'how the robot moves', choices=('differential', 'holonomic'))
    max_speed: float = setting(0.5, 'highest speed', unit='m/s', minimum=1e-3, maximum=100.0)
    max_acceleration: float = setting(2.0, 'highest acceleration; a stop is not limited by it', unit='m/s^2', minimum=1e-3,
                                      maximum=1000.0)
    max_turn_rate: float = setting(2.5, 'fastest turning of a differential robot', unit='rad/s', minimum=1e-3, maximum=100.0)
    max_turn_acceleration: float = setting(10.0, 'highest angular acceleration of a differential robot', unit='rad/s^2',
                                           minimum=1e-3, maximum=10_000.0)
    stamped: bool = setting(False, 'cmd_vel is a TwistStamped instead of a Twist')


@dataclass(frozen=True)
class RobotWorldSettings:
    """How our own simulator plays the robots."""

    real_time_factor: float = setting(0.0, 'play the robots of one team, so many times as fast as real ones; other than 1 the '
                                           'world publishes /clock, and all others need use_sim_time. 0 simulates in lockstep',
                                      minimum=0.0, maximum=1000.0)
    odometry_rate: float = setting(20.0, 'odometry per simulated second', unit='Hz', minimum=1.0, maximum=1000.0)
    reset_episodes: bool = setting(False, 'put robots and landmarks elsewhere whenever an episode begins')


@dataclass(frozen=True)
class BridgeSettings:
    """What lets a robot move, and what makes it stop."""

    enabled: bool = setting(False, 'whether the robot may move from the start, without the service ~/enable')
    landmarks: str = setting('', 'where the landmarks are, "x y, x y, ..." in m; empty takes the topic')
    odometry_timeout: float = setting(0.15, 'the robot stops when its own odometry is older', unit='s', minimum=1e-3,
                                      maximum=60.0)
    teammate_hold: float = setting(1.0, 'a team mate that falls silent counts as where it was last for so long', unit='s',
                                   minimum=1e-3, maximum=3600.0)
    on_lost_team_mate: str = setting('stop', 'when a team mate has not been heard of for teammate_hold: stop until it is '
                                             'back, or go on with it where it was last', choices=('stop', 'go_on'))
    action_timeout: float = setting(0.25, 'the robot stops when its agent does not answer for longer', unit='s', minimum=1e-3,
                                    maximum=60.0)
    jump_distance: float = setting(0.3, 'odometry further than this from where the robot can be at jump_speed is refused',
                                   unit='m', minimum=0.0, maximum=1e6)
    jump_speed: float = setting(5.0, 'a change of position faster than this is no motion', unit='m/s', minimum=1e-3,
                                maximum=1e6)


@dataclass(frozen=True)
class RobotBagSettings:
    """Where a bag of robots, without any message of ours, has what. Only train_reward needs it."""

    odometry_topic: str = setting('robot_{}/odom', "a robot's odometry in a bag, {} for its index; or the topics of all "
                                                   'robots with blanks between them')
    command_topic: str = setting('robot_{}/cmd_vel', 'the velocities a robot was told, likewise; Twist or TwistStamped')
    landmarks_topic: str = setting('landmarks', 'where the landmarks are, in a bag')


@dataclass(frozen=True)
class ParameterServerSettings:
    """What is particular to the parameter server."""

    policies_folder: str = setting('runs/policies', 'folder the policy versions are kept in')
    keep_policies: int = setting(3, 'newest policy versions kept on disk', minimum=1, maximum=1_000_000)


@dataclass(frozen=True)
class RecorderSettings:
    """What is particular to the recorder."""

    bag: str = setting('', 'folder of the bag, which must not exist yet; empty takes bags/<time>. Where it is split, _0, _1, ... '
                           'follow the name')
    storage: str = setting('mcap', 'format of the bag', choices=('mcap', 'sqlite3'))
    compression: str = setting('none', 'compression of the bag', choices=('none', 'zstd'))
    split_megabytes: int = setting(0, 'a new bag is begun after so much data, before compression; 0 for never', unit='MB',
                                   minimum=0, maximum=1_000_000_000)
    split_seconds: int = setting(0, 'a new bag is begun after this long; 0 for never', unit='s', minimum=0, maximum=1_000_000_000)
    everything: bool = setting(False, 'also record observations and policies, which neither a replay to a trainer nor reward '
                                      'training needs')


@dataclass(frozen=True)
class StreamSettings:
    """How the trainer takes what robots do at their own rate."""

    max_staleness: int = setting(2, 'updates that the policy of an action may be behind', unit='updates', minimum=0,
                                 maximum=1_000_000)


@dataclass(frozen=True)
class TrainerSettings:
    """What is particular to the trainer."""

    run_folder: str = setting('', 'folder for settings, metrics, checkpoints and policy; empty takes '
                                  'runs/<task>_n<robots>_seed<seed>. A folder with a checkpoint of the same run resumes it')
    watched_world: int = setting(-1, 'world whose robots\' credit is published after each update, on robot_<i>/credit; '
                                     '-1 for none', minimum=-1, maximum=65535)


@dataclass(frozen=True)
class CreditSettings:
    """Whose credit is told without a trainer, and by what."""

    reward_network_file: str = setting('', 'file of train_reward with the reward networks that tell')
    world: int = setting(0, 'world that is watched, of those side by side; a real team has only world 0', minimum=0,
                         maximum=65535)


@dataclass(frozen=True)
class RewardTrainingSettings:
    """How a reward network is trained from bags. Only train_reward needs it, beside those of the reward network."""

    held_out: float = setting(0.1, 'share of the episodes that are not learnt from but measured on', minimum=0.001, maximum=0.999)
    max_epochs: int = setting(100, 'most passes over the bags', unit='epochs', minimum=1, maximum=1_000_000)
    patience: int = setting(5, 'passes without a smaller held-out error after which it ends', unit='epochs', minimum=1,
                            maximum=1_000_000)
    batch_chunks: int = setting(64, 'chunks of a gradient step', unit='chunks', minimum=1, maximum=1_000_000)
    pool_chunks: int = setting(4096, 'chunks held in memory and mixed with each other', unit='chunks', minimum=1,
                               maximum=100_000_000)


NESTED_GROUPS = ('reward_network',)


class SettingInfo:
    """One setting's declaration: where it lives and what it may be."""

    def __init__(self, group: str, declared: dataclasses.Field, kind: type):
        self.group = group
        self.attribute = declared.name
        self.name = f'{group}.{declared.name}' if group in NESTED_GROUPS else declared.name
        self.kind = kind
        self.default = declared.default
        self.help = declared.metadata['help']
        self.unit = declared.metadata['unit']
        self.minimum = declared.metadata['minimum']
        self.maximum = declared.metadata['maximum']
        self.choices = declared.metadata['choices']

    def check(self, value: Any) -> Any:
        """`value` as this setting's type; an integer is a fine float, nothing else is converted.

        Raises SettingsError naming the setting, the value and what is allowed.
        """
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.kind:
            raise SettingsError(f'{self.name} must be {_ARTICLES[self.kind]}, not {value!r}')
        if self.choices and value not in self.choices:
            raise SettingsError(f'{self.name} must be one of {", ".join(self.choices)}, not {value!r}')
        if self.minimum is not None and not self.minimum <= value <= self.maximum:
            raise SettingsError(f'{self.name} must lie in {self.minimum} .. {self.maximum}, not {value!r}')
        return value

    def describe(self) -> str:
        """Help text with unit and choices, as ROS parameter descriptions and `--help` show it."""
        unit = f' [{self.unit}]' if self.unit else ''
        choices = f' ({" | ".join(self.choices)})' if self.choices else ''
        return f'{self.help}{unit}{choices}'


_ARTICLES = {int: 'an integer', float: 'a number', bool: 'true or false', str: 'a text'}


def declarations(*groups: type) -> Iterator[SettingInfo]:
    """The declarations in the given dataclasses, in their order."""
    names = {kind: name for name, kind in get_type_hints(Settings).items()}
    for group in groups:
        kinds = get_type_hints(group)
        for declared in dataclasses.fields(group):
            yield SettingInfo(names.get(group, ''), declared, kinds[declared.name])


SETTINGS: dict[str, SettingInfo] = {info.name: info for info in declarations(*get_type_hints(Settings).values())}
"""Those of a run, which a task file may set."""

ROBOT_SETTINGS: dict[str, SettingInfo] = {
    info.name: info for info in declarations(ExecutionSettings, BodySettings, RobotWorldSettings, BridgeSettings,
                                             RobotBagSettings, StreamSettings)}
"""Those of trained teams on robots; a task file may set them too, each node takes its own."""


def unknown_setting(name: str, known: Mapping[str, Any] | tuple[str, ...]) -> SettingsError:
    """The error for a key nobody declared, with the nearest name there is."""
    near = difflib.get_close_matches(name, list(known), n=1)
    hint = f'; did you mean {near[0]!r}?' if near else ''
    return SettingsError(f'unknown setting {name!r}{hint}')


def from_flat(values: Mapping[str, Any], base: Settings = Settings()) -> Settings:
    """`base` with `values`, given by public names, put in. Raises SettingsError on an unknown key or a bad value."""
    changed: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in SETTINGS:
            raise unknown_setting(name, SETTINGS)
        info = SETTINGS[name]
        changed.setdefault(info.group, {})[info.attribute] = info.check(value)
    groups = {group: dataclasses.replace(getattr(base, group), **fields) for group, fields in changed.items()}
    return dataclasses.replace(base, **groups)


def check_group(group: int, world_groups: int) -> None:
    """Raises SettingsError if there is no such group."""
    if group >= world_groups:
        raise SettingsError(f'group must lie in 0 .. {world_groups - 1} where world_groups is {world_groups}, not {group}')


def flatten(settings: Settings) -> dict[str, Any]:
    """Every setting by its public name."""
    return {name: getattr(getattr(settings, info.group), info.attribute) for name, info in SETTINGS.items()}


def digest(settings: Settings) -> str:
    """SHA-256 of all settings: two runs with the same digest end with the same weights."""
    return hashlib.sha256(json.dumps(flatten(settings), sort_keys=True).encode()).hexdigest()
