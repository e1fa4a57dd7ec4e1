"""Malformed and foreign messages on every topic: counted, logged once, never acted on, never a crash."""

from __future__ import annotations

from array import array

from dae_ros_msgs import msg
from harness import SMALL, Listener, Refusals, oracle

from dae_ros.ros import names, qos

W, N, O, S, A = 8, 3, 18, 54, 5
FAR = 2 ** 20  # a rollout that will never be reached


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

    def weights(**changes) -> msg.PolicyWeights:
        return msg.PolicyWeights(**{**dict(run=run, version=7, sha256='0' * 64, data=array('B', garbage)), **changes})

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
        (msg.SharedReward, names.SHARED_REWARD, reward(stamp=stamp(foreign)), 'wrong_run'),
        (msg.SharedReward, names.SHARED_REWARD, reward(reward=floats(3)), 'wrong_shape'),
        (msg.RolloutRequest, names.ROLLOUT_REQUEST, msg.RolloutRequest(run=foreign, rollout=FAR, num_steps=25), 'wrong_run'),
        (msg.RolloutRequest, names.ROLLOUT_REQUEST, msg.RolloutRequest(run=run, num_steps=0), 'out_of_range'),
        (msg.PolicyWeights, names.POLICY, weights(run=foreign), 'wrong_run'),
        (msg.PolicyWeights, names.POLICY, weights(), 'corrupt'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(run=foreign), 'wrong_run'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(), 'corrupt'),
        (msg.PolicyWeights, names.POLICY_UPDATE, weights(data=array('B', bytes(65 * 2 ** 20))), 'oversized'),
    ]


def test_malformed_and_foreign_messages_are_counted_by_reason_and_change_no_weight(make_graph, tmp_path):
    values = {**SMALL, 'total_steps': 150 * 8 * 25}
    graph = make_graph(tmp_path / 'graph', values)
    with Listener() as listener:
        messages = bad_messages(graph.folder.run)
        publishers = {topic: listener.node.create_publisher(kind, topic, qos.LATCHED_INPUT) for kind, topic, _, _ in messages}
        refusals = Refusals(listener)
        graph.start(*graph.names)
        listener.spin_until(lambda: all(publisher.get_subscription_count() for publisher in publishers.values()))
        listener.wait_for_status(lambda status: status.policy_version >= 1)
        for _, topic, message, _ in messages:
            publishers[topic].publish(message)
        wanted = {(topic, reason) for _, topic, _, reason in messages}

        def missing() -> set[tuple[str, str]]:
            return wanted - {(topic, reason) for _, topic, reason in refusals.counted}

        listener.spin_until(lambda: not missing(), lambda: f'not counted: {missing()}')
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', values)
    for name in graph.names:
        log = graph.log(name)
        assert 'Traceback' not in log, log
        warnings = [line for line in log.splitlines() if 'refused a message on ' in line]
        warned = [line.split('refused a message on ')[1].split(':')[:2] for line in warnings]
        assert len(warned) == len({tuple(entry) for entry in warned}), log
