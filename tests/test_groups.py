"""Groups of worlds: their rollouts are joined in the order of the groups, draw nothing twice, and never mix."""

import random

import numpy as np
import pytest
from hypothesis import given, settings, strategies

from dae_ros import config, draws
from dae_ros.config import TaskSettings
from dae_ros.errors import Refused, SettingsError
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.rollout.groups import GroupedAssembler, join
from dae_ros.rollout.in_process import InProcessCollector
from dae_ros.rollout.lockstep import AgentEnd, WorldEnd
from dae_ros.ros.graph import training_graph
from dae_ros.ros.names import in_group
from dae_ros.run_folder import RunFolder
from dae_ros.types import Action, JointState, Observation, RolloutRequest, SharedReward, Trajectory, WorldSpec
from dae_ros.worlds import make_worlds, world_spec
from dae_ros.worlds.base import JointObservation, Transition, Worlds

T, W, N, G = 6, 4, 2, 3
TASK = TaskSettings(num_agents=N, num_worlds=G * W, world_groups=G, episode_steps=3)
SPEC = world_spec(TASK)
SIZES = PolicyArchitecture(SPEC.observation_size, SPEC.num_actions, hidden_size=4, mlp_layers=1, activation='relu')
REQUEST = RolloutRequest(run=5, rollout=3, attempt=0, policy_version=7, seed=11, num_steps=T, greedy=False)


def make_policy(architecture):
    generator = np.random.default_rng(0)
    return Policy(architecture, {name: generator.normal(size=shape).astype(np.float32)
                                 for name, shape in architecture.shapes().items()})


POLICY = make_policy(SIZES)


def collect(request=REQUEST, world_groups=G, task=TASK):
    return InProcessCollector(make_worlds(task), world_groups).collect(request, POLICY)


def assert_same(one, other):
    for name, left, right in zip(Trajectory._fields, one, other):
        if left is None or right is None:
            assert left is right, name
            continue
        assert left.dtype == right.dtype and left.shape == right.shape, name
        np.testing.assert_array_equal(left, right, name)


def group_of(trajectory, group):
    """One group's part of a trajectory without final states."""
    part = slice(group * W, (group + 1) * W)
    return trajectory._replace(final_states=None).map(lambda array: array[:, part])._replace(final_states=trajectory.final_states)


# Joining.


@settings(max_examples=200, deadline=None, derandomize=True)
@given(data=strategies.data(), num_steps=strategies.integers(1, 4), num_worlds=strategies.integers(1, 3),
       num_groups=strategies.integers(1, 4))
def test_groups_that_a_trajectory_is_cut_into_are_joined_to_the_same_trajectory(data, num_steps, num_worlds, num_groups):
    T, W, N, O, A, S = num_steps, num_worlds * num_groups, 2, 3, 2, 2
    flags = data.draw(strategies.lists(strategies.sampled_from('-ex'), min_size=T * W, max_size=T * W))
    ends = np.array(flags).reshape(T, W)

    def numbered(*shape):
        return np.arange(np.prod(shape)).reshape(shape)

    truncated = ends == 'x'
    states = numbered(T, W, S).astype(np.float32)
    whole = Trajectory(numbered(T, W, N, O).astype(np.float32), numbered(T + 1, W, S).astype(np.float32),
                       numbered(T + 1, W) % 3 == 0, numbered(T, W, N), numbered(T, W, N, A).astype(np.float32),
                       numbered(T, W).astype(np.float32), ends == 'e', truncated, states[truncated],
                       numbered(T, W, N, A) % 3 > 0, numbered(T, W, N) % 5 > 0)
    parts = []
    for group in range(num_groups):
        own = slice(group * num_worlds, (group + 1) * num_worlds)
        parts.append(whole._replace(final_states=None).map(lambda array: array[:, own])._replace(
            final_states=states[:, own][truncated[:, own]]))
    assert_same(join(parts), whole)


def test_a_single_trajectory_is_not_copied():
    trajectory = collect(world_groups=1)
    assert join([trajectory]) is trajectory


# Draws.


def test_the_first_group_draws_under_the_run_s_seed_and_every_other_under_one_of_its_own():
    seeds = [draws.group_seed(seed, group) for seed in (0, 1, 2, 2**63 - 1) for group in range(1024)]
    assert seeds[::1024] == [0, 1, 2, 2**63 - 1]
    assert len(set(seeds)) == len(seeds)
    assert draws.group_seed(1, 1) == draws.key(1, 'group', 1) == 299612597553511421444683371151706537866


def test_the_first_group_has_the_rollout_it_has_alone():
    alone = InProcessCollector(make_worlds(config.TaskSettings(num_agents=N, num_worlds=W, episode_steps=3))).collect(
        REQUEST, POLICY)
    assert_same(group_of(collect(), 0), alone)


def test_no_two_groups_have_an_episode_or_a_draw_of_an_action_in_common():
    trajectory = collect()
    for start in np.flatnonzero(trajectory.episode_start[:, 0]):
        episodes = trajectory.states[start]
        assert len(np.unique(episodes, axis=0)) == G * W
    same = Policy(SIZES, {name: np.zeros_like(tensor) for name, tensor in POLICY.tensors.items()})  # acts on nothing it sees
    drawn = InProcessCollector(make_worlds(TASK), G).collect(REQUEST, same).actions
    assert len({drawn[:, group * W:(group + 1) * W].tobytes() for group in range(G)}) == G


def test_a_collector_gives_the_same_rollout_again_after_another():
    collector = InProcessCollector(make_worlds(TASK), G)
    collector.collect(REQUEST._replace(rollout=2), POLICY)
    assert_same(collector.collect(REQUEST, POLICY), collect())


# Assembling.


def play(group, request=REQUEST, worlds=None, policy=POLICY):
    """What a group's world and agents say to the trainer in a rollout, with worlds of their own."""
    world, agents = WorldEnd(worlds or make_worlds(TASK), group=group), [AgentEnd(robot, group=group) for robot in range(N)]
    for agent in agents:
        agent.on_request(request)
        agent.on_policy(request.run, request.policy_version, policy)
    said, new = [], world.on_request(request)
    while new:
        said += [datum for datum in new if not isinstance(datum, Observation)]
        actions = [agents[datum.robot].on_observation(datum) for datum in new if isinstance(datum, Observation)]
        said += actions
        new = [datum for action in actions for datum in world.on_action(action)]
    return said


def hand_over(assembler, datum):
    take = {JointState: assembler.on_joint_state, Action: assembler.on_action, SharedReward: assembler.on_reward}
    take[type(datum)](datum)


DATA = [play(group) for group in range(G)]


def assembler_of(request=REQUEST):
    assembler = GroupedAssembler(SPEC, W, G)
    assembler.begin(request)
    return assembler


@pytest.mark.parametrize('late', range(G))
def test_a_rollout_is_complete_when_every_group_s_is_and_until_then_says_what_which_group_lacks(late):
    assembler = assembler_of()
    for group in range(G):
        for datum in DATA[group] if group != late else DATA[group][:-1]:
            assert not assembler.complete
            hand_over(assembler.groups[group], datum)
    assert not assembler.complete
    assert assembler.missing() == f'in group {late} 1 of 7 joint states, 0 of 6 rewards, actions of no robot'
    hand_over(assembler.groups[late], DATA[late][-1])
    assert assembler.complete
    assert_same(assembler.trajectory(), collect())


def test_one_group_s_data_never_count_for_another():
    assembler = assembler_of()
    for datum in DATA[0] * 2:
        try:
            hand_over(assembler.groups[0], datum)
        except Refused as refusal:
            assert refusal.reason == Refused.DUPLICATE
    assert assembler.groups[0].complete and not assembler.complete
    assert assembler.missing() == '; '.join(f'in group {group} 7 of 7 joint states, 6 of 6 rewards, actions of robots 0, 1'
                                            for group in (1, 2))


def test_a_rollout_begun_anew_is_begun_anew_in_every_group():
    assembler = assembler_of()
    for group in (0, 1):
        for datum in DATA[group]:
            hand_over(assembler.groups[group], datum)
    again = REQUEST._replace(attempt=1)
    assembler.begin(again)
    with pytest.raises(Refused, match='stale'):
        hand_over(assembler.groups[2], DATA[2][0])
    for group in range(G):
        for datum in play(group, again):
            hand_over(assembler.groups[group], datum)
    assert_same(assembler.trajectory(), collect())


class CutOff(Worlds):
    """Worlds whose episodes are cut off here and there, at other steps in other groups."""

    spec, num_worlds = WorldSpec(N, 2, 1, 2, state_is_observations=False), W

    def reset(self, seed, rollout):
        self._draw = draws.generator(seed, 'cut off', rollout)
        return self._show(np.ones(W, bool))

    def step(self, actions):
        finals, truncated = self._draw.random((W, 2), np.float32), self._draw.random(W) < 0.4
        return Transition(actions.sum(1).astype(np.float32), np.zeros(W, bool), truncated, finals[truncated],
                          self._show(truncated))

    def _show(self, start):
        return JointObservation(self._draw.random((W, N, 1), np.float32), self._draw.random((W, 2), np.float32), start)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=strategies.integers(0, 2**32))
def test_data_of_all_groups_in_any_order_are_joined_to_the_trajectory_of_the_run_in_one_process(seed):
    policy = make_policy(PolicyArchitecture(1, 2, hidden_size=4, mlp_layers=1, activation='relu'))
    expected = InProcessCollector(CutOff(), G).collect(REQUEST, policy)
    data = [(group, datum) for group in range(G) for datum in play(group, worlds=CutOff(), policy=policy)]
    random.Random(seed).shuffle(data)
    assembler = GroupedAssembler(CutOff.spec, W, G)
    assembler.begin(REQUEST)
    for group, datum in data:
        hand_over(assembler.groups[group], datum)
    assert_same(assembler.trajectory(), expected)
    assert expected.truncated.sum() == len(expected.final_states) > 0


# Settings, names and processes.


def test_worlds_that_cannot_be_split_into_groups_of_equal_size_are_an_error_that_names_both_settings():
    sentence = 'num_worlds = 128 worlds cannot be split into world_groups = 3 groups of equal size'
    for make in (lambda: TaskSettings(world_groups=3), lambda: config.from_flat({'world_groups': 3})):
        with pytest.raises(SettingsError) as caught:
            make()
        assert str(caught.value) == sentence
    assert config.from_flat({'world_groups': 3, 'num_worlds': 9}).task.worlds_per_group == 3


def test_a_group_that_is_not_there_is_an_error_that_names_both_settings():
    config.check_group(0, 1)
    config.check_group(1, 2)
    with pytest.raises(SettingsError, match=r'group must lie in 0 \.\. 1 where world_groups is 2, not 2'):
        config.check_group(2, 2)


@pytest.mark.parametrize('task', ['navigation', 'matrix_game', 'pettingzoo:mpe2.simple_spread_v3'])
def test_the_worlds_of_a_group_are_its_share_and_its_sizes_those_of_the_task(task):
    whole = TaskSettings(task=task, num_worlds=6)
    parts = TaskSettings(task=task, num_worlds=6, world_groups=3)
    worlds = make_worlds(parts)
    assert worlds.num_worlds == 2
    assert worlds.spec == world_spec(parts) == world_spec(whole)
    worlds.close()


def test_topics_lie_under_their_group_where_there_are_several():
    assert in_group('joint_state', 0, 1) == 'joint_state'
    assert [in_group('joint_state', group, 2) for group in (0, 1)] == ['group_0/joint_state', 'group_1/joint_state']


def processes(tmp_path, **task):
    settings = config.from_flat({'num_agents': 2, **task})
    return {process.name: process for process in training_graph(settings, RunFolder(tmp_path, settings))}


def test_one_group_s_processes_are_named_as_ever_and_those_of_several_after_their_group(tmp_path):
    one = processes(tmp_path / 'one', robots_per_process=1)
    assert list(one) == ['world', 'agent_0', 'agent_1', 'parameter_server', 'trainer']
    two = processes(tmp_path / 'two', robots_per_process=1, world_groups=2)
    assert list(two) == ['world_0', 'agent_0_0', 'agent_0_1', 'world_1', 'agent_1_0', 'agent_1_1', 'parameter_server', 'trainer']
    agent = two['agent_1_0']
    assert (agent.executable, agent.parameters['group'], agent.parameters['robot']) == ('agent', 1, 0)
    assert (two['world_1'].executable, two['world_1'].parameters['group']) == ('world', 1)


@pytest.mark.parametrize('together, expected', [
    (0, {'agents_0-4': (0, 5)}), (1000, {'agents_0-4': (0, 5)}), (3, {'agents_0-2': (0, 3), 'agents_3-4': (3, 2)}),
    (2, {'agents_0-1': (0, 2), 'agents_2-3': (2, 2), 'agent_4': (4, None)})])
def test_robots_share_processes_as_many_as_are_asked_for_each_with_a_node_of_its_own(together, expected, tmp_path):
    found = processes(tmp_path / 'run', num_agents=5, robots_per_process=together)
    assert list(found) == ['world', *expected, 'parameter_server', 'trainer']
    agents = [found[name] for name in expected]
    assert [node for process in agents for node in process.nodes] == [f'agent_{robot}' for robot in range(5)]
    assert [(process.parameters['robot'], process.parameters.get('robots')) for process in agents] == list(expected.values())


def test_nodes_of_a_process_of_several_groups_bear_their_group(tmp_path):
    agents = processes(tmp_path / 'run', world_groups=2)['agents_1_0-1']
    assert agents.nodes == ('agent_1_0', 'agent_1_1')
    assert (agents.parameters['group'], agents.parameters['robot'], agents.parameters['robots']) == (1, 0, 2)
