"""The agent of a trained team's robot: acts with a policy from a file or the parameter server; nobody else is needed.

    ros2 run dae_ros agent --ros-args -p robot:=0 -p policy_file:=policy.safetensors
"""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

import numpy as np
from dae_ros_msgs import msg
from std_srvs.srv import Trigger

from dae_ros.config import SETTINGS, AgentSettings, ExecutionSettings, RunBinding, TeamKey, declarations
from dae_ros.robots.acting import ActingEnd
from dae_ros.ros import convert, names, qos
from dae_ros.ros.node import TeamNode
from dae_ros.ros.trust import team_key
from dae_ros.types import Action, Observation
from dae_ros.weights.codec import decode_policy, open_weights, read_file

DECLARED = [*declarations(AgentSettings, ExecutionSettings, RunBinding, TeamKey), SETTINGS['seed']]
FROM_FILE = 1, 0  # run and version of a policy whose file says neither
REMEMBERED = 1000  # answers whose times are shown


class RobotAgentNode(TeamNode):
    """Wires an `ActingEnd` to its robot's topics."""

    def __init__(self, name: str = 'agent', beside_bridge: bool = False, clock_of: TeamNode | None = None, **given: int):
        """`beside_bridge`: the robot's bridge is in this process and calls `answer` and `tell` itself."""
        super().__init__(name, DECLARED, clock_of, **given)
        robot, path = self.settings['robot'], self.settings['policy_file']
        self._topic = names.OBSERVATION.format(robot)
        self._end = ActingEnd(robot, self.settings['greedy'], self.settings['seed'], self.settings['run'])
        self._taken: deque[float] = deque(maxlen=REMEMBERED)
        self._actions = self.publisher(msg.Action, names.ACTION.format(robot), qos.ROLLOUT)
        if path:
            self._end.run = FROM_FILE[0]
            self._end.on_policy(*FROM_FILE, read_file(Path(path), decode_policy, 'policy_file', 'policy'))
        else:
            self._key = team_key(self, self.settings['key_file'])
            self.listen(msg.PolicyWeights, names.POLICY, qos.LATCHED_INPUT, self._on_policy)
        self.create_service(Trigger, names.ACTIVATE_POLICY, self._on_activate)
        if not beside_bridge:
            self.listen(msg.Observation, self._topic, qos.LATCHED_INPUT, self._on_observation)

    def answer(self, observation: Observation) -> Action | None:
        """The action; None while there is no policy, and where the observation is refused and counted."""
        began, action = time.perf_counter(), None
        with self.refusing(self._topic):
            action = self._end.on_observation(observation)
        if action is not None:
            self._taken.append(time.perf_counter() - began)
        return action

    def tell(self, action: Action) -> None:
        """Publishes what the robot does."""
        self._actions.publish(convert.action_message(action))

    def _on_observation(self, message: msg.Observation) -> None:
        began = time.perf_counter()
        action = self._end.on_observation(convert.observation(message))
        if action is not None:
            self.tell(action)
            self._taken.append(time.perf_counter() - began)

    def _on_policy(self, message: msg.PolicyWeights) -> None:
        weights = convert.policy_weights(message)
        self._end.on_policy(weights.run, weights.version, open_weights(weights, self._key))

    def _on_activate(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        version = self._end.activate()
        response.success = version is not None
        response.message = 'there is no policy yet' if version is None else f'acting with policy version {version}'
        return response

    def diagnose(self):
        end = self._end
        values = {'robot': end.robot, 'run': f'{end.run:x}', 'policy version': end.version, 'newer version': end.waiting_version}
        if self._taken:
            median, most = np.percentile(self._taken, (50, 99)) * 1e3
            values |= {'answer time, median [ms]': f'{median:.3f}', 'answer time, 99th percentile [ms]': f'{most:.3f}'}
        if end.version is None and end.waiting_version is None:
            return 'waiting for a policy', values
        return 'acting' if self._taken else 'waiting for an observation', values
