"""The data that flow through a run, with their shapes; the axis letters mean the same everywhere.

Axes: T steps of a rollout, W parallel worlds, N agents, A actions, S features of the global state, O features of an
observation. Each class here but `WorldSpec` and `Trajectory` mirrors one message of `dae_ros_msgs`; `dae_ros.ros.convert`
is the only place that turns one into the other.
"""

from __future__ import annotations

from typing import Any, Callable, NamedTuple

import numpy as np


class WorldSpec(NamedTuple):
    """The sizes a task fixes; policies, critic and messages follow from them."""

    num_agents: int          # N
    num_actions: int         # A
    observation_size: int    # O
    state_size: int          # S
    state_is_observations: bool  # the state is the N observations one after another (S = N * O)
    has_wins: bool = False       # episodes are won or lost
    states_per_agent: bool = False  # the state is the agents' own states one after another; each is valued by its own

    @property
    def num_values(self) -> int:
        """How many states the critic values in a world, each of `state_size // num_values` features."""
        return self.num_agents if self.states_per_agent else 1


class Order(NamedTuple):
    """What supersedes what within a run: of two rollouts asked for, the greater one was asked for later.

    Attempts come first. They count what was begun anew, over the whole run and across the trainer's restarts, and never go
    down; so a trainer that comes back at an earlier rollout supersedes what is under way, and nothing from before does.
    """

    attempt: int
    rollout: int

    def __str__(self) -> str:
        return f'rollout {self.rollout} attempt {self.attempt}'


class Stamp(NamedTuple):
    """Where in a run a datum belongs."""

    run: int
    rollout: int
    attempt: int
    step: int

    @property
    def order(self) -> Order:
        return Order(self.attempt, self.rollout)


class Observation(NamedTuple):
    """What robot `robot` observes at a step, in all worlds."""

    stamp: Stamp
    robot: int
    policy_version: int
    episode_start: np.ndarray  # [W] bool
    values: np.ndarray         # [W, O] float32
    available: np.ndarray | None = None  # [W, A] bool: actions it may choose, one at least; None: all
    present: np.ndarray | None = None    # [W] bool: whether it has not left its team; None: it is there everywhere


class Action(NamedTuple):
    """What robot `robot` does at a step, in all worlds, and the distribution it drew from."""

    stamp: Stamp
    robot: int
    policy_version: int
    actions: np.ndarray        # [W] uint16
    probabilities: np.ndarray  # [W, A] float32


class JointState(NamedTuple):
    """What the trainer sees at a step, before the joint action."""

    stamp: Stamp
    episode_start: np.ndarray  # [W] bool
    observations: np.ndarray   # [W, N, O] float32
    state: np.ndarray          # [W, S] float32
    available: np.ndarray | None = None  # [W, N, A] bool: actions each robot may choose; None: all
    present: np.ndarray | None = None    # [W, N] bool: who has not left the team; None: all are there


class SharedReward(NamedTuple):
    """The team's reward for the joint action of a step, and the episodes that ended with it."""

    stamp: Stamp
    reward: np.ndarray         # [W] float32
    terminated: np.ndarray     # [W] bool: ended for good, no bootstrap
    truncated: np.ndarray      # [W] bool: cut off, bootstrap from the final state
    final_states: np.ndarray   # [K, S] float32: last states of the K truncated episodes, in the order of the worlds
    won: np.ndarray | None = None  # [W] bool: of the episodes that ended, those the team won; None: none


class RolloutRequest(NamedTuple):
    """The trainer's order for one rollout in lockstep."""

    run: int
    rollout: int
    attempt: int
    policy_version: int
    seed: int
    num_steps: int             # T
    greedy: bool

    @property
    def order(self) -> Order:
        return Order(self.attempt, self.rollout)


class PolicyWeights(NamedTuple):
    """One version of the decentralised policy as a safetensors file."""

    run: int
    version: int
    sha256: str
    data: bytes
    signature: str = ''        # empty where the team has no key


class Trajectory(NamedTuple):
    """One complete rollout, joined on the stamps; what the learner learns from."""

    observations: np.ndarray   # [T, W, N, O] float32
    states: np.ndarray         # [T + 1, W, S] float32
    episode_start: np.ndarray  # [T + 1, W] bool
    actions: np.ndarray        # [T, W, N] int64
    probabilities: np.ndarray  # [T, W, N, A] float32
    rewards: np.ndarray        # [T, W] float32
    terminated: np.ndarray     # [T, W] bool
    truncated: np.ndarray      # [T, W] bool
    final_states: np.ndarray   # [K, S] float32, in the order of np.argwhere(truncated)
    available: np.ndarray | None = None  # [T, W, N, A] bool: actions each agent may choose; None: all
    present: np.ndarray | None = None    # [T, W, N] bool: who has not left the team; None: all are there
    won: np.ndarray | None = None        # [T, W] bool: episodes that ended with a victory; None: none

    def map(self, change: Callable[[Any], Any]) -> Trajectory:
        """Every part that is there, changed."""
        return Trajectory(*(None if part is None else change(part) for part in self))
