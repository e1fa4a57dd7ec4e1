"""An agent's first action waits for those it answers, whoever else listens."""

from __future__ import annotations

import numpy as np
from dae_ros_msgs import msg
from diagnostic_msgs.msg import DiagnosticArray
from harness import SMALL, Listener

from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.ros import convert, names, qos
from dae_ros.types import Observation, PolicyWeights, RolloutRequest, Stamp
from dae_ros.weights.codec import encode_policy, sha256

RUN, W = 5, 2
SIZES = PolicyArchitecture(observation_size=3, num_actions=2, hidden_size=4, mlp_layers=1, activation='relu')


def policy_message() -> msg.PolicyWeights:
    data = encode_policy(Policy(SIZES, {name: np.zeros(shape, np.float32) for name, shape in SIZES.shapes().items()}))
    return convert.policy_weights_message(PolicyWeights(RUN, 1, sha256(data), data))


def test_strangers_who_listen_do_not_stand_in_for_the_world_and_the_trainer(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', {**SMALL, 'num_agents': 1})
    for process in graph.processes.values():
        process.parameters['run'] = RUN
    action, observation = (topic.format(0) for topic in (names.ACTION, names.OBSERVATION))
    request = RolloutRequest(RUN, rollout=0, attempt=0, policy_version=1, seed=1, num_steps=25, greedy=False)
    shown = Observation(Stamp(RUN, 0, 0, 0), 0, 1, np.ones(W, bool), np.ones((W, 3), np.float32))
    with Listener() as stranger, Listener() as world, Listener() as trainer:
        sentences, heard = [], []

        def subscribe(to: Listener, mark: str):
            return to.node.create_subscription(msg.Action, action, lambda _: heard.append(mark), qos.ROLLOUT)

        def say(speaker: Listener, kind: type, topic: str, message):
            publisher = speaker.node.create_publisher(kind, topic, qos.LATCHED)
            publisher.publish(message)
            return publisher

        def spin_until(condition):
            def turn() -> bool:
                for other in (world, trainer):
                    other.executor.spin_once(timeout_sec=0)
                return condition()

            stranger.spin_until(turn, lambda: f'said {sentences[-3:]}, heard by {heard}\n{graph.log("agent_0")}')

        stranger.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                                          lambda report: sentences.extend(status.message for status in report.status), qos.EVENTS)
        strangers = [subscribe(stranger, 'stranger') for _ in range(3)]
        spoken = [say(trainer, msg.PolicyWeights, names.POLICY, policy_message()),
                  say(trainer, msg.RolloutRequest, names.ROLLOUT_REQUEST, convert.rollout_request_message(request)),
                  say(world, msg.Observation, observation, convert.observation_message(shown))]
        graph.start('agent_0')
        spin_until(lambda: 'waiting for trainer and world to listen' in sentences)
        strangers.append(subscribe(world, 'world'))
        spin_until(lambda: 'waiting for trainer to listen' in sentences)
        assert not heard
        strangers.append(subscribe(trainer, 'trainer'))
        spin_until(lambda: sorted(heard) == ['stranger'] * 3 + ['trainer', 'world'])
        assert len(spoken) == 3
