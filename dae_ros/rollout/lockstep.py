"""The two ends of lockstep collection, without ROS: the world steps when all actions are in, an agent acts when asked.

Both ends take in data one by one, in any order of arrival, and answer with the data to send. What does not belong is
refused by raising `Refused` and changes nothing. The nodes wire these objects to topics; `in_process` wires them to each
other, so a graph run and an in-process run are the same computation.
"""

from __future__ import annotations

from typing import Union

import numpy as np

from dae_ros import draws
from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, choose
from dae_ros.types import Action, JointState, Observation, RolloutRequest, SharedReward, Stamp
from dae_ros.worlds.base import JointObservation, Worlds

WorldDatum = Union[JointState, SharedReward, Observation]

PROBABILITY_SUM_TOLERANCE = 1e-3  # float32 softmax over any number of actions stays far within this
KEPT_VERSIONS = 2  # of a run's policy, beside the one in use
KEPT_RUNS = 4      # whose policies an agent keeps that does not know yet which run will ask it


def check_run(run: int, own_run: int) -> None:
    """Refuses data of another run; `own_run` 0 means none is known yet."""
    if run == 0 or own_run not in (0, run):
        raise Refused(Refused.WRONG_RUN, f'run {run:x}, this node belongs to run {own_run:x}')


def check_request(request: RolloutRequest, latest: RolloutRequest | None, own_run: int) -> None:
    """Refuses a request of another run, or one that the latest request taken in has superseded."""
    check_run(request.run, own_run)
    if latest is not None and request.order <= latest.order:
        raise Refused(Refused.DUPLICATE if request.order == latest.order else Refused.STALE,
                      f'request for {request.order}, the latest was for {latest.order}')


def check_stamp(stamp: Stamp, request: RolloutRequest | None, own_run: int) -> None:
    """Refuses a stamp that is not of the rollout under way."""
    check_run(stamp.run, own_run)
    if request is None:
        raise Refused(Refused.UNEXPECTED, f'rollout {stamp.rollout}, but none was requested yet')
    if stamp.order != request.order:
        raise Refused(Refused.STALE if stamp.order < request.order else Refused.UNEXPECTED,
                      f'{stamp.order}, under way is {request.order}')


def check_action(action: Action, num_agents: int, num_worlds: int, num_actions: int, policy_version: int,
                 available: np.ndarray | None = None) -> None:
    """Refuses an action no honest agent of this team can have sent. Shapes as in `types.Action`; available: [W, A] bool, as
    far as it is known."""
    if action.robot >= num_agents:
        raise Refused(Refused.WRONG_ROBOT, f'robot {action.robot} of a team of {num_agents}')
    if action.policy_version != policy_version:
        raise Refused(Refused.WRONG_VERSION, f'policy version {action.policy_version}, asked for {policy_version}')
    expected = (num_worlds, num_actions)
    if action.probabilities.shape != expected or action.actions.shape != (num_worlds,):
        raise Refused(Refused.WRONG_SHAPE, f'{action.probabilities.shape} probabilities and {action.actions.shape} actions, '
                                           f'expected {expected} and {expected[:1]}')
    least, most = action.probabilities.min(), action.probabilities.max()
    if not (np.isfinite(least) and np.isfinite(most)):  # nan is least and most of what it is among
        raise Refused(Refused.NOT_FINITE, 'a probability is not a finite number')
    if least < 0 or np.abs(action.probabilities.sum(1) - 1).max() > PROBABILITY_SUM_TOLERANCE:
        raise Refused(Refused.OUT_OF_RANGE, 'probabilities do not sum to 1')
    if action.actions.max() >= num_actions:
        raise Refused(Refused.OUT_OF_RANGE, f'action {action.actions.max()} of {num_actions}')
    if action.probabilities[np.arange(num_worlds), action.actions].min() <= 0:
        raise Refused(Refused.OUT_OF_RANGE, 'an action was chosen that has probability 0')
    if available is not None and action.probabilities[~available].any():
        raise Refused(Refused.OUT_OF_RANGE, 'an action that is not available has a probability')


def check_available(available: np.ndarray | None) -> None:
    """Refuses flags [..., A] that leave a robot nothing to do."""
    if available is not None and not available.any(axis=-1).all():
        raise Refused(Refused.OUT_OF_RANGE, 'a robot has no action it may choose')


def check_observation(observation: Observation, robot: int) -> None:
    """Refuses an observation that `robot` cannot act on."""
    if observation.robot != robot:
        raise Refused(Refused.WRONG_ROBOT, f'observation of robot {observation.robot}, this is robot {robot}')
    if not np.isfinite(observation.values).all():
        raise Refused(Refused.NOT_FINITE, 'an observation is not a finite number')
    check_available(observation.available)


def respond(policy: Policy, observation: Observation, state: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The policy's probabilities [W, A] and recurrent state [W, H], after `state`, None for nobody's. Raises Refused if the
    observation is not what it takes."""
    features, num_actions = policy.architecture.observation_size, policy.architecture.num_actions
    values, available = observation.values, observation.available
    if values.shape[1] != features:
        raise Refused(Refused.WRONG_SHAPE, f'{values.shape[1]} features, the policy takes {features}')
    if available is not None and available.shape[1] != num_actions:
        raise Refused(Refused.WRONG_SHAPE, f'{available.shape[1]} actions, the policy has {num_actions}')
    state = policy.initial_state(len(values)) if state is None else state
    return policy.act(values, state, observation.episode_start, available)


class WorldEnd:
    """Steps one group's batch of worlds through the rollouts it is asked for.

    `run` binds it to one run from the start; 0 lets it join the run of the first request it hears.
    """

    def __init__(self, worlds: Worlds, run: int = 0, group: int = 0):
        self._worlds = worlds
        self._group = group
        self.run = run
        self.request: RolloutRequest | None = None
        self._step = 0
        self._seen: JointObservation | None = None  # what the step under way began with
        self._actions: dict[int, np.ndarray] = {}

    @property
    def waiting_for(self) -> list[int]:
        """Robots whose action for the current step is missing; empty between rollouts. Nobody waits for a robot that has left
        its team in every world."""
        if self.request is None or self._step == self.request.num_steps:
            return []
        return [robot for robot in self._asked() if robot not in self._actions]

    def on_request(self, request: RolloutRequest) -> list[WorldDatum]:
        """Begins a rollout, or begins it anew; the data of its first step."""
        check_request(request, self.request, self.run)
        self.run, self.request, self._step = request.run, request, 0
        self._actions = {}
        return self._show(self._worlds.reset(draws.group_seed(request.seed, self._group), request.rollout))

    def on_action(self, action: Action) -> list[WorldDatum]:
        """Takes in one robot's action; with the last one missing, steps the worlds and gives what that did."""
        check_stamp(action.stamp, self.request, self.run)
        if action.stamp.step < self._step or action.robot in self._actions:
            raise Refused(Refused.DUPLICATE, f'robot {action.robot} already acted at step {action.stamp.step}')
        if action.stamp.step > self._step or self._step == self.request.num_steps:
            raise Refused(Refused.UNEXPECTED, f'step {action.stamp.step}, under way is step {self._step}')
        spec = self._worlds.spec
        available = None if self._seen.available is None or action.robot >= spec.num_agents else (
            self._seen.available[:, action.robot])
        check_action(action, spec.num_agents, self._worlds.num_worlds, spec.num_actions, self.request.policy_version, available)
        self._actions[action.robot] = action.actions
        return [] if self.waiting_for else self._advance()

    def _advance(self) -> list[WorldDatum]:
        """Steps the worlds with the actions there are; robots that have left everywhere do nothing."""
        joint = np.zeros((self._worlds.num_worlds, self._worlds.spec.num_agents), np.int64)
        for robot, actions in self._actions.items():
            joint[:, robot] = actions
        transition = self._worlds.step(joint)
        reward = SharedReward(self._stamp(), transition.reward, transition.terminated, transition.truncated,
                              transition.final_states, transition.won)
        self._step += 1
        self._actions = {}
        return [reward, *self._show(transition.next)]

    def _stamp(self) -> Stamp:
        return Stamp(self.run, self.request.rollout, self.request.attempt, self._step)

    def _show(self, seen: JointObservation) -> list[WorldDatum]:
        """The joint state for the trainer and, while the rollout lasts, each robot's observation.

        The agents come first: they are on the critical path, the trainer is not.
        """
        self._seen = seen
        stamp = self._stamp()
        joint = JointState(stamp, seen.episode_start, seen.observations, seen.state, seen.available, seen.present)
        if self._step == self.request.num_steps:
            return [joint]
        observations = [Observation(stamp, robot, self.request.policy_version, seen.episode_start,
                                    np.ascontiguousarray(seen.observations[:, robot]),
                                    None if seen.available is None else seen.available[:, robot],
                                    None if seen.present is None else seen.present[:, robot])
                        for robot in self._asked()]
        return [*observations, joint]

    def _asked(self) -> list[int]:
        """Robots that have a say in the step under way: those that have not left their team in every world."""
        present = self._seen.present
        return [robot for robot in range(self._worlds.spec.num_agents) if present is None or present[:, robot].any()]


class AgentEnd:
    """Acts for one robot of one group: only on the rollout asked for, only with the version it names, each step once.

    `run` as for `WorldEnd`: until a request tells its run, policies of several may come, and observations.
    """

    def __init__(self, robot: int, run: int = 0, group: int = 0):
        self.robot = robot
        self._group = group
        self.run = run
        self.request: RolloutRequest | None = None
        self._policies: dict[tuple[int, int], Policy] = {}  # by run and version
        self._pending: Observation | None = None  # of the rollout under way, waiting for the policy it names
        self._early: Observation | None = None    # of a rollout whose request is still on its way
        self._next_step = 0
        self._state: np.ndarray | None = None

    @property
    def newest_version(self) -> int | None:
        """The newest policy version held."""
        return max((version for _, version in self._policies), default=None)

    @property
    def missing_version(self) -> int | None:
        """The version that the rollout under way names and this agent does not hold."""
        version = None if self.request is None else self.request.policy_version
        return version if (self.run, version) not in self._policies else None

    def on_request(self, request: RolloutRequest) -> Action | None:
        """Takes note of the rollout under way."""
        check_request(request, self.request, self.run)
        self.run, self.request, self._next_step, self._state, self._pending = request.run, request, 0, None, None
        self._policies = {key: policy for key, policy in self._policies.items() if key[0] == self.run}
        early = self._early
        if early is None or early.stamp.run == self.run and early.stamp.order > request.order:
            return None
        self._early = None
        return self.on_observation(early) if (early.stamp.run, early.stamp.order) == (self.run, request.order) else None

    def on_policy(self, run: int, version: int, policy: Policy) -> Action | None:
        """Takes in one version of the policy; the two newest and the one in use are kept."""
        check_run(run, self.run)
        if (run, version) in self._policies:
            raise Refused(Refused.DUPLICATE, f'policy version {version}')
        self._policies[run, version] = policy
        in_use = None if self.request is None else self.request.policy_version
        for old in self._versions(run)[:-KEPT_VERSIONS]:
            if old != in_use:
                del self._policies[run, old]
        if len(runs := dict.fromkeys(run for run, _ in self._policies)) > KEPT_RUNS:
            first = next(iter(runs))
            self._policies = {key: policy for key, policy in self._policies.items() if key[0] != first}
        return self._act()

    def _versions(self, run: int) -> list[int]:
        """Versions held of a run's policy, oldest first."""
        return sorted(version for of, version in self._policies if of == run)

    def on_observation(self, observation: Observation) -> Action | None:
        """The action that answers the observation, or None while the request or the policy it needs is on its way."""
        stamp = observation.stamp
        check_run(stamp.run, self.run)
        check_observation(observation, self.robot)
        request = self.request
        if request is None or stamp.order > request.order:
            self._early = observation
            return None
        check_stamp(stamp, request, self.run)
        if stamp.step < self._next_step or stamp.step > self._next_step and not _comes_back(observation):
            raise Refused(Refused.DUPLICATE if stamp.step < self._next_step else Refused.UNEXPECTED,
                          f'step {stamp.step}, expected step {self._next_step}')
        if observation.policy_version != request.policy_version:
            raise Refused(Refused.WRONG_VERSION, f'policy version {observation.policy_version}, the rollout asked for '
                                                 f'{request.policy_version}')
        if self._pending is not None:
            raise Refused(Refused.DUPLICATE, f'step {stamp.step}, whose observation waits for its policy')
        if self._state is not None and len(observation.values) != len(self._state):
            raise Refused(Refused.WRONG_SHAPE, f'{len(observation.values)} worlds, the rollout began with {len(self._state)}')
        self._pending = observation
        return self._act()

    def _act(self) -> Action | None:
        """Answers the pending observation once the policy it names is here."""
        pending, request = self._pending, self.request
        if pending is None or (self.run, pending.policy_version) not in self._policies:
            return None
        self._pending = None
        probabilities, self._state = respond(self._policies[self.run, pending.policy_version], pending, self._state)
        seed = draws.group_seed(request.seed, self._group)
        actions = choose(probabilities, request.greedy, seed, request.rollout, pending.stamp.step, self.robot)
        self._next_step = pending.stamp.step + 1
        return Action(pending.stamp, self.robot, pending.policy_version, actions, probabilities)


def _comes_back(observation: Observation) -> bool:
    """Whether nothing from before matters: where the robot is present, an episode begins. It was asked nothing while it was
    absent everywhere."""
    return observation.present is not None and bool(observation.episode_start[observation.present].all())
