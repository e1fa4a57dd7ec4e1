"""An update of the learner against the paper's formulas, written down in float64 without a thought for speed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from tests.learners import PLAIN, PLAIN_REWARD, SPEC, parameters, random_trajectory, state_of


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
