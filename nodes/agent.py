"""agent: acts for a robot with the policy the parameter server hands out, or for several robots, each by a node of its own.

    ros2 run dae_ros agent --ros-args -p robot:=0 -r __node:=agent_0
    ros2 run dae_ros agent --ros-args -p robots:=3
    ros2 run dae_ros agent --ros-args -p robot:=0 -p policy_file:=policy.safetensors
"""

from __future__ import annotations

import sys

from dae_ros_msgs import msg, srv
from rclpy.topic_endpoint_info import TopicEndpointInfo

from dae_ros.config import (
    SETTINGS,
    AgentSettings,
    ExecutionSettings,
    GroupBinding,
    RunBinding,
    TeamKey,
    check_group,
    declarations,
)
from dae_ros.errors import Refused
from dae_ros.rollout.lockstep import AgentEnd, check_run
from dae_ros.ros import convert, names, qos
from dae_ros.ros.node import TeamNode, check_names, is_over, run_together, settings_of_process
from dae_ros.ros.trust import team_key
from dae_ros.types import Action
from dae_ros.weights.codec import open_weights

DECLARED = [*declarations(AgentSettings, GroupBinding, RunBinding, TeamKey), SETTINGS['world_groups']]
GUID_PREFIX = 12  # bytes of an endpoint's id that all endpoints of a process have in common


class AgentNode(TeamNode):
    """Wires an `AgentEnd` to the topics of its group."""

    def __init__(self, name: str = 'agent', **given: int):
        super().__init__(name, DECLARED, **given)
        robot, binding = self.settings['robot'], self.settings['run']
        self._group, self._world_groups = self.settings['group'], self.settings['world_groups']
        check_group(self._group, self._world_groups)
        self._end = AgentEnd(robot, binding, self._group)
        self._bound = binding != 0
        self._key = team_key(self, self.settings['key_file'])
        self._unsent: msg.Action | None = None
        self._fetching: int | None = None
        observation, action = (names.in_group(topic.format(robot), self._group, self._world_groups)
                               for topic in (names.OBSERVATION, names.ACTION))
        self._actions = self.publisher(msg.Action, action, qos.ROLLOUT)
        self._get_policy = self.create_client(srv.GetPolicy, names.GET_POLICY)
        self.listen(msg.PolicyWeights, names.POLICY, qos.LATCHED_INPUT, self._on_policy)
        self.listen(msg.TrainingStatus, names.TRAINING_STATUS, qos.LATCHED_INPUT, self._on_status)
        self._heard = {'trainer': self.listen(msg.RolloutRequest, names.ROLLOUT_REQUEST, qos.LATCHED_INPUT, self._on_request),
                       'world': self.listen(msg.Observation, observation, qos.LATCHED_INPUT, self._on_observation)}

    def on_matched(self) -> None:
        if self._unsent is not None and not self._not_listening():
            unsent, self._unsent = self._unsent, None
            self._actions.publish(unsent)

    def _not_listening(self) -> list[str]:
        """To whom an action would be lost: world and trainer, known by what they say; anybody else may listen or not."""
        listeners = processes(self.get_subscriptions_info_by_topic(self._actions.topic_name))
        return [who for who, heard in self._heard.items()
                if not listeners & processes(self.get_publishers_info_by_topic(heard.topic_name))]

    def _on_request(self, message: msg.RolloutRequest) -> None:
        try:
            self._act(self._end.on_request(convert.rollout_request(message)))
            self._fetching = None  # the server asked for an earlier attempt may have died
        finally:
            self._fetch_if_passed()

    def _on_observation(self, message: msg.Observation) -> None:
        self._act(self._end.on_observation(convert.observation(message)))

    def _on_policy(self, message: msg.PolicyWeights) -> None:
        weights = convert.policy_weights(message)
        check_run(weights.run, self._end.run)  # before the weights are looked at, which takes longer
        self._act(self._end.on_policy(weights.run, weights.version, open_weights(weights, self._key)))
        self._fetch_if_passed()

    def _fetch_if_passed(self) -> None:
        """Asks the parameter server for the version the rollout names if only newer ones will come by themselves."""
        wanted, newest = self._end.missing_version, self._end.newest_version
        if wanted is None or wanted == self._fetching or newest is None or newest < wanted:
            return
        self._fetching = wanted
        self._get_policy.call_async(srv.GetPolicy.Request(version=wanted)).add_done_callback(self._on_fetched)

    def _on_fetched(self, future) -> None:
        response, self._fetching = future.result(), None
        with self.refusing(names.GET_POLICY):
            if not response.success:
                raise Refused(Refused.WRONG_VERSION, response.message)
            self._on_policy(response.policy)

    def _on_status(self, message: msg.TrainingStatus) -> None:
        """An agent that joined the run it heard is free for the next one when that run is over."""
        if is_over(message) and message.run == self._end.run and not self._bound:
            self._end = AgentEnd(self._end.robot, group=self._group)

    def _act(self, action: Action | None) -> None:
        if action is None:
            return
        message = convert.action_message(action)
        if action.stamp.step == 0 and self._not_listening():
            self._unsent = message
        else:
            self._actions.publish(message)

    def diagnose(self):
        version = self._end.newest_version
        if version is None:
            sentence = 'waiting for a policy'
        elif self._unsent is not None:
            sentence = f'waiting for {" and ".join(self._not_listening())} to listen'
        else:
            sentence = 'acting'
        group = {'group': self._group} if self._world_groups > 1 else {}
        return sentence, {'run': f'{self._end.run:x}', **group, 'robot': self._end.robot, 'policy version': version}


def processes(endpoints: list[TopicEndpointInfo]) -> set[bytes]:
    """The processes that some endpoints belong to."""
    return {bytes(endpoint.endpoint_gid[:GUID_PREFIX]) for endpoint in endpoints}


def make_agents() -> list[TeamNode]:
    """The agents that the command line asks for: for a training, or of a trained team. Raises SettingsError."""
    asked = settings_of_process('agent', [*DECLARED, *declarations(ExecutionSettings), SETTINGS['seed']])
    first, count, group, world_groups = (asked[name] for name in ('robot', 'robots', 'group', 'world_groups'))
    make = AgentNode
    if asked['execute'] or asked['policy_file']:
        from dae_ros_nodes.robot_agent import RobotAgentNode

        make = RobotAgentNode
    if count == 1:
        return [make()]
    agents = [make(names.agent_node(robot, group, world_groups), robot=robot, robots=1) for robot in range(first, first + count)]
    check_names(agents, f'the agents of {count} robots')
    return agents


def main(args: list[str] | None = None) -> int:
    return run_together(make_agents, args)


if __name__ == '__main__':
    sys.exit(main())
