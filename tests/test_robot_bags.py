"""Bags of robots, without any message of ours, become what the simulator saw and paid, and reward networks learn from them."""

import json
import math
import random

import numpy as np
import pytest
from dae_ros_nodes import train_reward
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dae_ros.config import TaskSettings
from dae_ros.errors import BagError, SettingsError
from dae_ros.replay.robot_dataset import RobotDataset
from dae_ros.robots.bodies import Bodies
from dae_ros.robots.geometry import TaskFrame, quaternion_of, turned
from dae_ros.robots.motion import Limits, Motion
from dae_ros.weights.codec import decode_reward_network
from dae_ros.worlds import make_worlds

STORE = get_typestore(Stores.ROS2_JAZZY)
PERIOD, EPISODE, PAUSE = 0.1, 25, 1.0  # s, steps, s between episodes
BEGIN = 1_700_000_000.0                # s
FRAME = TaskFrame(scale=2.0, origin=(3.0, -1.0))
LIMITS = Limits(speed=8.0, acceleration=40.0, turn_rate=2.5, turn_acceleration=10.0)
SETTINGS = {name: info.default for name, info in train_reward.ROBOTS.items()} | {
    'drive': 'holonomic', 'max_speed': 8.0, 'max_acceleration': 40.0, 'scale': 2.0, 'origin_x': 3.0, 'origin_y': -1.0}


def make(kind, **fields):
    return STORE.types[kind](**fields)


def vector(x=0.0, y=0.0, z=0.0):
    return make('geometry_msgs/msg/Vector3', x=float(x), y=float(y), z=float(z))


def header(time, frame='map'):
    whole, part = divmod(round(time * 1e9), 10**9)
    return make('std_msgs/msg/Header', stamp=make('builtin_interfaces/msg/Time', sec=whole, nanosec=part), frame_id=frame)


def pose(position, heading=0.0):
    x, y, z, w = quaternion_of(heading)
    point = make('geometry_msgs/msg/Point', x=float(position[0]), y=float(position[1]), z=0.0)
    return make('geometry_msgs/msg/Pose', position=point, orientation=make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w))


def odometry(time, position, heading, velocity, frame='map'):
    """A message whose twist is in the robot's body; `velocity` is in the world."""
    forward, left = turned(tuple(velocity), -heading)
    twist = make('geometry_msgs/msg/Twist', linear=vector(forward, left), angular=vector())
    return make('nav_msgs/msg/Odometry', header=header(time, frame), child_frame_id='base_link',
                pose=make('geometry_msgs/msg/PoseWithCovariance', pose=pose(position, heading), covariance=np.zeros(36)),
                twist=make('geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=np.zeros(36)))


def played(episodes, seed=1, robots=3, steps=EPISODE):
    """Our simulator as robots: (time, topic, message) as they come, and what was seen, done and paid, [E, ...] each."""
    worlds = make_worlds(TaskSettings(num_agents=robots, num_worlds=1))
    draw, messages, truth = np.random.default_rng(seed), [], []
    for episode in range(episodes):
        begin = BEGIN + episode * (EPISODE * PERIOD + PAUSE)
        worlds.reset(seed, episode)
        motions = [Motion(False, LIMITS, FRAME) for _ in range(robots)]
        headings = draw.uniform(-np.pi, np.pi, robots)
        places = make('geometry_msgs/msg/PoseArray', header=header(begin),
                      poses=[pose(place) for place in FRAME.metres(worlds.landmarks[0])])
        messages.append((begin, 'landmarks', places))
        states, actions, rewards = [], [], []
        for step in range(steps + 1):
            time = begin + step * PERIOD
            states.append(worlds.observe()[1][0])
            where, speeds = FRAME.metres(worlds.positions[0]), worlds.velocities[0] * FRAME.scale
            for robot in range(robots):
                messages.append((time, f'robot_{robot}/odom', odometry(time, where[robot], headings[robot], speeds[robot])))
            if step == steps:
                break
            actions.append(draw.integers(5, size=robots))
            for robot, motion in enumerate(motions):
                told = motion.act(int(actions[-1][robot]), headings[robot])
                twist = make('geometry_msgs/msg/Twist', linear=vector(told.forward, told.left), angular=vector(z=told.turn))
                messages.append((time + 0.02, f'robot_{robot}/cmd_vel', twist))
            worlds.advance(actions[-1][None])
            rewards.append(worlds.reward()[0])
        truth.append((states, actions, rewards))
    return messages, [np.array(part) for part in zip(*truth)]


def write(path, messages, storage='mcap', namespace=''):
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {}
        for time, topic, message in messages:
            topic, kind = f'{namespace}/{topic}', message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic, kind], round(time * 1e9), STORE.serialize_cdr(message, kind))
    return path


@pytest.fixture(scope='module')
def robots():
    return played(12)


def read(path, **changes):
    dataset = RobotDataset(path, settings={**SETTINGS, **changes})
    return dataset, list(dataset)


def refusal(path, **changes):
    with pytest.raises(BagError) as caught:
        read(path, **changes)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_states_and_rewards_are_the_simulators_and_actions_are_found_again(storage, robots, tmp_path):
    messages, (states, actions, rewards) = robots
    dataset, (trajectory,) = read(write(tmp_path / 'bag', messages, storage))
    np.testing.assert_allclose(trajectory.states.swapaxes(0, 1), states, atol=2e-5)
    np.testing.assert_allclose(trajectory.rewards.T, rewards, atol=2e-5)
    assert (trajectory.actions.swapaxes(0, 1) == actions).mean() > 0.95
    assert (trajectory.probabilities.argmax(-1) == trajectory.actions).all() and (trajectory.probabilities.sum(-1) == 1).all()
    assert trajectory.observations.shape == (EPISODE, 12, 3, 18) and trajectory.episode_start[0].all()
    assert (dataset.rollouts, dataset.environment_steps) == (1, 12 * EPISODE)
    # Between the episodes nobody says where the robots are or what they shall do, and then they are elsewhere.
    cuts = dataset.skipped
    assert cuts['jump'] + cuts['gap'] == cuts['command_gap'] == 3 * 11 and cuts['landmarks'] == 11 and len(cuts) <= 4


def test_a_robot_that_turns_and_has_limits_is_understood_too(tmp_path):
    """A differential one hides in its turning what was asked for sideways."""
    task, limits, frame = TaskSettings(num_agents=3), Limits(0.5, 2.0, 2.5, 10.0), TaskFrame()
    bodies, draw, messages, actions = Bodies(task, frame, limits, True, seed=4), np.random.default_rng(1), [], []
    motions = [Motion(True, limits, frame) for _ in range(3)]
    for step in range(201):
        time = BEGIN + step * PERIOD
        for robot in range(3):
            where = bodies.pose(robot, time)
            messages.append((time, f'robot_{robot}/odom', odometry(time, where.position, where.heading, where.velocity)))
        actions.append(draw.integers(5, size=3))
        for robot, motion in enumerate(motions):
            told = motion.act(int(actions[-1][robot]), bodies.pose(robot, time).heading)
            bodies.obey(robot, told, time)
            twist = make('geometry_msgs/msg/Twist', linear=vector(told.forward), angular=vector(z=told.turn))
            messages.append((time + 0.02, f'robot_{robot}/cmd_vel',
                             make('geometry_msgs/msg/TwistStamped', header=header(time), twist=twist)))
        for part in (0.05, 0.1):
            bodies.move(time + part, 0.05)
    fixed = ', '.join(f'{x} {y}' for x, y in bodies.landmarks)
    dataset, trajectories = read(write(tmp_path / 'bag', messages, namespace='/red'), landmarks=fixed, drive='differential',
                                 odometry_topic='red/robot_{}/odom', max_speed=0.5, max_acceleration=2.0, scale=1.0, origin_x=0.0,
                                 origin_y=0.0, command_topic='/red/robot_0/cmd_vel /red/robot_1/cmd_vel /red/robot_2/cmd_vel')
    found = np.concatenate([part.swapaxes(0, 1).reshape(-1, 3) for part in (trajectory.actions for trajectory in trajectories)])
    assert len(found) == 200 and (found == np.array(actions[:200])).mean() > 0.95 and not dataset.skipped


def test_between_two_measurements_the_robots_are_in_between(robots, tmp_path):
    """Odometry a third of a period late, and commands by another clock."""
    def shifted(time, topic, message):
        if topic.endswith('odom'):
            message = odometry(time + PERIOD / 3, (time - BEGIN, 0.0), 0.0, (1.0, 0.0))
        return time + 5000.0, topic, message

    messages = [shifted(*entry) for entry in robots[0] if entry[0] < BEGIN + 2.55]
    _, (trajectory,) = read(write(tmp_path / 'bag', messages), scale=1.0, origin_x=0.0, origin_y=0.0, jump_distance=9.0)
    assert trajectory.rewards.shape == (24, 1)
    np.testing.assert_allclose(trajectory.states[:, 0, 2], 0.1 * np.arange(25) + 0.1 - 0.1 / 3, atol=1e-4)


@pytest.mark.parametrize('spoil, reason, lost', [
    (lambda time: None, 'gap', 4),
    (lambda time: odometry(time, (math.nan, 0), 0, (0, 0)), 'not_finite', 4),
    (lambda time: odometry(time, (900 * (time - BEGIN), 0), 0, (0, 0)), 'jump', 4),
    (lambda time: odometry(time, (0, 0), 0, (0, 0), 'odom'), 'wrong_frame', 4)])
def test_odometry_that_is_missing_or_wrong_cuts_the_stretch_and_is_counted(spoil, reason, lost, robots, tmp_path):
    first = [entry if entry[1] != 'robot_1/odom' or not 1.05 < entry[0] - BEGIN < 1.35 else (*entry[:2], spoil(entry[0]))
             for entry in robots[0] if entry[0] < BEGIN + 3.0]
    dataset, trajectories = read(write(tmp_path / 'bag', [entry for entry in first if entry[2] is not None]))
    assert dataset.skipped[reason] > 0 and dataset.environment_steps == EPISODE - lost
    assert all(np.isfinite(trajectory.states).all() for trajectory in trajectories)
    steps = {tuple(row) for row in np.round(robots[1][0][0], 3)}  # no state is made of what lies on both sides of the cut
    assert all(tuple(row) in steps for trajectory in trajectories for row in np.round(trajectory.states[:, 0], 3))


def test_robots_that_nobody_commands_are_not_learnt_from(robots, tmp_path):
    first = [entry for entry in robots[0] if entry[0] < BEGIN + 3.0 and not (
        entry[1] == 'robot_1/cmd_vel' and 1.05 < entry[0] - BEGIN < 1.85)]
    dataset, _ = read(write(tmp_path / 'bag', first))
    assert dataset.skipped['command_gap'] == 1 and dataset.environment_steps == EPISODE - 8


def test_what_a_bag_lacks_is_said_in_one_sentence(robots, tmp_path):
    messages = [entry for entry in robots[0] if entry[0] < BEGIN + 3.0]
    bag = write(tmp_path / 'bag', messages)
    assert 'no message with odometry on base_0/pose, only on /robot_0/odom' in refusal(bag, odometry_topic='base_{}/pose')
    assert "frame_id 'map', expected 'odom'" in refusal(bag, world_frame='odom')
    assert 'there is no message with odometry on robot_3/odom' in refusal(bag, num_agents=4)
    assert '3 landmarks, the task has 2' in refusal(bag, num_agents=2)
    assert 'is not said on places' in refusal(bag, landmarks_topic='places')
    without = write(tmp_path / 'without', [entry for entry in messages if 'cmd_vel' not in entry[1]])
    assert 'there is no message of geometry_msgs/msg/Twist or' in refusal(without)
    assert 'there is no message of nav_msgs/msg/Odometry' in refusal(write(tmp_path / 'empty', []))
    with pytest.raises(SettingsError, match='odometry_topic must name a topic for each of 3 robots'):
        read(bag, odometry_topic='red/odom blue/odom')
    with pytest.raises(SettingsError, match='not one of robots in the plane'):
        read(bag, task='matrix_game')


def test_flipped_bytes_end_in_counts_or_in_one_sentence(robots, tmp_path):
    path = write(tmp_path / 'bag', [entry for entry in robots[0] if entry[0] < BEGIN + 3.0], 'sqlite3')
    whole, draw = (path / 'bag.db3').read_bytes(), random.Random(1)
    for _ in range(60):
        content = bytearray(whole)
        for _ in range(draw.choice([1, 8, 64, 512])):
            content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        (path / 'bag.db3').write_bytes(content)
        try:
            dataset, trajectories = read(path)
        except BagError as error:
            assert '\n' not in str(error)
            continue
        assert all(np.isfinite(part).all() for trajectory in trajectories for part in trajectory[:6])


def test_a_reward_network_learns_from_robots(tmp_path, capsys):
    bag = write(tmp_path / 'bag', played(60, seed=2, robots=1)[0])
    (tmp_path / 'team.yaml').write_text('/**: {ros__parameters: {num_agents: 1, drive: holonomic, max_speed: 8.0, '
                                        'max_acceleration: 40.0, scale: 2.0, origin_x: 3.0}}')
    command = ['--bag', str(bag), '--robots', str(tmp_path / 'team.yaml'), '--output', str(tmp_path / 'reward.safetensors'),
               '-p', 'reward_network.learning_rate:=0.003', '-p', 'max_epochs:=10', '-p', 'batch_chunks:=8']
    assert train_reward.main([*command, '-p', 'origin_y:=-1.0']) == 0
    assert '1,500 environment steps, 60 episodes' in capsys.readouterr().out
    report = json.loads((tmp_path / 'reward/report.json').read_text())
    assert report['times_better'] > 2 and report['skipped']['landmarks'] == 59
    assert decode_reward_network((tmp_path / 'reward.safetensors').read_bytes())[1]['num_agents'] == 1
    assert train_reward.main([*command, '-p', 'odometry_topic:=base_{}']) == 2
    assert train_reward.main(['--bag', str(bag)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and 'there is no message with odometry on base_0' in said[0] and 'with --robots' in said[1]
