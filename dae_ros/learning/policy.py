"""The decentralised policy: what a robot needs to act, without torch.

Actor of recurrent MAPPO (paper, algorithm 1, line 11): LayerNorm, MLP with LayerNorm after each activation, GRU,
LayerNorm, linear head, softmax. The learner trains the same network (`dae_ros.learning.networks.RecurrentNetwork`); a test
holds the two together. Acting starts fast, answers one observation in microseconds and gives the same bits in every
process that acts on the same batch.
"""

from __future__ import annotations

import ctypes
from typing import Mapping, NamedTuple

import numpy as np

from dae_ros import draws
from dae_ros.learning.native import library

_FLOAT, _BOOL = np.dtype(np.float32), np.dtype(bool)
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
        self.tensors = {name: np.array(tensor, np.float32, order='C') for name, tensor in tensors.items()}
        compiled = library.chosen()
        self._network = (_InNumpy(architecture, self.tensors) if compiled is None
                         else _Compiled(architecture, self.tensors, compiled))

    def initial_state(self, num_worlds: int) -> np.ndarray:
        """Recurrent state before an episode: zeros [W, H]."""
        return np.zeros((num_worlds, self.architecture.hidden_size), np.float32)

    def act(self, values: np.ndarray, state: np.ndarray, episode_start: np.ndarray,
            available: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Action probabilities and the next recurrent state.

        values: observations [W, O] float32. state: [W, H] float32. episode_start: [W] bool; the state is forgotten there.
        available: [W, A] bool, at least one of each row; all others have probability 0. None: all are.
        Returns ([W, A] float32 with rows that sum to 1, [W, H] float32). ValueError if an argument is of another shape or
        type.
        """
        values, state, episode_start = map(np.ascontiguousarray, (values, state, episode_start))
        W = len(values)
        given = values.shape, values.dtype, state.shape, state.dtype, episode_start.shape, episode_start.dtype
        needed = (W, self.architecture.observation_size), _FLOAT, (W, self.architecture.hidden_size), _FLOAT, (W,), _BOOL
        if given != needed:
            raise ValueError(f'observations, state and episode starts are {given} where {needed} is needed')
        if available is not None:
            available = np.ascontiguousarray(available)
            if (available.shape, available.dtype) != ((W, self.architecture.num_actions), _BOOL):
                raise ValueError(f'available actions are {available.dtype} {available.shape} where bool '
                                 f'{(W, self.architecture.num_actions)} is needed')
        return self._network(values, state, episode_start, available)


class _Compiled:
    """The network by the compiled kernels. A world's bits do not depend on the worlds beside it."""

    def __init__(self, architecture: PolicyArchitecture, tensors: Mapping[str, np.ndarray], compiled: ctypes.CDLL):
        O, A, H, mlp_layers, activation = architecture

        def step(kind: str, activation: str, inputs: int, outputs: int, *names: str | None) -> library.CStep:
            addresses = [None if name is None else tensors[name].ctypes.data for name in names]
            return library.c_step(kind, activation, inputs, outputs, addresses)

        def norm(size: int, name: str) -> library.CStep:
            return step('layer', 'identity', size, size, None, None, f'{name}.weight', f'{name}.bias')

        mlp = [step('layer', activation, H if layer else O, H, f'mlp.{layer}.weight', f'mlp.{layer}.bias',
                    f'mlp_norm.{layer}.weight', f'mlp_norm.{layer}.bias') for layer in range(mlp_layers)]
        gru = step('gru', 'identity', H, H, 'gru.weight_ih', 'gru.weight_hh', 'gru.bias_ih', 'gru.bias_hh')
        head = step('layer', 'identity', H, A, 'head.weight', 'head.bias', None, None)
        row = [norm(O, 'input_norm'), *mlp, gru, norm(H, 'gru_norm'), head]
        steps = (library.CStep * len(row))(*row)
        size = compiled.policy_pack(steps, len(row), None)
        if size == 0:  # weights come from outside, too
            raise ValueError(f'{mlp_layers} layers are more than a policy may have')
        packed = np.empty(size, np.uint8)
        compiled.policy_pack(steps, len(row), packed.ctypes.data)
        self._kept = tensors, steps, packed  # what lies at the addresses below
        self._network = ctypes.addressof(steps), len(row), packed.ctypes.data
        self._act, self._sizes = compiled.policy_act, (A, H)

    def __call__(self, values: np.ndarray, state: np.ndarray, episode_start: np.ndarray,
                 available: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        W, (A, H) = len(values), self._sizes
        probabilities, next_state = np.empty((W, A), np.float32), np.empty((W, H), np.float32)
        if self._act(*self._network, W, values.ctypes.data, state.ctypes.data, episode_start.ctypes.data,
                     None if available is None else available.ctypes.data, probabilities.ctypes.data, next_state.ctypes.data):
            raise MemoryError(f'no memory to act in {W} worlds')
        return probabilities, next_state


class _InNumpy:
    """The network in plain numpy: the reference for the compiled kernels, and what there is without a C compiler."""

    def __init__(self, architecture: PolicyArchitecture, tensors: Mapping[str, np.ndarray]):
        """Prepares one product for each layer: a LayerNorm's scale and shift go into the layer after it, and biases are
        rows of the matrices, which a column of ones picks out of `_standardised`."""
        self._architecture = architecture
        H, exact = architecture.hidden_size, {name: tensor.astype(np.float64) for name, tensor in tensors.items()}

        def after(norm: str, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
            """[inputs + 1, outputs]: weight [outputs, inputs] and bias of a layer, behind the LayerNorm `norm`."""
            return np.vstack([(weight * exact[f'{norm}.weight']).T, bias + weight @ exact[f'{norm}.bias']])

        norms = ['input_norm', *(f'mlp_norm.{layer}' for layer in range(architecture.mlp_layers))]
        layers = [after(norm, exact[f'mlp.{layer}.weight'], exact[f'mlp.{layer}.bias']) for layer, norm in enumerate(norms[:-1])]
        # Of [x, 1, state]: reset and update gates with their signs turned, as the sigmoid needs them, then the candidate's
        # part from the input and, apart from it, its part from the state, which the reset gate scales.
        gru = np.zeros((2 * H + 1, 4 * H))
        gru[:H + 1, :3 * H] = after(norms[-1], exact['gru.weight_ih'], exact['gru.bias_ih'])
        from_state = np.concatenate([exact['gru.bias_hh'][None], exact['gru.weight_hh'].T])
        gru[H:, :2 * H] += from_state[:, :2 * H]
        gru[H:, 3 * H:] = from_state[:, 2 * H:]
        gru[:, :2 * H] *= -1
        self._layers = [layer.astype(np.float32) for layer in layers]
        self._gru = gru.astype(np.float32)
        self._averages = [np.full(size, 1 / size, np.float32) for size in (architecture.observation_size, H)]
        self._head = np.ascontiguousarray(after('gru_norm', exact['head.weight'], exact['head.bias']).T, np.float32)

    def __call__(self, values: np.ndarray, state: np.ndarray, episode_start: np.ndarray,
                 available: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        H, x, (average, hidden_average) = self._architecture.hidden_size, values, self._averages
        for layer in self._layers:
            x = _standardised(x, average) @ layer
            x = np.maximum(x, 0, out=x) if self._architecture.activation == 'relu' else np.tanh(x, out=x)
            average = hidden_average
        x = _standardised(x, average, room=H)
        remembered = x[:, H + 1:]
        remembered[...] = state
        remembered[episode_start] = 0
        from_both = x @ self._gru
        with np.errstate(over='ignore'):  # of a gate that is closed: 1 / (1 + inf) = 0
            gates = np.exp(from_both[:, :2 * H])
        gates += 1
        np.reciprocal(gates, out=gates)
        reset, update = gates[:, :H], gates[:, H:]
        candidate = from_both[:, 3 * H:]
        candidate *= reset
        candidate += from_both[:, 2 * H:3 * H]
        candidate = np.tanh(candidate)
        state = remembered - candidate
        state *= update
        state += candidate
        scores = self._head @ _standardised(state, average).T  # [A, W]: sums over actions along the worlds are the quicker ones
        if available is not None:
            scores[~available.T] = -np.inf
        scores -= scores.max(axis=0)
        np.exp(scores, out=scores)
        scores /= scores.sum(axis=0)
        return scores.T, state


def _standardised(x: np.ndarray, average: np.ndarray, room: int = 0) -> np.ndarray:
    """LayerNorm without scale and shift of x [W, I], then a column of ones, then `room` columns: [W, I + 1 + room].

    average: 1 / I [I]; numpy's own mean of short rows is slower than a product.
    """
    num_worlds, size = x.shape
    y = np.empty((num_worlds, size + 1 + room), np.float32)
    centred = x - (x @ average)[:, None]
    deviation = (centred * centred) @ average
    deviation += LAYER_NORM_EPSILON
    np.sqrt(deviation, out=deviation)
    np.divide(centred, deviation[:, None], out=y[:, :size])
    y[:, size] = 1
    return y


def choose(probabilities: np.ndarray, greedy: bool, seed: int, rollout: int, step: int, robot: int) -> np.ndarray:
    """Actions [W] uint16 for probabilities [W, A]: the most probable ones, or drawn by the keyed draw of this step."""
    if greedy:
        return probabilities.argmax(axis=1).astype(np.uint16)
    uniforms = draws.generator(seed, 'action', rollout, step, robot).random(len(probabilities))
    cumulative = probabilities.T.cumsum(axis=0, dtype=np.float64)
    chosen = (cumulative <= uniforms * cumulative[-1]).sum(axis=0)
    return np.minimum(chosen, probabilities.shape[1] - 1).astype(np.uint16)
