"""Pause, resume, save and get_policy on a running team."""

from __future__ import annotations

import pytest
from dae_ros_msgs.srv import GetPolicy
from harness import SMALL, Listener, oracle
from std_srvs.srv import Trigger

from dae_ros.weights.codec import decode_policy, sha256

NEWEST = 2**64 - 1


@pytest.fixture
def listener(domain):
    with Listener() as listener:
        yield listener


def test_a_paused_training_waits_saves_and_goes_on_to_the_same_weights(make_graph, listener, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    graph.start_paused(listener)
    saved = listener.call(Trigger, 'trainer/save', Trigger.Request())
    assert saved.success and list(graph.folder.checkpoints.iterdir())
    assert listener.call(Trigger, 'trainer/resume', Trigger.Request()).success
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', SMALL)


def test_the_parameter_server_gives_any_version_it_keeps_and_says_which_it_does_not(make_graph, listener, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    graph.start('parameter_server')
    nothing = listener.call(GetPolicy, 'get_policy', GetPolicy.Request(version=NEWEST))
    assert not nothing.success and nothing.message == 'there is no policy yet'
    graph.start(*(name for name in graph.names if name != 'parameter_server'))
    assert graph.wait() == 0, graph.log('trainer')
    newest = listener.call(GetPolicy, 'get_policy', GetPolicy.Request(version=NEWEST))
    assert newest.success and newest.policy.version == 5 and newest.policy.run == graph.folder.run
    data = bytes(newest.policy.data)
    assert sha256(data) == newest.policy.sha256
    assert data == graph.folder.policy_file.read_bytes()
    decode_policy(data)
    assert listener.call(GetPolicy, 'get_policy', GetPolicy.Request(version=4)).success
    gone = listener.call(GetPolicy, 'get_policy', GetPolicy.Request(version=0))
    assert not gone.success and gone.message == 'policy version 0 is not kept'
