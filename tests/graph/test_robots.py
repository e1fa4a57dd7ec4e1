"""Robots driven by a trained team's policy, by real nodes over standard topics; no trainer, no world of ours."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from dae_ros_msgs import msg
from geometry_msgs.msg import PoseArray, TwistStamped
from harness import REPOSITORY, SMALL, TIMEOUT, processes_naming
from nav_msgs.msg import Odometry
from robots import LANDMARKS, PERIOD, PLACES, POLICY, Processes, Stage, is_standing
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from dae_ros.report.summary import Summary
from dae_ros.robots import standard_messages
from dae_ros.robots.acting import ActingEnd
from dae_ros.robots.pilot import stamp_at
from dae_ros.robots.setup import RUN
from dae_ros.ros import convert, convert_robots, names, qos
from dae_ros.weights.codec import decode_policy

LAYOUTS, NEEDED = 20, 16
BURST, EPISODE = 100, 25
WATCHED = 2 * EPISODE  # steps, among which an episode begins
SECONDS = 8.0   # of simulated time for each layout
SPEEDUP = 3.0
CLOSE = 0.25    # m, mean distance of the landmarks to the nearest robot
SIMULATED = {'use_sim_time': 'true'}


@pytest.fixture
def processes(domain, tmp_path):
    processes = Processes(tmp_path)
    yield processes
    processes.stop()


@pytest.fixture
def stage(domain):
    with Stage() as stage:
        yield stage


def start_robot(processes, robot, agent=None, **bridge):
    agent = {'policy_file': POLICY} if agent is None else agent
    processes.node('agent', f'agent_{robot}', robot=robot, **agent, **SIMULATED)
    processes.node('robot_bridge', f'bridge_{robot}', robot=robot, **{'enabled': 'true', **SIMULATED, **bridge})


def answers_of(policy, observations, run=1):
    """What an agent with this policy answers, greedily, to these observations."""
    end = ActingEnd(observations[0].robot, greedy=True, seed=0)
    end.on_policy(run, 0, policy)
    return [end.on_observation(observation).actions[0] for observation in observations]


def check_last_answers(stage, robot, policy):
    """What this robot did in its last `WATCHED` steps is what this policy answers, from where an episode begins among them."""
    acted, seen = stage.decoded(stage.actions[robot])[-WATCHED:], stage.decoded(stage.observations[robot])
    acted = acted[next(index for index, action in enumerate(acted) if action.stamp.step == 0):]
    by_stamp = {observation.stamp: observation for observation in seen}
    assert [action.actions[0] for action in acted] == answers_of(policy, [by_stamp[action.stamp] for action in acted])


def test_a_robot_stands_until_it_is_enabled_drives_alone_among_strangers_and_stands_when_its_odometry_is_cut(stage, processes):
    """Robots 1 and 2 are somebody else's: nothing but their odometry is there."""
    start_robot(processes, 0, enabled='false')
    stage.wait_for_bridges(1)
    for _ in range(3):
        stage.tick(0, 1, 2)
    stage.spin_until(lambda: 'standing: not enabled' in stage.diagnostics['bridge_0'])
    assert not stage.observations[0] and all(is_standing(command) for command in stage.commands[0])
    assert stage.call(SetBool, 'bridge_0/enable', SetBool.Request(data=True)).success
    stage.start_driving(0, 0, 1, 2)
    for _ in range(WATCHED):
        stage.drive(0, 0, 1, 2)
    stage.spin_until(lambda: stage.has_heard_both(0))
    seen = stage.decoded(stage.observations[0])
    np.testing.assert_allclose(seen[-1].values[0, 2:4], PLACES[0])
    np.testing.assert_allclose(seen[-1].values[0, 4:10].reshape(3, 2), LANDMARKS - PLACES[0], atol=1e-6)
    np.testing.assert_allclose(seen[-1].values[0, 10:14].reshape(2, 2), PLACES[1:] - PLACES[0], atol=1e-6)
    check_last_answers(stage, 0, decode_policy(POLICY.read_bytes()))

    stage.drive(0, 1, 2)                                # 0.1 s old: within the bound
    assert is_standing(stage.drive(0, 1, 2))            # the second control period
    stage.spin_until(lambda: any('its own odometry is 0.2' in line for line in stage.diagnostics['bridge_0']))
    stage.start_driving(0, 0, 1, 2)
    for _ in range(12):
        command = stage.drive(0, 0, 1)                  # robot 2 fell silent: held for a second, then everybody waits for it
    assert is_standing(command)
    stage.spin_until(lambda: any('the odometry of robot 2 is' in line for line in stage.diagnostics['bridge_0']))
    stage.start_driving(0, 0, 1, 2)
    assert stage.call(SetBool, 'bridge_0/enable', SetBool.Request(data=False)).message == 'standing: not enabled'
    stage.spin_until(lambda: is_standing(stage.commands[0][-1]))


def test_odometry_that_cannot_be_right_stops_the_robot_and_so_do_a_dead_agent_and_the_end_of_the_bridge(domain, processes):
    with Stage(TwistStamped) as stage:
        start_robot(processes, 1, stamped='true', drive='holonomic')
        stage.wait_for_bridges(1)
        stage.start_driving(1, 0, 1, 2)
        command = stage.drive(1, 0, 1, 2)
        assert command.header.frame_id == 'robot_1/base_link' and command.twist.angular.z == 0.0
        for reason, place in (('not_finite', (math.nan, 0.0)), ('jump', (9.0, 9.0))):
            stage.tick(0, 2)
            stage.show_until(lambda: f': {reason}: ' in processes.log('bridge_1'), 1, position=place)
            stage.tick_until(lambda: is_standing(stage.commands[1][-1]), 0, 2)
            stage.start_driving(1, 0, 1, 2)
        processes.end('agent_1', signal.SIGKILL)
        stage.wait_for_words('bridge_1', 'the agent has not answered', 0, 1, 2)
        stage.spin_until(lambda: is_standing(stage.commands[1][-1]))
        processes.node('agent', 'agent_1_again', robot=1, policy_file=POLICY)
        stage.start_driving(1, 0, 1, 2)
        assert processes.end('bridge_1') == 0
        stage.spin_until(lambda: is_standing(stage.commands[1][-1]))
        assert 'Traceback' not in processes.log('bridge_1')


def test_robots_of_one_process_are_driven_and_stopped_each_by_itself(stage, processes):
    """One of their bridges listens for all of them; what an agent is asked and says is told afterwards."""
    settings = {'robots': 3, 'policy_file': POLICY, 'enabled': 'true', **SIMULATED}
    processes.python('robots', 'dae_ros_nodes.robot', '--ros-args',
                     *(text for name, value in settings.items() for text in ('-p', f'{name}:={value}')))
    stage.wait_for_bridges(1)
    everybody = 0, 1, 2
    for robot in everybody:
        stage.start_driving(robot, *everybody)
    for _ in range(WATCHED):
        stage.step(everybody, *everybody)
    policy = decode_policy(POLICY.read_bytes())
    for robot in everybody:
        check_last_answers(stage, robot, policy)

    assert stage.call(SetBool, 'bridge_2/enable', SetBool.Request(data=False)).message == 'standing: not enabled'
    stage.spin_until(lambda: is_standing(stage.commands[2][-1]))
    for robot in 0, 1:
        stage.start_driving(robot, *everybody)
    assert is_standing(stage.commands[2][-1])
    stage.wait_for_words('bridge_0', 'its own odometry is', 1, 2)
    stage.wait_for_words('bridge_1', 'the odometry of robot 0 is', 1, 2)
    stage.tick(1, 2)
    refusal = '[bridge_1]: refused a message on robot_0/odom: jump: '
    stage.show_until(lambda: refusal in processes.log('robots'), 0, position=(900.0, 900.0))
    assert processes.end('robots') == 0
    stage.spin_until(lambda: all(is_standing(stage.commands[robot][-1]) for robot in everybody))
    assert 'Traceback' not in processes.log('robots')


def test_what_robots_do_does_not_change_when_trainer_and_parameter_server_are_killed(stage, processes, make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    graph.start('trainer', 'parameter_server')
    for robot in range(3):
        start_robot(processes, robot, agent={'run': graph.folder.run, 'execute': 'true'}, drive='holonomic')
    stage.wait_for_bridges(3)
    everybody = 0, 1, 2
    for robot in everybody:
        stage.start_driving(robot, *everybody)
    graph.kill('trainer', 'parameter_server')
    for _ in range(WATCHED):
        stage.step(everybody, *everybody)
    policy, = (decode_policy(path.read_bytes()) for path in graph.folder.policies.glob('*/policy_*.safetensors'))
    for robot in everybody:
        check_last_answers(stage, robot, policy)
        assert {action.policy_version for action in stage.decoded(stage.actions[robot])} == {0}
    assert stage.call(Trigger, 'agent_0/activate_policy', Trigger.Request()).message == 'acting with policy version 0'


def test_who_watches_passes_over_no_step_however_fast_simulated_time_runs(stage, processes):
    processes.node('task_monitor', 'task_monitor', **SIMULATED)
    states, everybody = [], (0, 1, 2)
    stage.node.create_subscription(msg.JointState, names.JOINT_STATE, states.append, qos.ROLLOUT)
    stage.landmarks.publish(convert_robots.landmarks_message(LANDMARKS, stage.now, 'map'))
    stage.tick_until(lambda: bool(states), *everybody)
    for _ in range(BURST):
        stage.places += 0.01
        stage.tick(*everybody)
    last = stamp_at(stage.now, PERIOD, EPISODE, RUN)
    stage.spin_until(lambda: convert.joint_state(states[-1]).stamp == last, lambda: str(states[-1].stamp))
    began = [state for state in map(convert.joint_state, states) if state.stamp.step < EPISODE][-BURST:]
    assert [EPISODE * state.stamp.rollout + state.stamp.step for state in began] == [
        EPISODE * last.rollout + last.step - BURST + 1 + index for index in range(BURST)]
    places = [state.observations[0, 0, 2:4] for state in began]
    np.testing.assert_allclose(np.diff(places, axis=0), 0.01, atol=1e-5)  # each step with where everybody was then


@pytest.mark.slow  # twenty layouts of eight seconds each, at three times real time
def test_the_navigation_team_covers_the_landmarks_with_foreign_differential_robots(stage, processes):
    """Robots that were never seen, at 10 Hz, with 5 % noise and 50 ms delay; only their clock runs faster than ours."""
    processes.python('robots', 'examples.foreign_robots', '--ros-args', '-p', f'speedup:={SPEEDUP}')
    for robot in range(3):
        # A loaded machine's hiccups last SPEEDUP times as long on the robots' clock.
        start_robot(processes, robot, odometry_timeout=0.15 * SPEEDUP, action_timeout=0.25 * SPEEDUP)
    stage.client(Trigger, 'next_layout')
    landmarks, truth = [], []
    for topic, heard, profile in ((names.LANDMARKS, landmarks, qos.LATCHED_INPUT), ('ground_truth', truth, 10)):
        stage.node.create_subscription(PoseArray, topic, heard.append, profile)
    stage.spin_until(lambda: all(stage.commands[robot] and not is_standing(stage.commands[robot][-1]) for robot in range(3)),
                     lambda: str(stage.diagnostics))
    distances = []
    for layout in range(1, LAYOUTS + 1):
        assert stage.call(Trigger, 'next_layout', Trigger.Request()).message == f'layout {layout}'
        stage.spin_until(lambda: len(landmarks) >= layout and truth)
        begin = standard_messages.seconds(truth[-1].header.stamp)
        stage.spin_until(lambda: standard_messages.seconds(truth[-1].header.stamp) > begin + SECONDS)
        robots, places = (standard_messages.landmarks(message, 'map') for message in (truth[-1], landmarks[-1]))
        distances.append(np.linalg.norm(places[:, None] - robots[None], axis=-1).min(axis=1).mean())
        truth.clear()
    assert sum(distance < CLOSE for distance in distances) >= NEEDED, np.round(distances, 2)


def test_our_simulator_plays_robots_that_the_same_bridges_drive(domain, stage, processes):
    """Topic by topic what a real robot has: odometry, landmarks, markers, and a clock since it runs faster."""
    body = {'drive': 'holonomic', 'max_speed': 2.0, 'max_acceleration': 5.0}
    processes.node('world', 'robots', real_time_factor=4.0, **body)
    for robot in range(3):
        start_robot(processes, robot, **body, odometry_timeout=0.6, action_timeout=1.0)
    stage.client(Trigger, 'robots/next_episode')
    shown, odometry, landmarks = [], {}, []
    stage.node.create_subscription(MarkerArray, names.MARKERS, shown.append, qos.SENSOR)
    stage.node.create_subscription(PoseArray, names.LANDMARKS, landmarks.append, qos.LATCHED_INPUT)
    for robot in range(3):
        stage.node.create_subscription(Odometry, names.ODOMETRY.format(robot), partial(odometry.__setitem__, robot), qos.SENSOR)

    def distance():
        places = standard_messages.landmarks(landmarks[-1], 'map')
        robots = np.array([standard_messages.odometry(odometry[robot], 'map').position for robot in range(3)])
        return np.linalg.norm(places[:, None] - robots[None], axis=-1).min(axis=1).mean()

    stage.spin_until(lambda: len(odometry) == 3 and landmarks and distance() < CLOSE)
    # The first displays may be older than the first action: the world listens to these once somebody looks.
    stage.spin_until(lambda: shown and ('actions', Marker.ADD) in {(marker.ns, marker.action) for marker in shown[-1].markers})
    kinds = Counter(marker.ns for marker in shown[-1].markers)
    assert kinds == {'robots': 3, 'headings': 3, 'landmarks': 3, 'targets': 3, 'trails': 3, 'contacts': 1, 'actions': 12}
    assert stage.call(Trigger, 'robots/next_episode', Trigger.Request()).message == 'episode 1'
    stage.spin_until(lambda: distance() > CLOSE)
    stage.spin_until(lambda: distance() < CLOSE)


def test_bringup_drives_a_simulated_team_until_it_is_stopped_and_leaves_nothing(stage, tmp_path):
    command = [sys.executable, '-m', 'dae_ros_nodes.bringup', 'navigation', '--execute', 'navigation', '--simulate',
               '--run-folder', str(tmp_path / 'run')]
    # Tests that were started in the background ignore SIGINT, and so would whatever they start.
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL))
    try:
        stage.spin_until(lambda: all(any(not is_standing(command) for command in stage.commands[robot]) for robot in range(3)))
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    assert process.returncode == 130 and 'stopped' in errors and 'driving' in output, errors
    assert not processes_naming(str(tmp_path))
    stage.spin_until(lambda: all(is_standing(stage.commands[robot][-1]) for robot in range(3)))


def test_a_robot_bringup_that_cannot_begin_says_why(domain, tmp_path):
    for arguments, sentence in ((['--execute', 'nowhere'], 'there is no policy file nowhere'),
                                (['--execute', 'navigation', '-p', 'max_sped:=1'], "did you mean 'max_speed'?"),
                                (['--execute', 'navigation', '--watch', '0'], '--watch goes with a training on the graph'),
                                (['--simulate'], '--simulate goes with --execute POLICY')):
        done = subprocess.run([sys.executable, '-m', 'dae_ros_nodes.bringup', 'navigation', *arguments], cwd=tmp_path,
                              capture_output=True, text=True, timeout=TIMEOUT)
        assert done.returncode == 2 and sentence in done.stderr and 'Traceback' not in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_the_commands_of_the_documentation_drive_a_robot(stage, processes):
    """The agent's and the bridge's, with the service that enables it; bringup's is tried above."""
    commands = ''.join(re.findall(r'```bash\n(.*?)```', (REPOSITORY / 'docs/robots.md').read_text(), re.DOTALL)).splitlines()
    execute, agent, bridge, enable, stream, *_ = commands
    assert 'bringup navigation --execute navigation --simulate' in execute and 'bringup streaming --stream --simulate' in stream
    for name, command in (('agent_0', agent), ('bridge_0', bridge)):
        assert f'__node:={name}' in command
        executable, *arguments = re.sub(r'-r \S+:=/tb3_\S+', '', command).replace('config/', f'{REPOSITORY}/config/').split()
        processes.python(name, f'dae_ros_nodes.{Path(executable).name}', *arguments, '-p', 'use_sim_time:=true')
    stage.wait_for_bridges(1)
    service, kind, request = enable.split(maxsplit=5)[3:]
    assert (kind, request) == ('std_srvs/srv/SetBool', "'{data: true}'")
    assert stage.call(SetBool, service, SetBool.Request(data=True)).success
    stage.start_driving(0, 0, 1, 2)
    speeds = [abs(stage.drive(0, 0, 1, 2).linear.x) for _ in range(10)]
    assert max(speeds) <= 0.3


@pytest.mark.slow  # ten processes, one of them with torch
def test_a_team_learns_in_a_stream_of_what_its_robots_do(domain, tmp_path):
    """Their agents and bridges, who watches them, trainer and parameter server."""
    settings = ['num_worlds:=1', 'total_steps:=50', 'evaluation_episodes:=1', 'epochs:=1', 'reward_network.epochs:=1']
    command = [sys.executable, '-m', 'dae_ros_nodes.bringup', 'streaming', '--stream', '--simulate', '--run-folder',
               str(tmp_path / 'run'), *(text for one in settings for text in ('-p', one))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=2 * TIMEOUT)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = Summary.read(tmp_path / 'run' / 'summary.json')
    assert summary.environment_steps == 50 and summary.evaluation_episodes == 1
    assert summary.policy == 'sampling'
    assert not processes_naming(str(tmp_path))
