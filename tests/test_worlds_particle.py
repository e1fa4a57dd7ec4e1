"""The particle tasks against PettingZoo's mpe2, an implementation that is not ours, and against their contract."""

import numpy as np
import pytest
from mpe2 import simple_formation_v1, simple_line_v1, simple_spread_v3
from mpe2._mpe_utils.core import World

from dae_ros.config import TaskSettings
from dae_ros.errors import WorldError
from dae_ros.worlds import make_worlds

PEERS = {'navigation': simple_spread_v3, 'formation': simple_formation_v1, 'line': simple_line_v1}
PEER_ACTION = np.array([0, 2, 1, 4, 3])  # mpe2 counts -x before +x and -y before +y
TASKS = tuple(PEERS)


def particle_worlds(task, num_agents=3, num_worlds=4, **settings):
    return make_worlds(TaskSettings(task=task, num_agents=num_agents, num_worlds=num_worlds, **settings))


def random_actions(worlds, num_steps, seed=0):
    shape = (num_steps, worlds.num_worlds, worlds.spec.num_agents)
    return np.random.default_rng(seed).integers(worlds.spec.num_actions, size=shape)


def velocity_first(world, forces):
    """The order of integration of the paper's simulator; mpe2 moves the position before it changes the velocity."""
    for entity, force in zip(world.entities, forces):
        if entity.movable:
            entity.state.p_vel = entity.state.p_vel * (1 - world.damping) + force / entity.mass * world.dt
            entity.state.p_pos = entity.state.p_pos + entity.state.p_vel * world.dt


class Peers:
    """W instances of mpe2's task, side by side."""

    def __init__(self, task, num_agents, num_worlds, robots_within):
        self.task = task
        self.environments = [PEERS[task].parallel_env(N=num_agents, max_cycles=1000) for _ in range(num_worlds)]
        for seed, environment in enumerate(self.environments):
            environment.reset(seed=seed)
            for agent in environment.unwrapped.world.agents:
                agent.state.p_pos = agent.state.p_pos * robots_within

    def gather(self, entities, quantity):
        return np.array([[getattr(entity.state, quantity) for entity in getattr(environment.unwrapped.world, entities)]
                         for environment in self.environments])

    def step(self, actions):
        """Rewards [W], as the paper defines them."""
        rewards = []
        for environment, joint_action in zip(self.environments, PEER_ACTION[actions]):
            returned = environment.step(dict(zip(environment.possible_agents, joint_action)))[1]
            if self.task == 'navigation':
                # mpe2 gives agent i half of -(sum of distances) and half of -(its collisions). The paper's reward is
                # the sum over agents of both in full, and its simulator lets every agent collide with itself.
                rewards.append(2.0 * sum(returned.values()) - len(returned))
            else:
                rewards.append(np.mean(list(returned.values())))
        return np.array(rewards)

    def observations(self):
        return np.array([[peer.scenario.observation(agent, peer.world) for agent in peer.world.agents]
                         for peer in (environment.unwrapped for environment in self.environments)])


@pytest.mark.parametrize('num_agents', [1, 2, 3, 4, 5, 7])
@pytest.mark.parametrize('task', TASKS)
def test_an_episode_with_contacts_is_that_of_mpe2_step_by_step(task, num_agents, monkeypatch):
    monkeypatch.setattr(World, 'integrate_state', velocity_first)
    worlds = particle_worlds(task, num_agents, episode_steps=1000)
    peers = Peers(task, num_agents, worlds.num_worlds, robots_within=2.0 * worlds.radius)
    worlds.reset(seed=0, rollout=0)
    worlds.set_state(peers.gather('agents', 'p_pos'), peers.gather('agents', 'p_vel'),
                     peers.gather('landmarks', 'p_pos'))

    contacts = 0
    for actions in random_actions(worlds, 25):
        separation = worlds.positions[:, :, None] - worlds.positions[:, None]
        contacts += np.count_nonzero(np.linalg.norm(separation, axis=-1) < 2.0 * worlds.radius) - 4 * num_agents
        peer_rewards = peers.step(actions)
        transition = worlds.step(actions)
        np.testing.assert_allclose(worlds.positions, peers.gather('agents', 'p_pos'), rtol=0, atol=1e-9)
        np.testing.assert_allclose(worlds.velocities, peers.gather('agents', 'p_vel'), rtol=0, atol=1e-9)
        np.testing.assert_allclose(worlds.exact_observations, peers.observations(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(worlds.reward(), peer_rewards, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(transition.next.observations, worlds.exact_observations.astype(np.float32))
        np.testing.assert_array_equal(transition.reward, worlds.reward().astype(np.float32))
    assert contacts > 0 or num_agents == 1


@pytest.mark.parametrize('task', TASKS)
def test_a_step_changes_velocities_as_in_mpe2_as_it_is(task):
    worlds = particle_worlds(task, num_agents=4, num_worlds=8)
    peers = Peers(task, 4, 8, robots_within=2.0 * worlds.radius)
    worlds.reset(seed=0, rollout=0)
    worlds.set_state(peers.gather('agents', 'p_pos'), 0.0, peers.gather('landmarks', 'p_pos'))
    actions = random_actions(worlds, 1)[0]
    peers.step(actions)
    worlds.step(actions)
    np.testing.assert_allclose(worlds.velocities, peers.gather('agents', 'p_vel'), rtol=0, atol=1e-12)


def test_actions_push_right_left_up_and_down():
    worlds = particle_worlds('line', num_agents=5, num_worlds=1)
    worlds.reset(seed=0, rollout=0)
    worlds.set_state(np.arange(10.0).reshape(1, 5, 2), 0.0, worlds.landmarks.copy())
    worlds.step(np.array([[0, 1, 2, 3, 4]]))
    np.testing.assert_allclose(worlds.velocities[0], [[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    np.testing.assert_allclose(worlds.positions[0], np.arange(10.0).reshape(5, 2) + 0.1 * worlds.velocities[0])


@pytest.mark.parametrize('num_agents', [1, 3, 10])
@pytest.mark.parametrize('task', TASKS)
def test_a_world_does_not_depend_on_how_many_others_there_are(task, num_agents):
    many = particle_worlds(task, num_agents, num_worlds=301)
    actions = random_actions(many, 55)
    for num_worlds in (1, 2, 7):
        few = particle_worlds(task, num_agents, num_worlds)
        joint, joint_of_few = many.reset(seed=3, rollout=4), few.reset(seed=3, rollout=4)
        for step_actions in actions:
            assert joint_of_few[3:] == joint[3:] == (None, None)  # no masks, nobody leaves
            for ours, expected in zip(joint_of_few[:3], joint):
                np.testing.assert_array_equal(ours, expected[:num_worlds])
            transition, of_few = many.step(step_actions), few.step(step_actions[:num_worlds])
            np.testing.assert_array_equal(of_few.reward, transition.reward[:num_worlds])
            joint, joint_of_few = transition.next, of_few.next


@pytest.mark.parametrize('task', TASKS)
def test_an_episode_begins_as_its_seed_rollout_and_step_say(task):
    worlds = particle_worlds(task, num_worlds=16)

    def first_observations(seed, rollout, actions):
        """Of the first and the second episode of a rollout."""
        first = worlds.reset(seed, rollout).observations
        for step_actions in actions:
            second = worlds.step(step_actions).next.observations
        return first, second

    first, second = first_observations(1, 1, random_actions(worlds, 25, seed=1))
    again, second_again = first_observations(1, 1, random_actions(worlds, 25, seed=2))
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(second_again, second)
    assert not np.array_equal(first, second)
    for seed, rollout in ((2, 1), (1, 2)):
        other, _ = first_observations(seed, rollout, random_actions(worlds, 25))
        assert not np.array_equal(other, first)


@pytest.mark.parametrize('task', TASKS)
def test_the_25th_step_ends_the_episode_as_terminated_and_begins_the_next(task):
    worlds, endless = particle_worlds(task), particle_worlds(task, episode_steps=1000)
    assert worlds.reset(seed=1, rollout=0).episode_start.all()
    endless.reset(seed=1, rollout=0)
    for step, actions in enumerate(random_actions(worlds, 60), start=1):
        transition = worlds.step(actions)
        ended = step % 25 == 0
        assert (transition.terminated == ended).all()
        assert (transition.next.episode_start == ended).all()
        assert not transition.truncated.any()
        assert transition.final_states.shape == (0, worlds.spec.state_size)
        if ended:
            assert not transition.next.observations[:, :, :2].any(), 'robots start at rest'
        if step <= 25:
            np.testing.assert_array_equal(transition.reward, endless.step(actions).reward)


@pytest.mark.parametrize('task', TASKS)
def test_the_state_is_the_observations_one_after_another(task):
    worlds = particle_worlds(task, num_agents=4)
    assert worlds.spec.state_is_observations
    assert worlds.spec.state_size == 4 * worlds.spec.observation_size
    joint = worlds.reset(seed=1, rollout=0)
    assert joint.observations.dtype == joint.state.dtype == np.float32
    np.testing.assert_array_equal(joint.state, joint.observations.reshape(4, -1))


def test_what_a_step_returned_stays_as_it_was():
    worlds = particle_worlds('navigation')
    joint = worlds.reset(seed=1, rollout=0)
    before = [array.copy() for array in joint[:3]]
    for actions in random_actions(worlds, 30):
        worlds.step(actions)
    for array, copy in zip(joint, before):
        np.testing.assert_array_equal(array, copy)


def test_robots_and_landmarks_start_where_the_paper_places_them():
    for task in TASKS:
        worlds = particle_worlds(task, num_agents=5, num_worlds=4000)
        worlds.reset(seed=1, rollout=0)
        assert 0.999 < np.abs(worlds.positions).max() <= 1.0
        assert not worlds.velocities.any()
        if task == 'navigation':
            assert worlds.landmarks.shape == (4000, 5, 2)
            assert 0.799 < np.abs(worlds.landmarks).max() <= 0.8
        elif task == 'formation':
            assert 0.499 < np.abs(worlds.landmarks).max() <= 0.5
        else:
            start, end = worlds.landmarks[:, 0], worlds.landmarks[:, 1]
            assert 0.249 < np.abs(start).max() <= 0.25
            assert np.abs(end).max() < 1.0
            np.testing.assert_allclose(np.linalg.norm(end - start, axis=-1), 1.25)


@pytest.mark.parametrize('task', ['formation', 'line'])
def test_robots_of_formation_and_line_can_observe_the_others(task):
    alone, together = particle_worlds(task, 4), particle_worlds(task, 4, observe_others=True)
    size = alone.spec.observation_size
    assert together.spec.observation_size == size + 2 * 3
    without, observations = (worlds.reset(seed=1, rollout=0).observations for worlds in (alone, together))
    np.testing.assert_array_equal(observations[:, :, :size], without)
    positions = together.positions
    others = positions[:, [0, 1, 3]] - positions[:, [2]]
    np.testing.assert_array_equal(observations[:, 2, size:], others.reshape(4, 6).astype(np.float32))


@pytest.mark.parametrize('task', TASKS)
def test_robots_in_the_very_same_place_do_no_harm(task):
    worlds = particle_worlds(task)
    worlds.reset(seed=1, rollout=0)
    worlds.set_state(worlds.landmarks[:, :1].copy(), 0.0, worlds.landmarks.copy())
    transition = worlds.step(np.zeros((4, 3), dtype=np.int64))
    assert np.isfinite(transition.reward).all() and np.isfinite(transition.next.state).all()


@pytest.mark.parametrize('actions, complaint', [
    (np.zeros((4, 2), dtype=np.int64), r'shape \(worlds, robots\) = \(4, 3\), not \(4, 2\)'),
    (np.zeros(12, dtype=np.int64), r'not \(12,\)'),
    (np.zeros((4, 3)), 'integers, not float64'),
    (np.zeros((4, 3), dtype=bool), 'integers, not bool'),
    (np.full((4, 3), 5), r'0 \.\. 4, not 5'),
    (np.full((4, 3), -1), r'0 \.\. 4, not -1'),
])
def test_actions_that_are_none_are_refused(actions, complaint):
    worlds = particle_worlds('navigation')
    worlds.reset(seed=1, rollout=0)
    with pytest.raises(ValueError, match=complaint):
        worlds.step(actions)


def test_actions_may_come_as_the_unsigned_integers_of_a_message():
    worlds, twin = particle_worlds('navigation'), particle_worlds('navigation')
    worlds.reset(seed=1, rollout=0), twin.reset(seed=1, rollout=0)
    actions = random_actions(worlds, 1)[0]
    np.testing.assert_array_equal(worlds.step(actions.astype(np.uint16)).next.state, twin.step(actions).next.state)


def test_worlds_must_be_reset_before_their_first_step():
    with pytest.raises(WorldError, match='reset'):
        particle_worlds('navigation').step(np.zeros((4, 3), dtype=np.int64))
