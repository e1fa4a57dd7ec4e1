"""The world's end of the lockstep: it says what comes about, steps once all have acted, and refuses what does not belong."""

from __future__ import annotations

import pytest

from dae_ros.rollout.lockstep import WorldEnd
from tests.played import (
    ACTIONS,
    OBSERVATIONS,
    REQUEST,
    REWARDS,
    STATES,
    Bad,
    Drifting,
    N,
    T,
    agent_with,
    assert_same,
    malformed_actions,
    misplaced,
    refused,
    stamped,
)


def world_at(step):
    """A world end that took in the first steps of the rollout."""
    world = WorldEnd(Drifting())
    world.on_request(REQUEST)
    for at in range(step):
        for robot in range(N):
            world.on_action(ACTIONS[robot][at])
    return world


def rest_of(world, step):
    """What the world says from a step to the end of the rollout."""
    return [datum for at in range(step, T) for robot in range(N) for datum in world.on_action(ACTIONS[robot][at])]


FROM_STEP = [rest_of(world_at(step), step) for step in range(T + 1)]


def test_the_world_says_the_observations_first_and_the_joint_state_and_reward_of_each_step():
    world = WorldEnd(Drifting())
    assert world.waiting_for == []
    assert_same(world.on_request(REQUEST), [OBSERVATIONS[0][0], OBSERVATIONS[1][0], STATES[0]])
    for step in range(T):
        assert world.waiting_for == [0, 1]
        assert world.on_action(ACTIONS[1][step]) == []
        assert world.waiting_for == [0]
        said = world.on_action(ACTIONS[0][step])
        observations = [OBSERVATIONS[robot][step + 1] for robot in range(N)] if step + 1 < T else []
        assert_same(said, [REWARDS[step], *observations, STATES[step + 1]])
    assert world.waiting_for == []


def bad_for_the_world(step):
    action = ACTIONS[0][step]
    bad = misplaced(action, T - 1)[:-2] + malformed_actions(action)
    bad += [Bad('unexpected', stamped(action, step=later)) for later in (step + 1, T, 2**32 - 1)]
    bad += [Bad('duplicate', stamped(action, step=earlier)) for earlier in range(step)]
    return bad


@pytest.mark.parametrize('step', range(T))
def test_the_world_refuses_actions_that_do_not_belong_and_nothing_changes(step):
    for bad in bad_for_the_world(step):
        world = world_at(step)
        refused(bad.reason, world.on_action, bad.datum)
        assert world.waiting_for == [0, 1]
        assert world.on_action(ACTIONS[1][step]) == []
        refused(bad.reason, world.on_action, bad.datum)
        assert world.waiting_for == [0] and world.request == REQUEST
        said = [*world.on_action(ACTIONS[0][step]), *rest_of(world, step + 1)]
        assert_same(said, FROM_STEP[step])


def test_the_world_takes_each_robot_s_first_action_of_a_step_and_refuses_the_second():
    world = world_at(1)
    world.on_action(ACTIONS[0][1])
    other = ACTIONS[0][1]._replace(actions=ACTIONS[0][1].probabilities.argmin(1))
    for again in (ACTIONS[0][1], other):
        refused('duplicate', world.on_action, again)
    said = [*world.on_action(ACTIONS[1][1]), *rest_of(world, 2)]
    assert_same(said, FROM_STEP[1])


def test_the_world_refuses_actions_before_a_rollout_and_after_its_last_step():
    for world in (WorldEnd(Drifting()), WorldEnd(Drifting(), run=5)):
        refused('unexpected', world.on_action, ACTIONS[0][0])
    world = world_at(T)
    refused('duplicate', world.on_action, ACTIONS[0][T - 1])
    refused('unexpected', world.on_action, stamped(ACTIONS[0][T - 1], step=T))


def test_the_world_begins_anew_for_a_later_request_and_for_no_other():
    world = world_at(2)
    for reason, request in [
            ('duplicate', REQUEST), ('duplicate', REQUEST._replace(seed=12)), ('stale', REQUEST._replace(rollout=2)),
            ('stale', REQUEST._replace(rollout=4, attempt=0)), ('wrong_run', REQUEST._replace(run=6, rollout=9)),
            ('wrong_run', REQUEST._replace(run=0, rollout=9))]:
        refused(reason, world.on_request, request)
        assert world.request == REQUEST and world.waiting_for == [0, 1]
    assert_same(rest_of(world, 2), FROM_STEP[2])
    world = world_at(2)
    world.on_action(ACTIONS[0][2])
    said = world.on_request(REQUEST._replace(attempt=2))
    assert_same(said, [stamped(datum, attempt=2) for datum in (OBSERVATIONS[0][0], OBSERVATIONS[1][0], STATES[0])])
    refused('stale', world.on_action, ACTIONS[1][2])
    assert world.waiting_for == [0, 1]


def test_world_and_agent_follow_a_trainer_that_came_back_at_an_earlier_rollout_and_no_message_from_before():
    world, agent = world_at(2), agent_with(0, 1)
    back = REQUEST._replace(rollout=1, attempt=2)
    assert world.on_request(back)[0].stamp.order == back.order
    agent.on_request(back)
    for late in (REQUEST, REQUEST._replace(rollout=9)):
        refused('stale', world.on_request, late)
        refused('stale', agent.on_request, late)
    refused('stale', world.on_action, ACTIONS[0][2])
    refused('stale', agent.on_observation, OBSERVATIONS[0][2])
    assert world.request == agent.request == back
    assert agent.on_observation(stamped(OBSERVATIONS[0][0], rollout=1, attempt=2)) is not None


def test_a_world_without_a_run_joins_that_of_its_first_request_and_one_with_a_run_keeps_it():
    world = WorldEnd(Drifting())
    world.on_request(REQUEST)
    assert world.run == 5
    bound = WorldEnd(Drifting(), run=6)
    refused('wrong_run', bound.on_request, REQUEST)
    assert bound.request is None
    refused('wrong_run', WorldEnd(Drifting()).on_request, REQUEST._replace(run=0))
