"""What the launch files share: their arguments, and the actions that start the processes `dae_ros.ros` describes.

Needs `launch` and `launch_ros`, which a full ROS installation has.
"""

from __future__ import annotations

from pathlib import Path
from typing import Callable

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dae_ros.restarts import Restarts, describe
from dae_ros.ros.graph import NodeProcess, node_environment
from launch import LaunchDescription

RESPAWN_DELAY = 2.0  # s
ARGUMENTS = {
    'policy': (None, 'a policy file, the name of one that comes with the package, or parameter_server for what that has'),
    'task_file': ('navigation', 'a task file, or the name of one in config/'),
    'namespace': ('', 'namespace of the team'),
    'run_folder': ('', 'where the run goes; default runs/<task file>-<time>'),
    'key_file': ('', 'file with the key the team signs its policies with'),
    'simulate': ('false', 'our simulator plays the robots'),
    'parameters': ('', 'settings to change: "seed:=2 beta:=1"'),
}


def description(names: tuple[str, ...], start: Callable[[dict[str, str]], list], **defaults: str) -> LaunchDescription:
    """A launch file with these of the `ARGUMENTS`; `start` makes its actions of their values."""
    declared = []
    for name in names:
        default, text = ARGUMENTS[name]
        declared.append(DeclareLaunchArgument(name, default_value=defaults.get(name, default), description=text))
    return LaunchDescription([*declared, OpaqueFunction(
        function=lambda context: start({name: LaunchConfiguration(name).perform(context) for name in names}))])


def nodes(processes: list[NodeProcess], settings_file: Path, namespace: str, max_restarts: int | None = None) -> list:
    """Processes that come back when they end. With `max_restarts`, all end when the trainer is done or one keeps dying."""
    restarts = None if max_restarts is None else Restarts(max_restarts)

    def end_all(name: str) -> Callable | None:
        def on_exit(event, _) -> Shutdown | None:
            if (name, event.returncode) == ('trainer', 0) or restarts.delay(name, event.returncode) is None:
                return Shutdown(reason=f'{name} {describe(event.returncode)}')

        return on_exit if restarts else None

    environment = [SetEnvironmentVariable(name, value) for name, value in node_environment().items()]
    return environment + [
        Node(package='dae_ros', executable=process.executable, namespace=namespace,
             name=None if process.several else process.name, parameters=[str(settings_file), dict(process.parameters)],
             output='screen', respawn=True, respawn_delay=RESPAWN_DELAY, on_exit=end_all(process.name))
        for process in processes]
