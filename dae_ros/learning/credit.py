"""Who earns what, step by step: each robot's difference reward, r less its expectation over the robot's own action."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dae_ros.errors import Refused
from dae_ros.learning import advantages
from dae_ros.learning.reward_files import RewardNetworks
from dae_ros.rollout.lockstep import check_action
from dae_ros.types import Action, JointState, SharedReward, Stamp

MOST_OPEN = 64  # steps of which something is missing


class Credit(NamedTuple):
    """What happened in one world during T steps; in units of reward, by the networks as they were then."""

    rewards: np.ndarray             # [T] of the team
    differences: np.ndarray | None  # [T, N] r - E over a_i ~ pi_i of r; None where no reward network tells
    advantages: np.ndarray | None   # [T, N] not normalised; None where no critic tells


def credit_of_world(world: int, rewards: Tensor, expected: Tensor | None, estimated: Tensor) -> Credit:
    """The credit in one world of a rollout, of rewards [T, W], their expectations [T, W, N] and advantages [T, W, N]."""
    differences = None if expected is None else rewards[:, world, None] - expected[:, world]
    return Credit(*(None if part is None else part.cpu().numpy().copy()
                    for part in (rewards[:, world], differences, estimated[:, world])))


class _Step:
    """What has come of one step."""

    def __init__(self):
        self.joint: JointState | None = None
        self.reward: float | None = None
        self.actions: dict[int, Action] = {}


class CreditMeter:
    """Listens to one world of a team and tells the credit of each step once all of it is there, without a trainer.

    The reward networks are recurrent: after a hole in what was heard they say nothing until an episode begins.
    """

    def __init__(self, networks: RewardNetworks, world: int):
        self.steps, self.holes = 0, 0  # told, and passed over
        self._networks, self._world = networks, world
        self._open: OrderedDict[Stamp, _Step] = OrderedDict()
        self._last: Stamp | None = None  # the step told last, whose recurrent states and actions these are
        self._states: list[Tensor] = []
        self._taken = torch.zeros(1, 1, networks.spec.num_agents, dtype=torch.int64)

    def on_joint_state(self, joint: JointState) -> Credit | None:
        """Takes in the state of a step; what is complete with it. Raises Refused, as all that follow."""
        self._check_world(len(joint.state))
        if joint.state.shape[1] != self._networks.spec.state_size:
            raise Refused(Refused.WRONG_SHAPE, f'a state of {joint.state.shape[1]} numbers, the reward networks know '
                                               f'{self._networks.spec.state_size}')
        if not np.isfinite(joint.state[self._world]).all():
            raise Refused(Refused.NOT_FINITE, 'a state is not finite')
        self._step(joint.stamp).joint = joint
        return self._tell(joint.stamp)

    def on_action(self, action: Action) -> Credit | None:
        """Takes in a robot's action."""
        self._check_world(len(action.actions))
        spec = self._networks.spec
        check_action(action, spec.num_agents, len(action.actions), spec.num_actions, action.policy_version)
        self._step(action.stamp).actions[action.robot] = action
        return self._tell(action.stamp)

    def on_reward(self, shared: SharedReward) -> Credit | None:
        """Takes in the team's reward of a step."""
        self._check_world(len(shared.reward))
        reward = float(shared.reward[self._world])
        if not np.isfinite(reward):
            raise Refused(Refused.NOT_FINITE, 'a reward is not finite')
        self._step(shared.stamp).reward = reward
        return self._tell(shared.stamp)

    def _check_world(self, num_worlds: int) -> None:
        if self._world >= num_worlds:
            raise Refused(Refused.WRONG_SHAPE, f'{num_worlds} worlds, world {self._world} is watched')

    def _step(self, stamp: Stamp) -> _Step:
        if stamp not in self._open:
            self._open[stamp] = _Step()
            if len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)
        return self._open[stamp]

    def _tell(self, stamp: Stamp) -> Credit | None:
        """The credit of the step, if it is complete and what was before it is known."""
        step, joint = self._open[stamp], self._open[stamp].joint
        if joint is None or step.reward is None:
            return None
        robots = self._networks.spec.num_agents
        present = np.ones(robots, bool) if joint.present is None else joint.present[self._world]
        if any(present[robot] and robot not in step.actions for robot in range(robots)):
            return None
        del self._open[stamp]
        start = bool(joint.episode_start[self._world])
        if not start and (self._last is None or stamp != self._last._replace(step=self._last.step + 1)):
            self._last = None
            self.holes += 1
            return None
        self._last = stamp
        self.steps += 1
        difference = np.where(present, step.reward - self._expected(joint, step, start), 0.0)  # who has left had no choice
        return Credit(np.array([step.reward]), difference[None], None)

    @torch.no_grad()
    def _expected(self, joint: JointState, step: _Step, start: bool) -> np.ndarray:
        """E over a_i ~ pi_i of the predicted reward [N], and the networks' recurrent states for the step after."""
        spec, world = self._networks.spec, self._world
        taken, probabilities = torch.zeros_like(self._taken), torch.zeros(1, 1, spec.num_agents, spec.num_actions)
        for robot, action in step.actions.items():
            taken[..., robot] = int(action.actions[world])
            probabilities[..., robot, :] = torch.from_numpy(action.probabilities[world].copy())
        starts = torch.full((1, 1), start or not self._networks.recurrent)
        state = torch.from_numpy(joint.state[world].astype(np.float32)).view(1, 1, 1, -1)
        predictions, states = [], []
        for index, network in enumerate(self._networks.members):
            before = self._states[index] if self._states else torch.zeros(1, network.states_per_world(), network.hidden_size)
            inputs = network.inputs(state.expand(2, -1, -1, -1), torch.cat([self._taken, taken]), starts.expand(2, -1))[1:]
            predicted, after = network(inputs, before, starts, taken)
            predictions.append(predicted)
            states.append(after[0])
        self._states, self._taken = states, taken
        return advantages.expected_rewards(torch.stack(predictions).mean(0), probabilities)[0, 0].double().numpy()
