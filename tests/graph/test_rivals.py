"""Two trainings that get in each other's way: each ends by itself, says so, or ends with its own weights."""

from __future__ import annotations

from dae_ros_msgs.msg import TrainingStatus
from harness import SMALL, Listener, bringup, finish, oracle, processes_naming
from std_srvs.srv import Trigger

from dae_ros.ros import names


def test_a_second_trainer_in_the_namespace_says_whose_the_team_is_and_ends_and_the_first_run_has_its_weights(
        make_graph, tmp_path):
    first = make_graph(tmp_path / 'first', SMALL)
    second = make_graph(tmp_path / 'second', {**SMALL, 'seed': 2})
    first.start(*first.names)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 1)
        listener.call(Trigger, names.PAUSE, Trigger.Request())
        listener.wait_for_status(lambda status: status.state == TrainingStatus.PAUSED)
        second.start('trainer')
        assert second.wait() == 2
        listener.call(Trigger, names.RESUME, Trigger.Request())
    assert f'error: another trainer is at work here: its run {first.folder.run:x} has ' in second.log('trainer')
    assert 'Traceback' not in second.log('trainer')
    assert first.wait() == 0, first.log('trainer')
    assert first.result() == oracle(tmp_path / 'alone', SMALL)


def test_a_second_run_in_the_same_folder_says_so_and_ends_and_the_first_has_its_weights(make_graph, tmp_path):
    graph = make_graph(tmp_path / 'run', SMALL)
    graph.start(*graph.names)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 1)
        listener.call(Trigger, names.PAUSE, Trigger.Request())
        code, output, errors = finish(bringup(tmp_path / 'run', SMALL, '--namespace', 'other'))
        assert code == 2 and f'another trainer is at work in {tmp_path / "run"}' in errors
        assert 'Traceback' not in output + errors
        assert not any('__ns:=/other' in line for line in processes_naming(str(tmp_path)))
        listener.call(Trigger, names.RESUME, Trigger.Request())
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', SMALL)
