"""What RViz and Foxglove show of a team, and that the files that come with the package show all of it."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml
from harness import REPOSITORY
from visualization_msgs.msg import Marker

from dae_ros.errors import Refused
from dae_ros.robots.scene import TRAIL, Scene
from dae_ros.ros import names
from dae_ros.ros.markers import ARROW, markers
from dae_ros.types import Action, Stamp

PLACES = np.array([[0.0, 0.0], [0.3, 0.0], [1.0, 1.0]])  # m; the first two touch
RADIUS = 0.15


def show(scene, places=PLACES, landmarks=((0.5, 0.5),)):
    scene.show(np.array(places), np.zeros(3), np.array(landmarks), np.array(places) + 1.0)
    return {(marker.ns, marker.id): marker for marker in markers(scene, 1.0, 'map').markers}


def action(robot, *probabilities):
    chosen = np.array([np.argmax(probabilities)], np.uint16)
    return Action(Stamp(1, 0, 0, 0), robot, 0, chosen, np.array([probabilities], np.float32))


def points(marker):
    return [(point.x, point.y) for point in marker.points]


def test_robots_that_touch_have_a_contact_between_them_which_goes_when_they_part():
    scene = Scene(3, RADIUS)
    assert points(show(scene)['contacts', 0]) == [(0.15, 0.0)]
    assert show(scene, 2.0 * PLACES)['contacts', 0].action == Marker.DELETE


def test_a_trail_follows_its_robot_for_a_while_and_begins_anew_with_an_episode():
    scene = Scene(3, RADIUS)
    assert show(scene)['trails', 1].action == Marker.DELETE
    for step in range(TRAIL + 10):
        trail = points(show(scene, PLACES + [0.01 * step, 0.0])['trails', 1])
    assert len(trail) == TRAIL and trail[-1] == pytest.approx((0.3 + 0.01 * (TRAIL + 9), 0.0))
    assert show(scene, landmarks=[(0.0, 0.5)])['trails', 1].action == Marker.DELETE


def test_arrows_are_as_long_as_their_actions_are_probable():
    scene = Scene(3, RADIUS)
    scene.on_action(action(1, 0.2, 0.5, 0.0, 0.0, 0.3))
    shown = show(scene)
    ends = {index: points(marker) for (kind, index), marker in shown.items() if kind == 'actions' and marker.action == Marker.ADD}
    assert ends == {4: [(0.3, 0.0), (pytest.approx(0.3 + 0.5 * ARROW * RADIUS), 0.0)],
                    7: [(0.3, 0.0), (0.3, pytest.approx(-0.3 * ARROW * RADIUS))]}
    for wrong in (action(3, 1.0, 0.0, 0.0, 0.0, 0.0), action(0, 1.0, 1.0, 0.0, 0.0, 0.0), action(0, 1.0)):
        with pytest.raises(Refused):
            scene.on_action(wrong)


def test_what_a_robot_earned_stands_above_it():
    scene = Scene(3, RADIUS)
    scene.earned[2] = -0.25
    text = show(scene)['credit', 2]
    assert text.text == '-0.250' and (text.pose.position.x, text.pose.position.y) == (1.0, 1.0)


def test_the_rviz_file_shows_every_namespace_of_the_markers():
    scene = Scene(3, RADIUS)
    scene.earned[0] = 1.0
    config = yaml.safe_load((REPOSITORY / 'config/rviz/team.rviz').read_text())
    shown, = (display for display in config['Visualization Manager']['Displays'] if display['Name'] == 'team')
    assert shown['Topic']['Value'] == f'/{names.MARKERS}'
    assert list(shown['Namespaces'].items()) == [(name, True) for name in dict.fromkeys(name for name, _ in show(scene))]


def test_the_foxglove_layout_has_the_markers_and_a_plot_of_each_part_of_the_credit():
    layout = json.loads((REPOSITORY / 'config/foxglove/team.json').read_text())
    panels = layout['configById']
    assert set(re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout']))) == set(panels)
    assert panels['3D!team']['topics'] == {f'/{names.MARKERS}': {'visible': True}}
    drawn = {path['value'] for panel in panels.values() for path in panel.get('paths', [])}
    assert drawn == {f'/{names.CREDIT.format(robot)}.vector.{part}' for robot in range(3) for part in 'yz'} | {
        f'/{names.CREDIT.format(0)}.vector.x'}
