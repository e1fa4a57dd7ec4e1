"""The learner: an update against the paper's formulas in plain PyTorch, and what must not change it by a bit."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from dae_ros.config import LearnerSettings, RewardNetworkSettings
from dae_ros.learning.learner import Learner
from dae_ros.learning.networks import REWARD_NETWORKS, RewardNetwork
from dae_ros.learning.policy import choose
from dae_ros.types import Trajectory, WorldSpec
from dae_ros.weights.codec import decode_checkpoint, encode_checkpoint, encode_policy

SPEC = WorldSpec(num_agents=3, num_actions=4, observation_size=5, state_size=7, state_is_observations=False)
LEARNER = LearnerSettings(hidden_size=8, epochs=2, beta=0.9, learner_threads=1)
REWARD = RewardNetworkSettings('per_agent', hidden_size=12, trunk_size=10, epochs=2)
SHARED_TRUNK = replace(REWARD, architecture='shared_trunk')
COMA = replace(LEARNER, estimator='coma')
REPLAY = replace(REWARD, replay_rollouts=2, replay_steps=5, replay_chunks=3)
REWARDS = pytest.mark.parametrize('reward_settings', [REWARD, SHARED_TRUNK], ids=['per agent', 'shared trunk'])

# Adam's first step is learning_rate * g / (|g| + epsilon): with an epsilon of 1 the weights show the gradient itself.
PLAIN = replace(LEARNER, epochs=1, adam_epsilon=1.0, learning_rate=1.0)
PLAIN_REWARD = replace(REWARD, epochs=1, learning_rate=1.0)


def random_trajectory(steps=7, worlds=3, spec=SPEC, seed=0, terminations=0.15, truncations=0.15):
    """A rollout of noise, with episodes that end for good and others that are cut off in its middle."""
    random = np.random.default_rng(seed)
    T, W, (N, A, O, S, *_) = steps, worlds, spec
    terminated = random.random((T, W)) < terminations
    truncated = ~terminated & (random.random((T, W)) < truncations)
    probabilities = random.dirichlet(np.ones(A), (T, W, N)).astype(np.float32)
    actions = (probabilities.cumsum(-1) < random.random((T, W, N, 1))).sum(-1).clip(max=A - 1)
    return Trajectory(
        observations=random.normal(size=(T, W, N, O)).astype(np.float32),
        states=random.normal(size=(T + 1, W, S)).astype(np.float32),
        episode_start=np.concatenate([np.ones((1, W), bool), terminated | truncated]),
        actions=actions.astype(np.int64), probabilities=probabilities,
        rewards=random.normal(-1, 2, (T, W)).astype(np.float32), terminated=terminated, truncated=truncated,
        final_states=random.normal(size=(int(truncated.sum()), S)).astype(np.float32))


@pytest.fixture
def make_learner():
    """Makes learners and ends their threads."""
    made = []

    def make(settings=LEARNER, reward_settings=REWARD, spec=SPEC, seed=1):
        made.append(Learner(spec, settings, reward_settings, seed))
        return made[-1]

    yield make
    for learner in made:
        learner.close()


def state_of(learner):
    """A copy of all that the learner learnt."""
    return {name: tensor.copy() for name, tensor in learner.state().items()}


def assert_same_bits(one, other):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


def parameters(state, network):
    prefix = f'{network}.parameters.'
    return {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}


def same_weights(one, other, network):
    one, other = parameters(one, network), parameters(other, network)
    return bool(one) and all(np.array_equal(one[name], other[name]) for name in one)


# The same update, written down from the formulas in float64 without a thought for speed.


def layer_norm(x, p, name):
    return functional.layer_norm(x, x.shape[-1:], p[f'{name}.weight'], p[f'{name}.bias'])


def linear(x, p, name):
    return x @ p[f'{name}.weight'].t() + p[f'{name}.bias']


def gru_step(x, state, p):
    from_input = x @ p['gru.weight_ih'].t() + p['gru.bias_ih']
    from_state = state @ p['gru.weight_hh'].t() + p['gru.bias_hh']
    (r, z, n), (r_state, z_state, n_state) = from_input.chunk(3, -1), from_state.chunk(3, -1)
    reset, update = torch.sigmoid(r + r_state), torch.sigmoid(z + z_state)
    return (1 - update) * torch.tanh(n + reset * n_state) + update * state


def memories(x, p, start, cut):
    """States [T, rows, H] of the GRU; gradients end where `cut` begins a new chunk."""
    state, states = torch.zeros(x.shape[1], p['gru.weight_hh'].shape[1], dtype=torch.float64), []
    for t in range(len(x)):
        state = torch.where(cut[t][:, None], state.detach(), state)
        state = gru_step(x[t], state.masked_fill(start[t][:, None], 0), p)
        states.append(state)
    return torch.stack(states)


def before_memory(x, p):
    x = layer_norm(x, p, 'input_norm')
    for layer in range(sum(name.startswith('mlp.') and name.endswith('bias') for name in p)):
        x = layer_norm(torch.relu(linear(x, p, f'mlp.{layer}')), p, f'mlp_norm.{layer}')
    return x


def head(states, p):
    return linear(layer_norm(states, p, 'gru_norm'), p, 'head')


def joined(seen, actions, agent, num_actions, p):
    """What an agent's prediction is made from: all agents' one-hot actions with its own block zero, and what is seen."""
    others = functional.one_hot(actions, num_actions).double()
    others[:, :, agent] = 0
    acted = torch.relu(others.flatten(2) @ p['action_embedding'] + p['action_bias'])
    both = torch.cat([p['joint_action.weight'], p['joint_state.weight']], 1)
    return layer_norm(torch.relu(torch.cat([acted, seen], -1) @ both.t() + p['joint_action.bias']), p, 'joint_norm')


def predicted_rewards(states, actions, num_actions, p, start, cut):
    """[T, W, N, A]."""
    agents = range(actions.shape[-1])
    if 'trunk.weight' not in p:
        seen = layer_norm(torch.relu(linear(states, p, 'state')), p, 'state_norm')
        return torch.stack([head(memories(joined(seen, actions, agent, num_actions, p), p, start, cut), p)
                            for agent in agents], 2)
    taken = functional.one_hot(actions, num_actions).double().flatten(2)
    before = torch.zeros_like(taken)
    for t, world in np.ndindex(*start.shape):
        if not start[t, world]:
            before[t, world] = taken[t - 1, world]
    trunk = layer_norm(torch.relu(linear(torch.cat([states, before], -1), p, 'trunk')), p, 'trunk_norm')
    remembered = layer_norm(memories(trunk, p, start, cut), p, 'gru_norm')
    hidden = layer_norm(torch.relu(linear(remembered, p, 'hidden')), p, 'hidden_norm')
    told = linear(hidden, p, 'head').unflatten(-1, (len(agents), num_actions, -1))  # a number and a vector for each action
    mean, deviation = p['scale'].detach()

    def acting(agent, own):
        joint = actions.clone()
        joint[..., agent] = own
        return of_joint_action(told, joint)

    return mean + deviation * torch.stack([torch.stack([acting(agent, own) for own in range(num_actions)], -1)
                                           for agent in agents], 2)


def of_joint_action(told, actions):
    """[T, W]."""
    N = actions.shape[-1]
    chosen = [told[..., agent, :, :].gather(-2, actions[..., agent, None, None].expand(*actions.shape[:-1], 1, told.shape[-1]))
              .squeeze(-2) for agent in range(N)]
    pairs = sum((chosen[i][..., 1:] * chosen[j][..., 1:]).sum(-1) for i in range(N) for j in range(i))
    return sum(one[..., 0] for one in chosen) + pairs / N ** 2


def adam_step(p, loss, max_norm):
    gradients = torch.autograd.grad(loss, list(p.values()), allow_unused=True, materialize_grads=True)
    norm = math.sqrt(sum(float(gradient.square().sum()) for gradient in gradients))
    shorter = min(1.0, max_norm / norm)
    return {name: (tensor - shorter * g / (shorter * g.abs() + 1)).detach().numpy()
            for (name, tensor), g in zip(p.items(), gradients)}


def reference_update(state, trajectory, settings, members):
    """New parameters by network after one step on every network, and the value normaliser's new state."""
    T, W, N = trajectory.actions.shape
    observations, states, rewards, probabilities, finals = (
        torch.tensor(part, dtype=torch.float64) for part in (
            trajectory.observations, trajectory.states, trajectory.rewards, trajectory.probabilities,
            trajectory.final_states))
    actions, start = torch.tensor(trajectory.actions), torch.tensor(trajectory.episode_start)
    ended = trajectory.terminated | trajectory.truncated
    position = torch.arange(T)[:, None] + T * torch.arange(W)
    cut = position % settings.chunk_length == 0
    networks = ['actor', 'critic'] + [f'reward_network.{member}' for member in range(members)]
    weights = {network: {name: torch.tensor(tensor, dtype=torch.float64, requires_grad=True)
                         for name, tensor in parameters(state, network).items()} for network in networks}
    mean, mean_square, weight = state['value_norm']

    def scale():
        if not weight:
            return 0.0, 1.0
        return mean / weight, math.sqrt(max(mean_square / weight - (mean / weight)**2, 1e-2))

    critic = weights['critic']
    critic_states = memories(before_memory(states, critic), critic, start, torch.cat([cut, cut[:1]]))
    outputs = head(critic_states, critic).squeeze(-1)
    values = outputs.detach() * scale()[1] + scale()[0]
    cut_off = iter(finals)
    after = torch.zeros(T, W, dtype=torch.float64)
    for t, world in np.ndindex(T, W):
        if trajectory.truncated[t, world]:
            final = gru_step(before_memory(next(cut_off), critic), critic_states[t, world], critic)
            after[t, world] = head(final, critic).detach().squeeze() * scale()[1] + scale()[0]
        elif not trajectory.terminated[t, world]:
            after[t, world] = values[t + 1, world]

    predicted = [predicted_rewards(states[:-1], actions, probabilities.shape[-1], weights[network], start[:-1], cut)
                 for network in networks[2:]]
    expected = torch.zeros(T, W, N, dtype=torch.float64)
    if members:
        expected = (sum(predicted).detach() / members * probabilities).sum(-1)
    gae, baseline = torch.zeros(T + 1, W, dtype=torch.float64), torch.zeros(T + 1, W, N, dtype=torch.float64)
    for t in reversed(range(T)):
        go_on = torch.tensor(1.0 - ended[t])
        decay = settings.gamma * settings.gae_lambda * go_on
        gae[t] = rewards[t] + settings.gamma * after[t] - values[t] + decay * gae[t + 1]
        baseline[t] = settings.beta * (expected[t] + decay[:, None] * baseline[t + 1])
    advantages = gae[:-1, :, None] - baseline[:-1]

    targets = values[:-1] + (advantages.mean(-1) if settings.value_target == 'difference' else gae[:-1])
    mean, mean_square, weight = (0.99999 * old + 0.00001 * float(new) for old, new in (
        (mean, targets.mean()), (mean_square, targets.square().mean()), (weight, 1)))
    value_loss = functional.huber_loss(outputs[:-1], (targets - scale()[0]) / scale()[1], delta=settings.huber_delta)

    actor = weights['actor']
    rows = observations.flatten(1, 2)
    by_agent = [mask.repeat_interleave(N, dim=1) for mask in (start[:-1], cut)]
    log_policy = torch.log_softmax(head(memories(before_memory(rows, actor), actor, *by_agent), actor), -1)
    log_policy = log_policy.view(T, W, N, -1)
    ratio = (log_policy - probabilities.log()).gather(-1, actions[..., None]).squeeze(-1).exp()
    normalized = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-5)
    surrogate = torch.minimum(ratio * normalized, ratio.clamp(1 - settings.clip, 1 + settings.clip) * normalized)
    entropy = -(log_policy.exp() * log_policy).sum(-1)
    policy_loss = -surrogate.mean() - settings.entropy_coefficient * entropy.mean()

    norm = settings.max_gradient_norm
    new = {'actor': adam_step(actor, policy_loss, norm),
           'critic': adam_step(critic, settings.value_coefficient * value_loss, norm)}
    for network, prediction in zip(networks[2:], predicted):
        error = prediction.gather(-1, actions[..., None]).squeeze(-1) - rewards[..., None]
        unit = weights[network]['scale'].detach()[1] if 'scale' in weights[network] else 1.0
        new[network] = adam_step(weights[network], (error / unit).square().mean() / 2, norm)
    return new, (mean, mean_square, weight)


CASES = {
    'whole worlds as chunks': {'chunk_length': 7},
    'chunks over the ends of worlds, the last one filled up': {'chunk_length': 5},
    'one chunk, more filling than data': {'chunk_length': 40},
    'chunks of one step': {'chunk_length': 1},
    'the plain value target': {'value_target': 'gae'},
    'an ensemble of two': {'ensemble': 2},
    'beta 0': {'beta': 0.0},
    'beta 1': {'beta': 1.0},
    'three hidden layers': {'mlp_layers': 3},
    'other weights of the losses': {'entropy_coefficient': 0.5, 'value_coefficient': 3.0, 'huber_delta': 0.5,
                                    'clip': 0.05, 'gamma': 0.8, 'gae_lambda': 0.6},
    'gradients cut short': {'max_gradient_norm': 0.01},
    'many worlds, in several shards': {'worlds': 400, 'chunk_length': 5},
    'one robot': {'agents': 1, 'worlds': 10},
    'two robots and many worlds': {'agents': 2, 'worlds': 40},
    'six robots': {'agents': 6},
    'a shared trunk': {'architecture': 'shared_trunk'},
    'a shared trunk, chunks over the ends of worlds': {'architecture': 'shared_trunk', 'chunk_length': 5},
    'a shared trunk, many worlds, an ensemble': {'architecture': 'shared_trunk', 'worlds': 150, 'ensemble': 2},
    'a shared trunk, six robots': {'architecture': 'shared_trunk', 'agents': 6},
    'a shared trunk, one robot': {'architecture': 'shared_trunk', 'agents': 1, 'worlds': 10},
}


@pytest.mark.parametrize('case', CASES.values(), ids=CASES)
def test_an_update_is_the_paper_s_formulas_step_by_step(case, make_learner):
    case = dict(case)
    ensemble, worlds, architecture = case.pop('ensemble', 1), case.pop('worlds', 3), case.pop('architecture', 'per_agent')
    spec = SPEC._replace(num_agents=case.pop('agents', SPEC.num_agents))
    settings = replace(PLAIN, **case)
    trajectory = random_trajectory(worlds=worlds, spec=spec, seed=3)
    assert trajectory.truncated.any() and trajectory.terminated.any()
    learner = make_learner(settings, replace(PLAIN_REWARD, ensemble_size=ensemble, architecture=architecture), spec)
    before = state_of(learner)
    random = np.random.default_rng(5)
    for name in before:  # moved off the start, where biases are zero and advantages small
        if '.parameters.' in name:
            before[name] += random.normal(0, 0.2, before[name].shape).astype(np.float32)
    before['value_norm'] = np.array([-4.0, 40.0, 0.5])  # mean -8, deviation 4
    learner.load_state(before)
    learner.update(trajectory, 0)
    after = state_of(learner)
    members = ensemble if settings.beta else 0
    expected, value_norm = reference_update(before, trajectory, settings, members)
    for network, tensors in expected.items():
        learnt = parameters(after, network)
        assert learnt.keys() == tensors.keys()
        for name, tensor in tensors.items():
            np.testing.assert_allclose(learnt[name], tensor, rtol=1e-4, atol=2e-6, err_msg=f'{network} {name}')
        moved = {name: np.abs(tensor - before[f'{network}.parameters.{name}']).max()
                 for name, tensor in tensors.items()}
        moved.pop('scale', None)  # taken from the first rewards, and not learnt
        if spec.num_agents == 1:
            moved.pop('action_embedding', None)  # there are no others to learn from
        assert min(moved.values()) > 1e-5, network
    np.testing.assert_allclose(after['value_norm'], value_norm, rtol=1e-9)
    assert {name.split('.parameters.')[0] for name in after if '.parameters.' in name} == expected.keys()


# What must not change an update by a bit.


def updated(learner, rollouts, **kind):
    """Metrics of the last of some updates on rollouts of noise."""
    for rollout in rollouts:
        metrics = learner.update(random_trajectory(seed=rollout, **kind), rollout)
    return metrics


@REWARDS
@pytest.mark.parametrize('mini_batches', [1, 3])
def test_the_weights_do_not_depend_on_the_number_of_threads(mini_batches, reward_settings, make_learner):
    settings = replace(LEARNER, num_mini_batches=mini_batches)
    states, metrics = [], []
    for threads in (1, 2, 3):
        learner = make_learner(replace(settings, learner_threads=threads), replace(reward_settings, ensemble_size=2))
        metrics.append(updated(learner, range(2), steps=10, worlds=210))  # three shards of the actor's rows
        states.append(state_of(learner))
    for other in (1, 2):
        assert_same_bits(states[0], states[other])
        assert metrics[0] == metrics[other]


@REWARDS
def test_the_same_seed_learns_the_same_and_another_seed_something_else(reward_settings, make_learner):
    states = []
    for seed in (1, 1, 2):
        learner = make_learner(reward_settings=reward_settings, seed=seed)
        updated(learner, range(2))
        states.append(state_of(learner))
    assert_same_bits(states[0], states[1])
    for network in ('actor', 'critic', 'reward_network.0'):
        assert not same_weights(states[0], states[2], network)


@pytest.mark.parametrize('settings, reward_settings', [
    (LEARNER, REWARD), (replace(LEARNER, beta=0.0), REWARD), (replace(LEARNER, num_mini_batches=2), REWARD),
    (LEARNER, replace(REWARD, ensemble_size=2)), (LEARNER, SHARED_TRUNK), (COMA, REWARD),
    (replace(LEARNER, estimator='coma_nstep'), SHARED_TRUNK), (LEARNER, replace(REPLAY, ensemble_size=2))],
    ids=['beta 0.9', 'beta 0', 'mini-batches', 'ensemble', 'shared trunk', 'coma', 'coma n-step', 'replay'])
def test_a_learner_goes_on_from_a_checkpoint_bit_for_bit(settings, reward_settings, make_learner):
    one, other = make_learner(settings, reward_settings), make_learner(settings, reward_settings, seed=1)
    updated(one, range(3))
    tensors, _ = decode_checkpoint(encode_checkpoint(one.state(), {}))
    updated(other, [7])
    other.load_state(tensors)
    assert_same_bits(state_of(one), state_of(other))
    assert encode_policy(one.policy) == encode_policy(other.policy)
    assert updated(one, range(3, 5)) == updated(other, range(3, 5))
    assert_same_bits(state_of(one), state_of(other))


def test_a_learner_does_not_keep_the_memory_of_the_state_it_took_over(make_learner):
    one, other = make_learner(), make_learner()
    updated(one, range(2))
    saved = state_of(one)
    kept = {name: tensor.copy() for name, tensor in saved.items()}
    other.load_state(saved)
    updated(other, [2])
    assert_same_bits(saved, kept)


def test_the_state_of_another_network_is_not_taken_over(make_learner):
    learner = make_learner()
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(replace(LEARNER, hidden_size=9))))
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(replace(LEARNER, beta=0.0))))
    with pytest.raises((KeyError, RuntimeError)):
        learner.load_state(state_of(make_learner(reward_settings=SHARED_TRUNK)))


def test_an_update_leaves_the_rollout_and_earlier_policies_as_they_were(make_learner):
    learner, trajectory = make_learner(), random_trajectory()
    copies = trajectory.map(np.copy)
    policy = learner.policy
    encoded = encode_policy(policy)
    learner.update(trajectory, 0)
    for part, copy in zip(trajectory, copies):
        np.testing.assert_array_equal(part, copy)
    assert encode_policy(policy) == encoded != encode_policy(learner.policy)


# beta = 0.


def test_at_beta_0_there_is_no_reward_network_and_its_settings_change_nothing(make_learner):
    states = []
    others = replace(SHARED_TRUNK, hidden_size=5, ensemble_size=3, learning_rate=0.5, epochs=7)
    for reward_settings in (REWARD, others):
        learner = make_learner(replace(LEARNER, beta=0.0), reward_settings)
        metrics = updated(learner, range(2))
        assert not [name for name in (*learner.state(), *metrics) if 'reward' in name]
        states.append(state_of(learner))
    assert_same_bits(*states)


@REWARDS
def test_at_beta_0_no_reward_network_is_built_or_run(reward_settings, make_learner, monkeypatch):
    def refuse(*arguments, **more):
        raise AssertionError('a reward network at beta 0')

    for name in ('__init__', 'inputs', 'forward', 'gradient'):
        for architecture in (RewardNetwork, *REWARD_NETWORKS.values()):
            monkeypatch.setattr(architecture, name, refuse)
    updated(make_learner(replace(LEARNER, beta=0.0), reward_settings), range(1))
    with pytest.raises(AssertionError, match='a reward network at beta 0'):
        make_learner(LEARNER, reward_settings)


# Chunks, filling and mini-batches.

IDLE = replace(LEARNER, learning_rate=0.0, epochs=1)  # shows the losses of the first epoch, undisturbed
IDLE_REWARD = replace(REWARD, learning_rate=0.0, epochs=1)


def close_metrics(one, other, tolerance=1e-4):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name] == pytest.approx(other[name], rel=tolerance, abs=1e-5), name


@REWARDS
@pytest.mark.parametrize('length', [1, 3, 5, 21, 50])
def test_losses_do_not_depend_on_how_the_rollout_is_cut(length, reward_settings, make_learner):
    idle = replace(reward_settings, learning_rate=0.0, epochs=1)

    def losses(chunk_length):
        metrics = updated(make_learner(replace(IDLE, chunk_length=chunk_length), idle), range(1))
        return {name: value for name, value in metrics.items() if not name.endswith('gradient_norm')}

    close_metrics(losses(length), losses(7))


@pytest.mark.parametrize('length', [2, 4, 10, 40])
def test_filling_leaves_the_gradients_what_they_are(length, make_learner):
    """Of episodes of one step: nothing is passed on in time, so however they are cut, only the filling differs."""
    states = []
    for chunk_length in (length, 1):
        learner = make_learner(replace(PLAIN, chunk_length=chunk_length), PLAIN_REWARD)
        close = updated(learner, range(1), terminations=1.0)
        states.append((state_of(learner), close))
    (filled, filled_metrics), (exact, exact_metrics) = states
    close_metrics(filled_metrics, exact_metrics)
    for name in exact:
        if '.parameters.' in name:
            np.testing.assert_allclose(filled[name], exact[name], rtol=1e-4, atol=2e-6, err_msg=name)


@pytest.mark.parametrize('mini_batches', [2, 4, 8])
def test_mini_batches_hold_every_chunk_once(mini_batches, make_learner):
    """With weights at rest, the mean loss of equal mini-batches is the loss of the whole."""
    def losses(parts):
        settings = replace(IDLE, chunk_length=5, num_mini_batches=parts)
        metrics = updated(make_learner(settings, IDLE_REWARD), range(1), steps=10, worlds=4)
        return {name: value for name, value in metrics.items() if not name.endswith('gradient_norm')}

    close_metrics(losses(mini_batches), losses(1))


def test_mini_batches_are_shuffled_by_seed_and_rollout_and_each_makes_a_step_of_its_own(make_learner):
    trajectory = random_trajectory(10, 4)

    def learnt(parts, rollout, seed=1):
        learner = make_learner(replace(LEARNER, chunk_length=5, num_mini_batches=parts), seed=seed)
        start = state_of(make_learner(replace(LEARNER, chunk_length=5)))
        learner.load_state(start)
        learner.update(trajectory, rollout)
        return state_of(learner)

    first = learnt(2, 0)
    assert_same_bits(first, learnt(2, 0))
    for other in (learnt(2, 1), learnt(2, 0, seed=2), learnt(1, 0)):
        for network in ('actor', 'critic', 'reward_network.0'):
            assert not same_weights(first, other, network)
    assert_same_bits(learnt(1, 0), learnt(1, 1))


def test_mini_batches_are_shuffled_anew_in_every_epoch(make_learner):
    """With weights at rest, the same mini-batches again would have the same gradients."""
    def norms(epochs):
        settings = replace(IDLE, chunk_length=5, num_mini_batches=2, epochs=epochs)
        metrics = updated(make_learner(settings, replace(IDLE_REWARD, epochs=epochs)), range(1), steps=10, worlds=4)
        return [value for name, value in metrics.items() if name.endswith('gradient_norm')]

    for once, twice in zip(norms(1), norms(2)):
        assert abs(twice / once - 1) > 1e-4


def test_there_may_be_more_mini_batches_than_chunks(make_learner):
    metrics = updated(make_learner(replace(LEARNER, num_mini_batches=1000)), range(1))
    assert all(math.isfinite(value) for value in metrics.values())


def test_a_rollout_of_one_step_of_one_world_is_learnt_from(make_learner):
    learner = make_learner()
    metrics = updated(learner, range(2), steps=1, worlds=1)
    assert all(math.isfinite(value) for value in metrics.values())
    assert all(np.isfinite(tensor).all() for tensor in learner.state().values())


# Ends of episodes.


@pytest.mark.parametrize('how, last_state_counts, final_state_counts', [
    ('goes on', True, False), ('terminated', False, False), ('truncated', False, True)])
def test_an_episode_is_bootstrapped_from_where_it_was_cut_off_and_from_nothing_where_it_ended(
        how, last_state_counts, final_state_counts, make_learner):
    trajectory = random_trajectory(terminations=0.0, truncations=0.0)
    trajectory.terminated[-1] = how == 'terminated'
    trajectory.truncated[-1] = how == 'truncated'
    trajectory.episode_start[-1] = how != 'goes on'
    finals = np.random.default_rng(1).normal(size=(3 if how == 'truncated' else 0, 7)).astype(np.float32)
    trajectory = trajectory._replace(final_states=finals)
    moved_last = trajectory._replace(states=trajectory.states.copy())
    moved_last.states[-1, :, 0] += 1  # not all by the same, which the LayerNorm takes away
    moved_final = trajectory._replace(final_states=finals + np.eye(1, 7, dtype=np.float32))
    states = []
    for one in (trajectory, moved_last, moved_final):
        learner = make_learner()
        learner.update(one, 0)
        states.append(state_of(learner))
    original, with_last, with_final = states
    for network in ('actor', 'critic'):
        assert same_weights(original, with_last, network) != last_state_counts
        assert same_weights(original, with_final, network) != final_state_counts
    assert same_weights(original, with_last, 'reward_network.0')


def test_each_final_state_goes_to_the_world_whose_episode_was_cut_off(make_learner):
    trajectory = random_trajectory(terminations=0.0, truncations=0.4, seed=2)
    assert len(trajectory.final_states) > 2
    swapped = trajectory._replace(final_states=trajectory.final_states[::-1].copy())
    states = []
    for one in (trajectory, swapped):
        learner = make_learner()
        learner.update(one, 0)
        states.append(state_of(learner))
    assert not same_weights(*states, 'critic')


def test_the_two_value_targets_differ_where_there_is_credit_and_only_there(make_learner):
    def learnt(value_target, beta):
        learner = make_learner(replace(LEARNER, value_target=value_target, beta=beta))
        updated(learner, range(1))
        return state_of(learner)

    assert not same_weights(learnt('difference', 0.9), learnt('gae', 0.9), 'critic')
    assert same_weights(learnt('difference', 0.9), learnt('gae', 0.9), 'actor')
    one, other = learnt('difference', 0.0), learnt('gae', 0.0)
    for name, tensor in parameters(one, 'critic').items():
        np.testing.assert_allclose(tensor, parameters(other, 'critic')[name], atol=1e-5)


# Learning.


def played(learner, rewards_of, steps=8, worlds=32, spec=SPEC, rollout=0):
    """A rollout whose actions the learner's own policy chose; the reward is a function of the joint action [W, N]."""
    trajectory, policy = random_trajectory(steps, worlds, spec, seed=rollout), learner.policy
    for robot in range(spec.num_agents):
        memory = policy.initial_state(worlds)
        for t in range(steps):
            observed, start = trajectory.observations[t, :, robot], trajectory.episode_start[t]
            probabilities, memory = policy.act(observed, memory, start)
            trajectory.probabilities[t, :, robot] = probabilities
            trajectory.actions[t, :, robot] = choose(probabilities, False, 1, rollout, t, robot)
    for t in range(steps):
        trajectory.rewards[t] = rewards_of(trajectory.actions[t])
    return trajectory


def how_many_chose_1(actions):
    return (actions == 1).sum(-1)


@pytest.mark.parametrize('mini_batches', [1, 2])
def test_the_ratio_is_1_in_the_first_epoch_also_in_the_middle_of_episodes(mini_batches, make_learner):
    learner = make_learner(replace(IDLE, clip=1e-4, chunk_length=4, num_mini_batches=mini_batches))
    state, random = state_of(learner), np.random.default_rng(1)
    for name in state:
        if name.startswith('actor.parameters.'):  # a policy far from uniform, which remembers
            state[name] += random.normal(0, 0.5, state[name].shape).astype(np.float32)
    learner.load_state(state)
    metrics = learner.update(played(learner, how_many_chose_1), 0)
    assert metrics['policy/clipped_fraction'] == 0
    assert abs(metrics['policy/kl']) < 1e-6 and abs(metrics['policy/loss']) < 1e-5
    assert metrics['policy/entropy'] < 0.98 * math.log(SPEC.num_actions)


@pytest.mark.parametrize('beta, reward_settings', [(0.0, REWARD), (0.95, REWARD), (1.0, REWARD), (0.95, SHARED_TRUNK)])
def test_one_update_makes_a_rewarded_action_more_probable_and_more_updates_certain(beta, reward_settings, make_learner):
    settings = LearnerSettings(hidden_size=8, beta=beta, learning_rate=5e-3, learner_threads=1)
    learner = make_learner(settings, reward_settings)

    def probability_of_1():
        return float(played(learner, how_many_chose_1, rollout=99).probabilities[..., 1].mean())

    before = probability_of_1()
    learner.update(played(learner, how_many_chose_1), 0)
    assert probability_of_1() > before + 0.02
    for rollout in range(1, 8):
        learner.update(played(learner, how_many_chose_1, rollout=rollout), rollout)
    assert probability_of_1() > 0.8


@pytest.mark.parametrize('ensemble', [1, 2])
@pytest.mark.parametrize('architecture', REWARD_NETWORKS)
def test_the_reward_network_learns_a_reward_that_hangs_on_all_actions(architecture, ensemble, make_learner):
    settings = RewardNetworkSettings(architecture, hidden_size=16, ensemble_size=ensemble, epochs=15, learning_rate=5e-3)
    learner = make_learner(replace(LEARNER, learning_rate=0.0), settings)
    explained = [learner.update(played(learner, how_many_chose_1, rollout=rollout), rollout)
                 ['reward_network/explained_variance'] for rollout in range(8)]
    assert explained[0] < 0.2 and explained[-1] > 0.9


@pytest.mark.parametrize('reward_settings', [REWARD, SHARED_TRUNK, REPLAY, replace(REWARD, ensemble_size=2)])
def test_credit_is_told_before_the_rollout_is_learnt_from_or_if_asked_after(reward_settings, make_learner):
    trajectory, learnt = random_trajectory(8, 32), []
    for first in (False, True):
        learner = make_learner(reward_settings=replace(reward_settings, learns_first=first))
        learner.watched_world = 3
        before = learner.expected_rewards(trajectory)
        metrics = learner.update(trajectory, 0)
        after = learner.expected_rewards(trajectory)
        told = trajectory.rewards[:, 3, None] - learner.credit.differences
        assert not np.allclose(before, after, atol=1e-3)
        np.testing.assert_allclose(told, (after if first else before)[:, 3], atol=1e-5)
        learnt.append((parameters(state_of(learner), 'reward_network.0'), metrics['reward_network/explained_variance'],
                       metrics['reward_network/loss']))
    (one, *told_of_one), (other, *told_of_other) = learnt
    assert told_of_one == told_of_other
    assert all(np.array_equal(one[name], other[name]) for name in one)  # what it learns is the same


def test_the_members_of_an_ensemble_are_networks_of_their_own(make_learner):
    learner = make_learner(reward_settings=replace(REWARD, ensemble_size=2))
    for _ in range(2):
        state = state_of(learner)
        one, other = (parameters(state, f'reward_network.{member}') for member in range(2))
        assert one.keys() == other.keys() and 'reward_network.2.parameters.head.bias' not in state
        assert all(not np.array_equal(one[name], other[name]) for name in one if one[name].ndim == 2)
        updated(learner, range(1))


def test_the_critic_learns_the_rewards_to_come_from_the_state(make_learner):
    settings = LearnerSettings(hidden_size=16, beta=0.0, learning_rate=5e-3, gamma=0.0, learner_threads=1)
    learner, losses = make_learner(settings), []
    for rollout in range(10):
        trajectory = random_trajectory(8, 32, seed=rollout)
        trajectory = trajectory._replace(rewards=30 * trajectory.states[:-1, :, 0] - 170)
        losses.append(learner.update(trajectory, rollout)['value/loss'])
    assert losses[-1] < 0.2 * losses[0]
    mean, mean_square, weight = learner.state()['value_norm']
    assert mean / weight == pytest.approx(-170, abs=5)
    assert math.sqrt(mean_square / weight - (mean / weight)**2) == pytest.approx(30, rel=0.2)


def test_an_update_tells_how_it_went_in_numbers(make_learner):
    metrics = updated(make_learner(), range(1))
    assert metrics.keys() >= {'policy/loss', 'policy/entropy', 'policy/clipped_fraction', 'policy/kl', 'value/loss',
                              'reward_network/loss', 'reward_network/explained_variance'}
    assert all(type(value) is float and math.isfinite(value) for value in metrics.values())
    assert 0 <= metrics['policy/clipped_fraction'] <= 1 and 0 < metrics['policy/entropy'] <= math.log(SPEC.num_actions)
