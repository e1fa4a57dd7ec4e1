"""Enclave policies for SROS 2: which topics and services each node of a team may use, and no other.

    python -m dae_ros.ros.enclaves --num-agents 3 --namespace red > red.policy.xml
    ros2 security generate_artifacts -k keys -p red.policy.xml
"""

from __future__ import annotations

import argparse
from typing import Iterable, NamedTuple
from xml.etree import ElementTree

from dae_ros.ros import names
from dae_ros.ros.recorded import team_topics

OF_EVERY_NODE = ('/rosout', '/parameter_events')  # published by rclpy
PARAMETERS = ('describe_parameters', 'get_parameters', 'get_parameter_types', 'list_parameters', 'set_parameters',
              'set_parameters_atomically')  # services by rclpy


class Access(NamedTuple):
    """What a node may do. Names are relative to the team's namespace or absolute."""

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()


def team_access(num_agents: int, world_groups: int) -> dict[str, Access]:
    """What each node of the team needs, by its name as `bringup` starts it."""
    def in_groups(*topics: str) -> tuple[str, ...]:
        return tuple(names.in_group(topic, group, world_groups) for group in range(world_groups) for topic in topics)

    robots = range(num_agents)
    observations, actions = ([topic.format(robot) for robot in robots] for topic in (names.OBSERVATION, names.ACTION))
    states = (names.JOINT_STATE, names.SHARED_REWARD)
    heard = (names.ROLLOUT_REQUEST, names.TRAINING_STATUS)
    access = {}
    for group in range(world_groups):
        mark = f'_{group}' if world_groups > 1 else ''

        def own(topics: Iterable[str]) -> tuple[str, ...]:
            return tuple(names.in_group(topic, group, world_groups) for topic in topics)

        access[f'world{mark}'] = Access(own([*observations, *states]), (*own(actions), *heard))
        for robot in robots:
            access[f'agent{mark}_{robot}'] = Access(own([actions[robot]]), (*own([observations[robot]]), names.POLICY, *heard),
                                                    request=(names.GET_POLICY,))
    access['parameter_server'] = Access((names.POLICY,), (names.POLICY_UPDATE, names.TRAINING_STATUS), (names.GET_POLICY,))
    access['trainer'] = Access((names.POLICY_UPDATE, *heard), (*in_groups(*states, *actions), names.TRAINING_STATUS),
                               (names.PAUSE, names.RESUME, names.SAVE))
    access['recorder'] = Access(subscribe=tuple(topic.name for topic in team_topics(num_agents, world_groups, everything=True)))
    nodes = {node: of._replace(publish=(*of.publish, names.DIAGNOSTICS, *OF_EVERY_NODE),
                               reply=(*of.reply, *(f'{node}/{service}' for service in (*PARAMETERS, 'get_type_description'))))
             for node, of in access.items()}
    nodes['bringup'] = Access((names.DIAGNOSTICS, *OF_EVERY_NODE), (names.DIAGNOSTICS, names.TRAINING_STATUS),
                              ('bringup/get_type_description',))
    return nodes


def policies(num_agents: int, world_groups: int, namespace: str = '') -> str:
    """The policies of a team as `ros2 security` reads them: an enclave for each node, named as the node is."""
    team = f'/{namespace.strip("/")}'.rstrip('/')
    policy = ElementTree.Element('policy', version='0.2.0')
    enclaves = ElementTree.SubElement(policy, 'enclaves')
    for node, access in team_access(num_agents, world_groups).items():
        enclave = ElementTree.SubElement(enclaves, 'enclave', path=f'{team}/{node}')
        profile = ElementTree.SubElement(ElementTree.SubElement(enclave, 'profiles'), 'profile', ns=team or '/', node=node)
        for kind, right, allowed in (('topic', 'publish', access.publish), ('topic', 'subscribe', access.subscribe),
                                     ('service', 'reply', access.reply), ('service', 'request', access.request)):
            if allowed:
                group = ElementTree.SubElement(profile, f'{kind}s', {right: 'ALLOW'})
                for name in allowed:
                    ElementTree.SubElement(group, kind).text = name if name.startswith('/') else f'{team}/{name}'
    ElementTree.indent(policy)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(policy, encoding="unicode")}\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--num-agents', type=int, default=3)
    parser.add_argument('--world-groups', type=int, default=1)
    parser.add_argument('--namespace', default='')
    arguments = parser.parse_args()
    print(policies(arguments.num_agents, arguments.world_groups, arguments.namespace), end='')


if __name__ == '__main__':
    main()
