"""Decentralised execution: one robot's agent acts on whatever it observes, without trainer, world or any other agent."""

from __future__ import annotations

import numpy as np

from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, choose
from dae_ros.rollout.lockstep import check_observation, check_run, respond
from dae_ros.types import Action, Observation, Stamp


class ActingEnd:
    """Acts for one robot with its last good policy.

    A newer version takes over when an episode begins, or with the next observation after `activate`; either way with the
    recurrent state of nobody. `run` binds it to the policies of one run; 0 lets the first one heard bind it.
    """

    def __init__(self, robot: int, greedy: bool, seed: int, run: int = 0):
        self.robot = robot
        self.run = run
        self.version: int | None = None  # in use
        self._greedy = greedy
        self._seed = seed
        self._policy: Policy | None = None
        self._newer: tuple[int, Policy] | None = None
        self._state: np.ndarray | None = None
        self._last: Stamp | None = None

    @property
    def waiting_version(self) -> int | None:
        """The version that takes over at the next episode."""
        return None if self._newer is None else self._newer[0]

    def on_policy(self, run: int, version: int, policy: Policy) -> None:
        """Takes in a policy. Raises Refused on one of another run, an old one, or one for another kind of task."""
        check_run(run, self.run)
        newest = self.version if self._newer is None else self._newer[0]
        if newest is not None and version <= newest:
            raise Refused(Refused.DUPLICATE if version == newest else Refused.WRONG_VERSION,
                          f'policy version {version}, this agent has version {newest}')
        known = self._policy or (self._newer and self._newer[1])
        if known is not None and known.architecture[:2] != policy.architecture[:2]:
            raise Refused(Refused.WRONG_SHAPE, f'a policy of (features, actions) {policy.architecture[:2]}, this agent acts with '
                                               f'{known.architecture[:2]}')
        self.run, self._newer = run, (version, policy)

    def activate(self) -> int | None:
        """Begins with the newest policy at the next observation, wherever the episode is; its version, None if there is none."""
        if self._newer is not None:
            (self.version, self._policy), self._newer, self._state = self._newer, None, None
        return self.version

    def on_observation(self, observation: Observation) -> Action | None:
        """The action that answers the observation; None while there is no policy. Raises Refused."""
        check_observation(observation, self.robot)
        if len(observation.values) != 1:
            raise Refused(Refused.WRONG_SHAPE, f'{len(observation.values)} worlds, a robot has 1')
        stamp, start = observation.stamp, bool(observation.episode_start[0])
        if self._last is not None and stamp == self._last:
            raise Refused(Refused.DUPLICATE, f'{stamp.order} step {stamp.step}')
        if start or self._policy is None:
            self.activate()
        if self._policy is None:
            return None
        probabilities, self._state = respond(self._policy, observation, self._state)
        self._last = stamp
        actions = choose(probabilities, self._greedy, self._seed, stamp.rollout, stamp.step, self.robot)
        return Action(stamp, self.robot, self.version, actions, probabilities)
