"""The decentralised policy in plain numpy: what a robot needs to act, without torch.

Actor of recurrent MAPPO (paper, algorithm 1, line 11): LayerNorm, MLP with LayerNorm after each activation, GRU,
LayerNorm, linear head, softmax. The learner trains the same network in torch (`dae_ros.learning.networks.Actor`); a test
holds the two together. Acting in numpy starts fast, answers one observation in tens of microseconds and gives the same
bits in every process that acts on the same batch.
"""

from __future__ import annotations

from typing import Mapping, NamedTuple

import numpy as np

from dae_ros import draws

LAYER_NORM_EPSILON = np.float32(1e-5)


class PolicyArchitecture(NamedTuple):
    """Sizes that fix the shapes of a policy's tensors."""

    observation_size: int  # O
    num_actions: int       # A
    hidden_size: int       # H
    mlp_layers: int
    activation: str        # 'relu' or 'tanh'

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of every tensor, in the order of the forward pass."""
        O, A, H = self.observation_size, self.num_actions, self.hidden_size
        shapes: dict[str, tuple[int, ...]] = {'input_norm.weight': (O,), 'input_norm.bias': (O,)}
        for layer in range(self.mlp_layers):
            shapes[f'mlp.{layer}.weight'] = (H, O if layer == 0 else H)
            shapes[f'mlp.{layer}.bias'] = (H,)
            shapes[f'mlp_norm.{layer}.weight'] = (H,)
            shapes[f'mlp_norm.{layer}.bias'] = (H,)
        shapes['gru.weight_ih'] = (3 * H, H)
        shapes['gru.weight_hh'] = (3 * H, H)
        shapes['gru.bias_ih'] = (3 * H,)
        shapes['gru.bias_hh'] = (3 * H,)
        shapes['gru_norm.weight'] = (H,)
        shapes['gru_norm.bias'] = (H,)
        shapes['head.weight'] = (A, H)
        shapes['head.bias'] = (A,)
        return shapes


class Policy:
    """pi(a | o, h) for one robot in W worlds at once. Immutable; the recurrent state is the caller's."""

    def __init__(self, architecture: PolicyArchitecture, tensors: Mapping[str, np.ndarray]):
        """`tensors`: float32 arrays with exactly `architecture.shapes()`; ValueError otherwise."""
        expected = architecture.shapes()
        if {name: tuple(tensor.shape) for name, tensor in tensors.items()} != expected:
            raise ValueError(f'these tensors are not a policy of {architecture}')
        self.architecture = architecture
        self.tensors = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
        self._transposed = {name: np.ascontiguousarray(tensor.T) for name, tensor in self.tensors.items() if tensor.ndim == 2}

    def initial_state(self, num_worlds: int) -> np.ndarray:
        """Recurrent state before an episode: zeros [W, H]."""
        return np.zeros((num_worlds, self.architecture.hidden_size), np.float32)

    def act(self, values: np.ndarray, state: np.ndarray, episode_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Action probabilities and the next recurrent state.

        values: observations [W, O] float32. state: [W, H] float32. episode_start: [W] bool; the state is forgotten there.
        Returns ([W, A] float32 with rows that sum to 1, [W, H] float32).
        """
        x = self._layer_norm('input_norm', values)
        for layer in range(self.architecture.mlp_layers):
            x = self._linear(f'mlp.{layer}', x)
            x = np.maximum(x, 0, out=x) if self.architecture.activation == 'relu' else _tanh(x)
            x = self._layer_norm(f'mlp_norm.{layer}', x)
        state = self._gru(x, state * ~episode_start[:, None])
        logits = self._linear('head', self._layer_norm('gru_norm', state))
        logits -= logits.max(axis=1, keepdims=True)
        probabilities = np.exp(logits, out=logits)
        probabilities /= probabilities.sum(axis=1, keepdims=True)
        return probabilities, state

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        y = x @ self._transposed[f'{name}.weight']
        y += self.tensors[f'{name}.bias']
        return y

    def _layer_norm(self, name: str, x: np.ndarray) -> np.ndarray:
        centred = x - x.mean(axis=1, keepdims=True)
        variance = np.einsum('ij,ij->i', centred, centred) / np.float32(x.shape[1])
        centred *= (1 / np.sqrt(variance + LAYER_NORM_EPSILON))[:, None]
        centred *= self.tensors[f'{name}.weight']
        centred += self.tensors[f'{name}.bias']
        return centred

    def _gru(self, x: np.ndarray, state: np.ndarray) -> np.ndarray:
        H = self.architecture.hidden_size
        from_input = x @ self._transposed['gru.weight_ih'] + self.tensors['gru.bias_ih']
        from_state = state @ self._transposed['gru.weight_hh'] + self.tensors['gru.bias_hh']
        gates = _sigmoid(from_input[:, :2 * H] + from_state[:, :2 * H])
        reset, update = gates[:, :H], gates[:, H:]
        candidate = _tanh(from_input[:, 2 * H:] + reset * from_state[:, 2 * H:])
        return candidate + update * (state - candidate)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(np.clip(-x, -80, 80)))


def _tanh(x: np.ndarray) -> np.ndarray:
    """By way of exp, which numpy vectorises for float32 on every x86-64 and tanh only on some."""
    return 1 - 2 / (np.exp(np.clip(2 * x, -80, 80)) + 1)


def choose(probabilities: np.ndarray, greedy: bool, seed: int, rollout: int, step: int, robot: int) -> np.ndarray:
    """Actions [W] uint16 for probabilities [W, A]: the most probable ones, or drawn by the keyed draw of this step."""
    if greedy:
        return probabilities.argmax(axis=1).astype(np.uint16)
    uniforms = draws.generator(seed, 'action', rollout, step, robot).random(len(probabilities))
    cumulative = probabilities.cumsum(axis=1, dtype=np.float64)
    chosen = (cumulative <= (uniforms * cumulative[:, -1])[:, None]).sum(axis=1)
    return np.minimum(chosen, probabilities.shape[1] - 1).astype(np.uint16)
