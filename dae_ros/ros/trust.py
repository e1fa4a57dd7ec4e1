"""Whom a node believes: the key its team signs policies with, and whether strangers can reach it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Mapping

from rclpy.node import Node

from dae_ros.weights.signing import read_key

UNSIGNED = ('policies are not signed, and nodes beyond this host can reach this one: whoever they are, their weights would be '
            'taken. Set key_file, or ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST')


def team_key(node: Node, key_file: str) -> bytes | None:
    """The key in `key_file`, or None where the team has none, with a warning where that is dangerous. Raises SettingsError."""
    if key_file:
        return read_key(Path(key_file))
    if reaches_beyond_this_host(os.environ):
        node.get_logger().warning(UNSIGNED)
    return None


def reaches_beyond_this_host(environment: Mapping[str, str]) -> bool:
    """Whether ROS's variables let a node discover those of other hosts; ROS's own default does."""
    discovery_range = environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper()
    if discovery_range == 'OFF':
        return False
    if any(environment.get(name) for name in ('ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')):
        return True
    if discovery_range == 'SYSTEM_DEFAULT':  # then the profile decides
        return not Path(environment.get('FASTRTPS_DEFAULT_PROFILES_FILE', '')).stem.startswith('fastdds_this_host')
    return discovery_range != 'LOCALHOST' and environment.get('ROS_LOCALHOST_ONLY') != '1'
