"""Malformed, mutated, replayed, reordered and foreign messages and calls: counted, logged once, never acted on, never a crash."""

from __future__ import annotations

import os
from array import array

from dae_ros_msgs import msg, srv
from fuzzer import EXTREMES, HOSTILE_TEXTS, Fuzzer
from harness import LASTING, TIMEOUT, Listener, Refusals, bringup, finish, oracle, processes_naming
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from dae_ros import config
from dae_ros.report.summary import Summary
from dae_ros.ros import convert, names, qos
from dae_ros.run_folder import RunFolder
from dae_ros.weights.codec import seal

W, N, O, S, A = 8, 3, 18, 54, 5
FAR = 2 ** 20  # a rollout that will never be reached
KEY = bytes(range(32))
UPDATES = 20
SEED = 1
HOSTILE = 3000  # messages from the fuzzer
RAW_TOPIC = QoSProfile(depth=10, avoid_ros_namespace_conventions=True)  # a service, as DDS sees it


def floats(count: int, value: float = 0.2) -> array:
    return array('f', [value]) * count


def ones(count: int) -> array:
    return array('B', [1]) * count


def bad_messages(run: int) -> list[tuple[type, str, object, str]]:
    """(type, topic, message, reason it must be refused for): at least one of every kind for every topic."""
    foreign, garbage = run ^ 0xFFFF, b'\x80\x04\x95not a safetensors file'

    def stamp(of_run: int = run, rollout: int = 0, attempt: int = 0, step: int = 2 ** 31) -> msg.Stamp:
        return msg.Stamp(run=of_run, rollout=rollout, attempt=attempt, step=step)

    def action(**changes) -> msg.Action:
        whole = dict(stamp=stamp(), robot=1, policy_version=0, num_worlds=W, num_actions=A,
                     actions=array('H', [0]) * W, probabilities=floats(W * A))
        return msg.Action(**{**whole, **changes})

    def observation(**changes) -> msg.Observation:
        whole = dict(stamp=stamp(), robot=1, policy_version=0, num_worlds=W, observation_size=O, episode_start=ones(W),
                     values=floats(W * O))
        return msg.Observation(**{**whole, **changes})

    def joint(**changes) -> msg.JointState:
        whole = dict(stamp=stamp(), num_worlds=W, num_agents=N, observation_size=O, state_size=S, episode_start=ones(W),
                     observations=floats(W * N * O))
        return msg.JointState(**{**whole, **changes})

    def reward(**changes) -> msg.SharedReward:
        whole = dict(stamp=stamp(), num_worlds=W, state_size=S, reward=floats(W), terminated=ones(W),
                     truncated=array('B', [0]) * W)
        return msg.SharedReward(**{**whole, **changes})

    def weights(data: bytes = garbage, of_run: int = run, **changes) -> msg.PolicyWeights:
        return convert.policy_weights_message(seal(of_run, 7, data, KEY)._replace(**changes))

    overflowing = msg.JointState(stamp=stamp(), num_agents=2**32 - 1, observation_size=2**32 - 1)
    robot_1 = names.ACTION.format(1), names.OBSERVATION.format(1)
    return [
        (msg.Action, robot_1[0], action(stamp=stamp(foreign)), 'wrong_run'),
        (msg.Action, robot_1[0], action(num_worlds=9), 'wrong_shape'),
        (msg.Action, robot_1[0], action(num_worlds=2 ** 31), 'wrong_shape'),
        (msg.Observation, robot_1[1], observation(stamp=stamp(foreign)), 'wrong_run'),
        (msg.Observation, robot_1[1], observation(values=floats(W * O, float('nan'))), 'not_finite'),
        (msg.Observation, robot_1[1], observation(robot=2), 'wrong_robot'),
        (msg.Observation, robot_1[1], observation(observation_size=2 ** 31), 'wrong_shape'),
        (msg.JointState, names.JOINT_STATE, joint(stamp=stamp(foreign)), 'wrong_run'),
        (msg.JointState, names.JOINT_STATE, joint(num_agents=4), 'wrong_shape'),
        (msg.JointState, names.JOINT_STATE, overflowing, 'wrong_shape'),
        (msg.SharedReward, names.SHARED_REWARD, reward(stamp=stamp(foreign)), 'wrong_run'),
        (msg.SharedReward, names.SHARED_REWARD, reward(reward=floats(3)), 'wrong_shape'),
        (msg.RolloutRequest, names.ROLLOUT_REQUEST, msg.RolloutRequest(run=foreign, rollout=FAR, num_steps=25), 'wrong_run'),
        (msg.RolloutRequest, names.ROLLOUT_REQUEST, msg.RolloutRequest(run=run, num_steps=0), 'out_of_range'),
        (msg.PolicyWeights, names.POLICY, weights(of_run=foreign), 'wrong_run'),
        (msg.PolicyWeights, names.POLICY, weights(), 'corrupt'),
        (msg.PolicyWeights, names.POLICY, weights(sha256='0' * 64), 'corrupt'),
        (msg.PolicyWeights, names.POLICY, weights(signature=''), 'forged'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(of_run=foreign), 'wrong_run'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(), 'corrupt'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(bytes(65 * 2 ** 20)), 'oversized'),
    ]


def call_services(listener: Listener) -> None:
    """Calls with what nobody would ask for, and bytes that are no call; each that is one is answered."""
    nonsense = [0, UPDATES + 1, 2**63, 2**64 - 2, *EXTREMES]
    for version in nonsense:
        answer = listener.call(srv.GetPolicy, names.GET_POLICY, srv.GetPolicy.Request(version=version))
        assert answer.success == (answer.message == '')
    everywhere = [f'{name}/set_parameters' for name in ('world', 'agent_0', 'parameter_server', 'trainer')]
    values = [ParameterValue(type=kind, string_value=text, integer_value=-2**63, double_value=float('nan'))
              for kind in (0, 2, 3, 4, 255) for text in HOSTILE_TEXTS]
    for service in everywhere:
        parameters = [Parameter(name=name, value=value) for name in ('run', 'seed', '', '\0', 'x' * 10_000) for value in values]
        answer = listener.call(SetParameters, service, SetParameters.Request(parameters=parameters))
        assert len(answer.results) == len(parameters) and not any(result.successful for result in answer.results)
        atomically = SetParametersAtomically.Request(parameters=parameters)
        assert not listener.call(SetParametersAtomically, f'{service}_atomically', atomically).result.successful
        clock = Parameter(name='use_sim_time', value=ParameterValue(type=1, bool_value=True))
        assert not listener.call(SetParameters, service, SetParameters.Request(parameters=[clock])).results[0].successful
    rubbish = listener.node.create_publisher(srv.GetPolicy.Request, f'rq/{names.GET_POLICY}Request', RAW_TOPIC)
    for data in (b'', b'\0', os.urandom(4), os.urandom(12), serialize_message(srv.GetPolicy.Request())):
        rubbish.publish(data)


def learnt(status: msg.TrainingStatus) -> int:
    """Updates so far, by a status that is not of the fuzzer's invention."""
    genuine = (status.environment_steps, status.total_steps) == (status.policy_version * W * 25, UPDATES * W * 25)
    return status.policy_version if genuine else 0


def test_a_team_among_hostile_messages_counts_and_survives_them_all_and_ends_with_the_same_weights(domain, tmp_path):
    values = {**LASTING, 'total_steps': UPDATES * W * 25, 'rollout_timeout': 5.0}
    key_file = tmp_path / 'team.key'
    key_file.touch(0o600)
    key_file.write_bytes(KEY)
    run = RunFolder(tmp_path / 'run', config.from_flat(values)).run
    with Listener() as listener:
        refusals, fuzzer = Refusals(listener), Fuzzer(listener, run, N, SEED, HOSTILE)
        messages = bad_messages(run)
        publishers = {topic: listener.node.create_publisher(kind, topic, qos.LATCHED_INPUT) for kind, topic, _, _ in messages}
        for service in names.PAUSE, names.RESUME:
            listener.client(Trigger, service)
        process = bringup(tmp_path / 'run', values, '--key-file', str(key_file))
        try:
            listener.wait_for_status(lambda status: learnt(status) >= UPDATES // 2)
            listener.call(Trigger, names.PAUSE, Trigger.Request())
            for _, topic, message, _ in messages:
                publishers[topic].publish(message)
            call_services(listener)
            while fuzzer.sent.total() < HOSTILE:  # where the team was quicker than the fuzzer
                fuzzer.attack()
                listener.executor.spin_once(0.001)
            wanted = {(topic, reason) for _, topic, _, reason in messages}

            def missing() -> set[tuple[str, str]]:
                return wanted - {(topic, reason) for _, topic, reason in refusals.counted}

            listener.spin_until(lambda: not missing(), lambda: f'not counted: {missing()}')
            listener.call(Trigger, names.RESUME, Trigger.Request())
            listener.wait_for_status(lambda status: learnt(status) == UPDATES)
            code, output, errors = finish(process)
        finally:
            process.kill()
            process.communicate(timeout=TIMEOUT)
    assert code == 0, output + errors
    print(f'sent {dict(fuzzer.sent)}, refused {sum(refusals.counted.values())}')
    assert len(fuzzer.sent) == 5 and sum(refusals.counted.values()) > HOSTILE / 2
    summary = Summary.read(tmp_path / 'run' / 'summary.json')
    assert (summary.weights_sha256, summary.evaluation_return) == oracle(tmp_path / 'alone', values)
    logs = {path.stem: path.read_text() for path in (tmp_path / 'run' / 'logs').iterdir()}
    assert len(logs) == 4 and not any('Traceback' in text for text in (output, errors, *logs.values()))
    assert '\x1b' not in output and not processes_naming(str(tmp_path))
    for log in logs.values():
        warnings = [line for line in log.splitlines() if 'refused a message on ' in line]
        # By node, topic and reason: several agents share a process.
        warned = [(line.split(']: refused')[0], *line.split('refused a message on ')[1].split(':')[:2]) for line in warnings]
        warned = [(node.rpartition('[')[2], *of) for node, *of in warned]
        assert len(warned) == len(set(warned)), log
