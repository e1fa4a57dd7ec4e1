"""robot: the agent and the bridge of a trained team's robot in one process, or those of several robots.

    ros2 run dae_ros robot --ros-args -p robot:=0 -p policy_file:=policy.safetensors
    ros2 run dae_ros robot --ros-args -p robots:=3 -p execute:=true
"""

from __future__ import annotations

import sys

from dae_ros_nodes.robot_agent import DECLARED as OF_AGENT
from dae_ros_nodes.robot_agent import RobotAgentNode
from dae_ros_nodes.robot_bridge import DECLARED as OF_BRIDGE
from dae_ros_nodes.robot_bridge import RobotBridgeNode, run_robots

from dae_ros.ros import names
from dae_ros.ros.node import TeamNode, check_names, settings_of_process


def make_robots() -> list[TeamNode]:
    """The nodes of the robots that the command line asks for, `agent_<robot>` and `bridge_<robot>`. Raises SettingsError."""
    asked = settings_of_process('robot', {info.name: info for info in (*OF_AGENT, *OF_BRIDGE)}.values())
    robots = range(asked['robot'], asked['robot'] + asked['robots'])
    agents: list[RobotAgentNode] = []
    for robot in robots:
        agents.append(RobotAgentNode(names.agent_node(robot, 0, 1), True, agents[0] if agents else None, robot=robot, robots=1))
    bridges = [RobotBridgeNode(names.BRIDGE_NODE.format(robot), agent, agents[0], robot=robot, robots=1)
               for robot, agent in zip(robots, agents)]
    check_names([*agents, *bridges], f'{len(agents) + len(bridges)} nodes')
    bridges[0].listen_for(bridges)
    return [*agents, *bridges]


def main(args: list[str] | None = None) -> int:
    return run_robots(make_robots, args)


if __name__ == '__main__':
    sys.exit(main())
