"""What RViz shows of a team: robots, which way they head, the landmarks, and the places to cover."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from dae_ros.robots.bodies import Bodies
from dae_ros.ros.convert_robots import pose_message, time_message

ROBOT, HEADING, LANDMARK, TARGET = (ColorRGBA(r=r, g=g, b=b, a=a) for r, g, b, a in (
    (0.0, 0.45, 0.70, 1.0), (1.0, 1.0, 1.0, 1.0), (0.84, 0.37, 0.0, 1.0), (0.0, 0.62, 0.45, 0.35)))
HEIGHT = 0.5  # of a robot, in radii


def markers(bodies: Bodies, time: float, world_frame: str) -> MarkerArray:
    """The team as it stands, by namespaces `robots`, `headings`, `landmarks` and `targets`, so that each can be switched off."""
    radius = bodies.radius
    disc, flat, place = _size(2 * radius, HEIGHT * radius), _size(radius, 0.1 * radius), _size(2 * radius, 0.05 * radius)
    arrow = radius, 0.3 * radius, 0.3 * radius
    team = [
        *_group('robots', Marker.CYLINDER, bodies.positions, bodies.headings, disc, ROBOT),
        *_group('headings', Marker.ARROW, bodies.positions, bodies.headings, arrow, HEADING, HEIGHT * radius),
        *_group('landmarks', Marker.CYLINDER, bodies.landmarks, np.zeros(len(bodies.landmarks)), flat, LANDMARK),
        *_group('targets', Marker.CYLINDER, bodies.targets, np.zeros(bodies.num_robots), place, TARGET)]
    for marker in team:
        marker.header.frame_id, marker.header.stamp = world_frame, time_message(time)
    return MarkerArray(markers=team)


def _size(diameter: float, height: float) -> tuple[float, float, float]:
    return diameter, diameter, height


def _group(namespace: str, kind: int, positions: np.ndarray, headings: np.ndarray, size: tuple[float, float, float],
           colour: ColorRGBA, height: float = 0.0) -> list[Marker]:
    found = []
    for index, (position, heading) in enumerate(zip(positions, headings)):
        marker = Marker(ns=namespace, id=index, type=kind, action=Marker.ADD, pose=pose_message(position, float(heading)),
                        scale=Vector3(x=size[0], y=size[1], z=size[2]), color=colour)
        marker.pose.position.z = height
        found.append(marker)
    return found
