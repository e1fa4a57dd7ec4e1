"""Headings are read properly, and what robots are told stays within what they can do."""

import math

import numpy as np
import pytest

from dae_ros.config import TaskSettings
from dae_ros.errors import Refused
from dae_ros.robots.geometry import TaskFrame, heading_of, quaternion_of, turned, wrapped
from dae_ros.robots.motion import STOP, Command, Limits, Motion
from dae_ros.worlds import make_worlds

UNLIMITED = Limits(speed=100.0, acceleration=1000.0, turn_rate=100.0, turn_acceleration=10_000.0)
SLOW = Limits(speed=0.5, acceleration=1.0, turn_rate=1.5, turn_acceleration=4.0)
STAY, EAST, WEST, NORTH, SOUTH = range(5)


@pytest.mark.parametrize('heading', np.linspace(-3.1, 3.1, 9))
def test_a_heading_survives_its_quaternion_and_its_negative_is_the_same(heading):
    quaternion = quaternion_of(heading)
    assert heading_of(*quaternion) == pytest.approx(heading)
    assert heading_of(*(-part for part in quaternion)) == pytest.approx(heading)


def test_the_heading_of_a_robot_on_a_slope_is_its_yaw():
    yaw, pitch = 0.7, 0.2
    x, y = -math.sin(yaw / 2) * math.sin(pitch / 2), math.cos(yaw / 2) * math.sin(pitch / 2)
    z, w = math.sin(yaw / 2) * math.cos(pitch / 2), math.cos(yaw / 2) * math.cos(pitch / 2)
    assert heading_of(x, y, z, w) == pytest.approx(yaw)


@pytest.mark.parametrize('quaternion', [(0, 0, 0, 0), (0, 0, 0, 2), (math.nan, 0, 0, 1)])
def test_what_is_no_unit_quaternion_is_refused(quaternion):
    with pytest.raises(Refused, match='quaternion'):
        heading_of(*quaternion)


def test_turning_goes_counter_clockwise_and_angles_wrap():
    assert turned((1.0, 0.0), math.pi / 2) == pytest.approx((0.0, 1.0))
    assert wrapped(3 * math.pi / 2) == pytest.approx(-math.pi / 2)


def test_a_holonomic_robot_without_limits_moves_as_the_particle_of_the_simulator_whatever_its_heading():
    worlds, motion = make_worlds(TaskSettings(num_agents=1, num_worlds=1)), Motion(False, UNLIMITED, TaskFrame())
    worlds.reset(1, 0)
    draw = np.random.default_rng(3)
    for _ in range(20):
        action, heading = int(draw.integers(5)), draw.uniform(-3, 3)
        worlds.advance(np.array([[action]]))
        command = motion.act(action, heading)
        assert turned(command[:2], heading) == pytest.approx(tuple(worlds.velocities[0, 0])) and command.turn == 0.0


def test_at_another_scale_and_pace_it_moves_as_much_further_and_slower():
    fast, slow = (Motion(False, UNLIMITED, frame) for frame in (TaskFrame(), TaskFrame(scale=3.0, slowness=2.0)))
    for action in (EAST, EAST, NORTH, STAY):
        here, there = fast.act(action, 0.0), slow.act(action, 0.0)
        assert there[:2] == pytest.approx((1.5 * here.forward, 1.5 * here.left))


@pytest.mark.parametrize('differential', [False, True])
def test_speeds_and_accelerations_never_pass_the_limits(differential):
    motion, before, heading = Motion(differential, SLOW, TaskFrame()), STOP, 0.3
    draw, period = np.random.default_rng(4), 0.1
    for _ in range(500):
        command = motion.act(int(draw.integers(5)), heading)
        heading = wrapped(heading + period * command.turn)
        assert math.hypot(command.forward, command.left) <= SLOW.speed + 1e-9 and abs(command.turn) <= SLOW.turn_rate
        if differential:
            assert command.left == 0.0
            assert abs(command.forward - before.forward) <= SLOW.acceleration * period + 1e-9
            assert abs(command.turn - before.turn) <= SLOW.turn_acceleration * period + 1e-9
        before = command


def test_a_holonomic_robot_accelerates_no_faster_than_it_may_in_any_direction():
    motion, before = Motion(False, SLOW, TaskFrame()), (0.0, 0.0)
    for action in np.random.default_rng(5).integers(5, size=200):
        velocity = motion.act(int(action), 0.0)[:2]
        assert math.dist(velocity, before) <= SLOW.acceleration * 0.1 + 1e-9
        before = velocity


@pytest.mark.parametrize('heading', [0.0, 1.2, -2.0, math.pi])
@pytest.mark.parametrize('action, direction', [(EAST, (1, 0)), (WEST, (-1, 0)), (NORTH, (0, 1)), (SOUTH, (0, -1))])
def test_a_differential_robot_gets_to_where_the_particle_would(action, direction, heading):
    motion, position = Motion(True, SLOW, TaskFrame()), np.zeros(2)
    for _ in range(40):
        command = motion.act(action, heading)
        for _ in range(10):
            heading = wrapped(heading + 0.01 * command.turn)
            position += 0.01 * command.forward * np.array([math.cos(heading), math.sin(heading)])
    assert position @ direction > 1.0 and abs(position @ direction[::-1]) < 0.4


def test_a_robot_whose_back_points_where_it_should_go_drives_backward():
    command = Motion(True, SLOW, TaskFrame()).act(WEST, 0.0)
    assert command.forward < 0.0 and command.turn == pytest.approx(0.0, abs=1e-12)


def test_after_a_halt_the_robot_starts_from_rest():
    motion = Motion(False, UNLIMITED, TaskFrame())
    first = motion.act(EAST, 0.0)
    motion.act(EAST, 0.0)
    assert motion.halt() == Command(0.0, 0.0, 0.0)
    assert motion.act(EAST, 0.0) == first
