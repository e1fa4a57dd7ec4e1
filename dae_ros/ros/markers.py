"""What RViz and Foxglove show of a team, by namespaces, so that each can be switched off."""

from __future__ import annotations

from functools import partial
from typing import Callable, Iterable, Iterator

import numpy as np
from dae_ros_msgs import msg
from geometry_msgs.msg import Point, Vector3, Vector3Stamped
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from dae_ros.robots.scene import Scene
from dae_ros.ros import convert, names, qos
from dae_ros.ros.convert_robots import pose_message, time_message
from dae_ros.ros.node import TeamNode

ROBOT, HEADING, LANDMARK, TARGET, TRAIL, CONTACT, ACTION, CREDIT = (ColorRGBA(r=r, g=g, b=b, a=a) for r, g, b, a in (
    (0.0, 0.45, 0.70, 1.0), (1.0, 1.0, 1.0, 1.0), (0.84, 0.37, 0.0, 1.0), (0.0, 0.62, 0.45, 0.35), (0.0, 0.45, 0.70, 0.5),
    (0.80, 0.0, 0.0, 1.0), (0.95, 0.90, 0.25, 0.9), (0.0, 0.0, 0.0, 1.0)))
PERIOD = 0.1           # s between two displays
HEIGHT = 0.5           # of a robot, in radii
ARROW = 4.0            # radii of an arrow for an action that is certain
LEAST_PROBABLE = 0.02  # action that is shown


def markers(scene: Scene, time: float, world_frame: str) -> MarkerArray:
    """The team as it stands: `robots`, `headings`, `landmarks`, `targets`, `trails`, `contacts`, an arrow of `actions` for each
    direction a robot may accelerate in, as long as that is probable, and as `credit` its last difference reward in figures."""
    radius, robots = scene.radius, range(len(scene.trails))
    disc, flat, place = _size(2 * radius, HEIGHT * radius), _size(radius, 0.1 * radius), _size(2 * radius, 0.05 * radius)
    arrow = radius, 0.3 * radius, 0.3 * radius
    team = [
        *_group('robots', Marker.CYLINDER, scene.positions, scene.headings, disc, ROBOT),
        *_group('headings', Marker.ARROW, scene.positions, scene.headings, arrow, HEADING, HEIGHT * radius),
        *_group('landmarks', Marker.CYLINDER, scene.landmarks, np.zeros(len(scene.landmarks)), flat, LANDMARK),
        *_group('targets', Marker.CYLINDER, scene.targets, np.zeros(len(scene.targets)), place, TARGET),
        *(_points('trails', robot, Marker.LINE_STRIP, scene.trails[robot], 2, _size(0.15 * radius, 0.0), TRAIL)
          for robot in robots),
        _points('contacts', 0, Marker.SPHERE_LIST, scene.contacts, 1, _size(0.5 * radius, 0.5 * radius), CONTACT,
                HEIGHT * radius),
        *(marker for robot in robots for marker in _actions(scene, robot)),
        *(_credit(scene, robot, earned) for robot, earned in scene.earned.items())]
    for marker in team:
        marker.header.frame_id, marker.header.stamp = world_frame, time_message(time)
    return MarkerArray(markers=team)


class Display:
    """Publishes a node's scene as markers while somebody looks, and listens to what agents do and earn from then on."""

    def __init__(self, node: TeamNode, scene: Scene, world_frame: str, update: Callable[[float], bool]):
        """`update` brings the scene up to date for a time [s], and says whether it is to be shown."""
        self._node, self._scene, self._world_frame, self._update = node, scene, world_frame, update
        self._publisher = node.publisher(MarkerArray, names.MARKERS, qos.NEWEST)
        self._watched = False  # whether anybody ever looked
        node.every(PERIOD, self._show)

    def _show(self) -> None:
        if not self._publisher.get_subscription_count():
            return
        if not self._watched:
            self._watched = True
            self._listen()
        now = self._node.now()
        if self._update(now):
            self._publisher.publish(markers(self._scene, now, self._world_frame))

    def _listen(self) -> None:
        for robot in range(len(self._scene.trails)):
            self._node.listen(msg.Action, names.ACTION.format(robot), qos.EVENTS,
                              lambda message: self._scene.on_action(convert.action(message)))
            self._node.listen(Vector3Stamped, names.CREDIT.format(robot), qos.EVENTS, partial(self._on_credit, robot))

    def _on_credit(self, robot: int, message: Vector3Stamped) -> None:
        if np.isfinite(message.vector.y):
            self._scene.earned[robot] = message.vector.y


def _size(diameter: float, height: float) -> tuple[float, float, float]:
    return diameter, diameter, height


def _marker(namespace: str, index: int, kind: int, size: tuple[float, float, float], colour: ColorRGBA) -> Marker:
    return Marker(ns=namespace, id=index, type=kind, action=Marker.ADD, scale=Vector3(x=size[0], y=size[1], z=size[2]),
                  color=colour, pose=pose_message((0.0, 0.0)))


def _group(namespace: str, kind: int, positions: np.ndarray, headings: np.ndarray, size: tuple[float, float, float],
           colour: ColorRGBA, height: float = 0.0) -> list[Marker]:
    found = []
    for index, (position, heading) in enumerate(zip(positions, headings)):
        marker = _marker(namespace, index, kind, size, colour)
        marker.pose = pose_message(position, float(heading))
        marker.pose.position.z = height
        found.append(marker)
    return found


def _points(namespace: str, index: int, kind: int, places: Iterable[np.ndarray], needed: int, size: tuple[float, float, float],
            colour: ColorRGBA, height: float = 0.0) -> Marker:
    """A marker made of points, which is taken away where there are fewer than it needs."""
    marker = _marker(namespace, index, kind, size, colour)
    marker.points = [Point(x=float(x), y=float(y), z=height) for x, y in places]
    if len(marker.points) < needed:
        marker.action = Marker.DELETE
    return marker


def _actions(scene: Scene, robot: int) -> Iterator[Marker]:
    """An arrow for each direction."""
    begin, shaft, thoughts = scene.positions[robot], 0.2 * scene.radius, scene.thoughts(robot)
    for index, thought in enumerate(thoughts, robot * len(thoughts)):
        ends = [begin, begin + ARROW * scene.radius * thought] if np.abs(thought).max() >= LEAST_PROBABLE else []
        yield _points('actions', index, Marker.ARROW, ends, 2, (shaft, 2 * shaft, 0.0), ACTION, 2.0 * HEIGHT * scene.radius)


def _credit(scene: Scene, robot: int, earned: float) -> Marker:
    marker = _marker('credit', robot, Marker.TEXT_VIEW_FACING, (0.0, 0.0, scene.radius), CREDIT)
    marker.pose = pose_message(scene.positions[robot])
    marker.pose.position.z, marker.text = 4.0 * HEIGHT * scene.radius, f'{earned:+.3f}'
    return marker
