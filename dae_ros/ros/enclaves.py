"""Enclave policies for SROS 2: which topics and services each node of a team may use, and no other.

    python -m dae_ros.ros.enclaves --num-agents 3 --namespace red > red.policy.xml
    python -m dae_ros.ros.enclaves --execute navigation --simulate > robots.policy.xml
    ros2 security generate_artifacts -k keys -p red.policy.xml
"""

from __future__ import annotations

import argparse
from itertools import groupby
from typing import NamedTuple
from xml.etree import ElementTree

from dae_ros.ros import names
from dae_ros.ros.execution import FROM_SERVER, robots_together
from dae_ros.ros.recorded import rollout_topics, team_topics

OF_EVERY_NODE = ('/rosout', '/parameter_events')  # published by rclpy
TYPES = '~/get_type_description'                  # service by rclpy
PARAMETERS = ('~/describe_parameters', '~/get_parameters', '~/get_parameter_types', '~/list_parameters', '~/set_parameters',
              '~/set_parameters_atomically')      # services by rclpy
STATES = (names.JOINT_STATE, names.SHARED_REWARD)
SAID_BY_TRAINER = (names.ROLLOUT_REQUEST, names.TRAINING_STATUS)


class Access(NamedTuple):
    """What a node may do. Names are relative to the team's namespace, absolute, or the node's own with `~/`."""

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()


class Team(NamedTuple):
    """What decides which nodes there are and what they use: settings and arguments of `bringup` of these names, or a replay."""

    num_agents: int = 3
    world_groups: int = 1
    real_time_factor: float = 1.0
    watch: bool = False
    execute: str = ''
    stream: bool = False
    simulate: bool = False
    replay: bool = False

    def of_each(self, topic: str) -> tuple[str, ...]:
        """The robots' topics of this kind."""
        return tuple(topic.format(robot) for robot in range(self.num_agents))

    @property
    def clock(self) -> tuple[str, ...]:
        """Simulated time, where that is not the system's."""
        return (names.CLOCK,) if self.simulate and self.real_time_factor != 1.0 else ()

    @property
    def watched(self) -> tuple[str, ...]:
        """Where a trainer tells who earns what."""
        return self.of_each(names.CREDIT) if self.watch else ()


def team_access(team: Team) -> dict[str, Access]:
    """What each node of the team needs, by its name as `bringup` starts it, or by its own where it is started by hand."""
    graph = _replay if team.replay else _execution if team.execute else _stream if team.stream else _training
    nodes = {node: of._replace(publish=(*of.publish, names.DIAGNOSTICS, *OF_EVERY_NODE), reply=(*of.reply, *PARAMETERS, TYPES))
             for node, of in graph(team).items()}
    if team.execute:
        nodes['bringup'] = Access(OF_EVERY_NODE, (names.DIAGNOSTICS,), (TYPES,))
    elif not team.replay:
        nodes['bringup'] = Access((names.DIAGNOSTICS, *OF_EVERY_NODE), (names.DIAGNOSTICS, names.TRAINING_STATUS), (TYPES,))
    return nodes


def _training(team: Team) -> dict[str, Access]:
    """In lockstep."""
    observations, actions = team.of_each(names.OBSERVATION), team.of_each(names.ACTION)
    access, data = {}, []
    for group in range(team.world_groups):
        def own(*topics: str) -> tuple[str, ...]:
            return tuple(names.in_group(topic, group, team.world_groups) for topic in topics)

        world = f'world_{group}' if team.world_groups > 1 else 'world'
        access[world] = Access(own(*observations, *STATES), (*own(*actions), *SAID_BY_TRAINER))
        for robot in range(team.num_agents):
            access[names.agent_node(robot, group, team.world_groups)] = Access(
                own(actions[robot]), (*own(observations[robot]), names.POLICY, *SAID_BY_TRAINER), request=(names.GET_POLICY,))
        data += own(*STATES, *actions)
    return {**access, **_learning(team, *data), 'recorder': _recorder(team),
            **({'credit': _credit(team)} if team.world_groups == 1 else {})}


def _stream(team: Team) -> dict[str, Access]:
    """From robots that act at their own rate."""
    data = *STATES, *team.of_each(names.ACTION), *team.of_each(names.OBSERVATION)
    return {**_learning(team, *data), **_robots(team, (names.POLICY,)), 'recorder': _recorder(team)}


def _execution(team: Team) -> dict[str, Access]:
    """Of a trained team."""
    return _robots(team, (names.POLICY,) if team.execute == FROM_SERVER else ())


def _replay(team: Team) -> dict[str, Access]:
    """Of what rollouts are made of, to a training or a credit node."""
    topics = tuple(topic.name for topic in rollout_topics(team.num_agents, team.world_groups))
    return {'player': Access(topics, reply=('~/pause', '~/resume', '~/play_next')),
            'replay_trainer': Access((names.POLICY_UPDATE, names.TRAINING_STATUS, *team.watched), topics, (names.SAVE,)),
            **({'credit': _credit(team)} if team.world_groups == 1 else {})}


def _learning(team: Team, *data: str) -> dict[str, Access]:
    """Parameter server, and a trainer that hears these data."""
    return {'parameter_server': Access((names.POLICY,), (names.POLICY_UPDATE, names.TRAINING_STATUS), (names.GET_POLICY,)),
            'trainer': Access((names.POLICY_UPDATE, *SAID_BY_TRAINER, *team.watched), (*data, names.TRAINING_STATUS),
                              (names.PAUSE, names.RESUME, names.SAVE))}


def _robots(team: Team, policy: tuple[str, ...]) -> dict[str, Access]:
    """Agents and bridges, our simulator in the robots' place, and who watches them."""
    odometry, commands, actions, credit = (team.of_each(topic) for topic in
                                           (names.ODOMETRY, names.COMMAND, names.ACTION, names.CREDIT))
    access = {}
    if team.simulate:
        access['world'] = Access((*odometry, names.LANDMARKS, names.MARKERS, *team.clock, names.TRANSFORMS),
                                 (*commands, *actions, *credit), (names.NEXT_EPISODE,))
    for robot, (observation, action) in enumerate(zip(team.of_each(names.OBSERVATION), actions)):
        # Where our simulator plays the robots, agent and bridge share a process and hear each other without the network.
        asked, answered = ((), ()) if team.simulate else ((observation,), (action,))
        access[names.agent_node(robot, 0, 1)] = Access((action,), (*asked, *policy, *team.clock), (names.ACTIVATE_POLICY,))
        access[names.BRIDGE_NODE.format(robot)] = Access((commands[robot], observation),
                                                         (*odometry, names.LANDMARKS, *answered, *team.clock), (names.ENABLE,))
    access['task_monitor'] = Access((*STATES, names.MARKERS), (*odometry, names.LANDMARKS, *actions, *credit, *team.clock))
    access['credit'] = _credit(team)
    return access


def _credit(team: Team) -> Access:
    return Access(team.of_each(names.CREDIT), (*STATES, *team.of_each(names.ACTION), *team.clock))


def _recorder(team: Team) -> Access:
    return Access(subscribe=tuple(topic.name for topic in team_topics(team.num_agents, team.world_groups, everything=True)))


def policies(team: Team, namespace: str = '') -> str:
    """The policies of a team as `ros2 security` reads them: an enclave for each process, of its name, which is that of its node
    where it has one alone."""
    base = f'/{namespace.strip("/")}'.rstrip('/')
    policy = ElementTree.Element('policy', version='0.2.0')
    enclaves = ElementTree.SubElement(policy, 'enclaves')
    processes = [robots_together(range(robot, robot + 1), {}) for robot in range(team.num_agents)] if team.simulate else []
    process_of = {node: process.name for process in processes for node in process.nodes}
    for process, nodes in groupby(team_access(team).items(), lambda item: process_of.get(item[0], item[0])):
        enclave = ElementTree.SubElement(enclaves, 'enclave', path=f'{base}/{process}')
        profiles = ElementTree.SubElement(enclave, 'profiles')
        for node, access in nodes:
            _fill(ElementTree.SubElement(profiles, 'profile', ns=base or '/', node=node), base, node, access)
    ElementTree.indent(policy)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(policy, encoding="unicode")}\n'


def _fill(profile: ElementTree.Element, base: str, node: str, access: Access) -> None:
    """Puts a node's rights into its profile."""
    for kind, right, allowed in (('topic', 'publish', access.publish), ('topic', 'subscribe', access.subscribe),
                                 ('service', 'reply', access.reply), ('service', 'request', access.request)):
        if allowed:
            group = ElementTree.SubElement(profile, f'{kind}s', {right: 'ALLOW'})
            for name in (name.replace('~', node) for name in allowed):
                ElementTree.SubElement(group, kind).text = name if name.startswith('/') else f'{base}/{name}'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--num-agents', type=int, default=3)
    parser.add_argument('--world-groups', type=int, default=1)
    parser.add_argument('--real-time-factor', type=float, default=1.0, help='of the simulator, with --simulate')
    parser.add_argument('--namespace', default='')
    parser.add_argument('--watch', action='store_true', help='for bringup --watch, whatever the world')
    graph = parser.add_mutually_exclusive_group()
    graph.add_argument('--execute', default='', metavar='POLICY', help='for bringup --execute POLICY')
    graph.add_argument('--stream', action='store_true', help='for bringup --stream')
    graph.add_argument('--replay', action='store_true', help='for player, replay_trainer and credit')
    parser.add_argument('--simulate', action='store_true', help='for bringup --simulate, with --execute or --stream')
    arguments = vars(parser.parse_args())
    namespace, team = arguments.pop('namespace'), Team(**arguments)
    if team.simulate and not (team.execute or team.stream):
        parser.error('--simulate goes with --execute POLICY or --stream')
    if team.world_groups > 1 and (team.execute or team.stream):
        parser.error('robots that act at their own rate have no --world-groups')
    if team.watch and team.execute:
        parser.error('--watch goes with a trainer')
    print(policies(team, namespace), end='')


if __name__ == '__main__':
    main()
