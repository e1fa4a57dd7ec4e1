"""Policies and checkpoints as files: what comes back is what was written, and nothing else is believed."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies
from safetensors.numpy import save

from dae_ros.errors import Refused
from dae_ros.learning.policy import Policy, PolicyArchitecture
from dae_ros.types import PolicyWeights
from dae_ros.weights import codec

SIZES = PolicyArchitecture(observation_size=3, num_actions=2, hidden_size=4, mlp_layers=1, activation='relu')
ARCHITECTURES = strategies.builds(
    PolicyArchitecture, strategies.integers(1, 9), strategies.integers(1, 6), strategies.integers(1, 9),
    strategies.integers(1, 3), strategies.sampled_from(['relu', 'tanh']))
FACTS = {'updates': 10, 'seconds': 1.5, 'settings': 'ab', 'mean_return': None}
SEEDS = strategies.integers(0, 2**32)


def random_tensors(architecture=SIZES, seed=0):
    random = np.random.default_rng(seed)
    return {name: random.normal(size=shape).astype(np.float32) for name, shape in architecture.shapes().items()}


def random_policy(architecture=SIZES, seed=0):
    return Policy(architecture, random_tensors(architecture, seed))


def some_tensors(seed=0):
    random = np.random.default_rng(seed)
    return {'b': random.normal(size=(2, 3)), 'a': random.integers(0, 9, 4), 'empty': np.empty((0, 3), np.float32),
            'flags': random.random(5) < 0.5, 'c': random.normal(size=7).astype(np.float32)}


def encoded_checkpoint(seed=0):
    return codec.encode_checkpoint(some_tensors(seed), FACTS)


def file_of(tensors=None, architecture=SIZES, **changed):
    """A file like a policy's, with other tensors or another schema; a schema entry that is None is left out."""
    schema = {'format': codec.POLICY_FORMAT, **architecture._asdict(), **changed}
    schema = {name: value for name, value in schema.items() if value is not None}
    tensors = random_tensors(architecture) if tensors is None else tensors
    signed = {name: value for name, value in schema.items() if name != 'format'}
    checksum = codec.sha256(f'{codec.tensors_sha256(tensors)} {json.dumps(signed, sort_keys=True)}'.encode())
    return save(tensors, metadata={'dae_ros': json.dumps({**schema, 'sha256': checksum})})


def header_and_body(data):
    length, = struct.unpack_from('<Q', data)
    return json.loads(data[8:8 + length]), data[8 + length:]


def with_header(header, body=b''):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack('<Q', len(text)) + text + body


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].dtype == other[name].dtype and one[name].shape == other[name].shape, name
        assert one[name].tobytes() == other[name].tobytes(), name


def reason_for(data, decode=codec.decode_policy):
    with pytest.raises(Refused) as caught:
        decode(data)
    return caught.value.reason


def both(function):
    """Runs a test on the files of policies and of checkpoints."""
    kinds = [(codec.encode_policy(random_policy()), codec.decode_policy),
             (encoded_checkpoint(), codec.decode_checkpoint)]
    return pytest.mark.parametrize('data, decode', kinds, ids=['policy', 'checkpoint'])(function)


# What was written comes back.


@settings(max_examples=40, deadline=None, derandomize=True)
@given(architecture=ARCHITECTURES, seed=SEEDS)
def test_a_policy_comes_back_bit_for_bit(architecture, seed):
    policy = random_policy(architecture, seed)
    decoded = codec.decode_policy(codec.encode_policy(policy))
    assert decoded.architecture == architecture
    assert_same(decoded.tensors, policy.tensors)
    values = np.random.default_rng(seed).normal(size=(3, architecture.observation_size)).astype(np.float32)
    arguments = (values, policy.initial_state(3), np.zeros(3, bool))
    for one, other in zip(policy.act(*arguments), decoded.act(*arguments)):
        np.testing.assert_array_equal(one, other)


def test_equal_policies_give_equal_bytes_in_whatever_order_their_tensors_came():
    tensors = random_tensors()
    backwards = dict(reversed(list(tensors.items())))
    ordered = Policy(SIZES, tensors)
    reordered = Policy(SIZES, {name: backwards[name] for name in sorted(backwards)})
    assert codec.encode_policy(ordered) == codec.encode_policy(reordered)
    data = codec.encode_policy(ordered)
    assert codec.encode_policy(codec.decode_policy(data)) == data


def test_policies_that_differ_in_one_bit_or_in_their_activation_give_other_bytes():
    data = codec.encode_policy(random_policy())
    tensors = random_tensors()
    tensors['head.bias'][0] = np.nextafter(tensors['head.bias'][0], np.float32(9))
    assert codec.encode_policy(Policy(SIZES, tensors)) != data
    assert codec.encode_policy(Policy(SIZES._replace(activation='tanh'), random_tensors())) != data


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=SEEDS, facts=strategies.dictionaries(
    strategies.text().filter(lambda name: name not in ('format', 'sha256')),
    strategies.none() | strategies.booleans() | strategies.integers() | strategies.floats(allow_nan=False)
    | strategies.text(), max_size=5))
def test_a_checkpoint_comes_back_bit_for_bit_with_its_facts(seed, facts):
    tensors = some_tensors(seed)
    decoded, told = codec.decode_checkpoint(codec.encode_checkpoint(tensors, facts))
    assert_same(decoded, tensors)
    assert told == facts


def test_a_fact_may_be_a_number_that_is_none():
    _, facts = codec.decode_checkpoint(codec.encode_checkpoint({}, {'mean_return': float('nan')}))
    assert np.isnan(facts['mean_return'])


def test_tensors_that_are_views_are_written_as_they_look():
    numbers = np.arange(24.0).reshape(4, 6)
    tensors = {'transposed': numbers.T, 'strided': numbers[::2, ::3], 'reversed': numbers[::-1]}
    decoded, _ = codec.decode_checkpoint(codec.encode_checkpoint(tensors, {}))
    assert_same(decoded, tensors)


# Checksums.


def test_the_checksum_of_tensors_tells_every_change_and_no_order():
    tensors = some_tensors()
    checksum = codec.tensors_sha256(tensors)
    assert codec.tensors_sha256(dict(reversed(tensors.items()))) == checksum
    renamed = {('d' if name == 'c' else name): tensor for name, tensor in tensors.items()}
    fewer = {name: tensor for name, tensor in tensors.items() if name != 'empty'}
    changes = [renamed, fewer, {**tensors, 'b': tensors['b'].reshape(3, 2)}, {**tensors, 'b': tensors['b'].T},
               {**tensors, 'c': tensors['c'].view(np.int32)}, {**tensors, 'c': tensors['c'].astype(np.float64)},
               {**tensors, 'c': np.nextafter(tensors['c'], np.float32(9))},
               {**tensors, 'a': tensors['b'], 'b': tensors['a']}]
    checksums = [codec.tensors_sha256(changed) for changed in changes]
    assert len({checksum, *checksums}) == 1 + len(changes)
    assert codec.tensors_sha256({'x': np.array([0.0])}) != codec.tensors_sha256({'x': np.array([-0.0])})


@both
def test_a_file_whose_tensors_lost_a_bit_is_refused(data, decode):
    begin = len(data) - len(header_and_body(data)[1])
    for position in range(begin, len(data)):
        for bit in range(8):
            damaged = bytearray(data)
            damaged[position] ^= 1 << bit
            assert reason_for(bytes(damaged), decode) == 'corrupt'


def test_a_checkpoint_whose_facts_changed_is_refused():
    header, body = header_and_body(encoded_checkpoint())
    for old, new in (('"updates": 10', '"updates": 30'), ('"updates"', '"updated"'), (', "settings": "ab"', '')):
        metadata = header['__metadata__']['dae_ros']
        assert old in metadata
        changed = {**header, '__metadata__': {'dae_ros': metadata.replace(old, new)}}
        assert reason_for(with_header(changed, body), codec.decode_checkpoint) == 'corrupt'


def test_a_checkpoint_whose_tensors_were_exchanged_is_refused():
    header, _ = header_and_body(encoded_checkpoint(0))
    _, body = header_and_body(encoded_checkpoint(1))
    assert reason_for(with_header(header, body), codec.decode_checkpoint) == 'corrupt'


def test_a_file_without_a_checksum_is_refused():
    for kind, schema, decode in ((codec.CHECKPOINT_FORMAT, FACTS, codec.decode_checkpoint),
                                 (codec.POLICY_FORMAT, SIZES._asdict(), codec.decode_policy)):
        metadata = {'dae_ros': json.dumps({'format': kind, **schema})}
        assert reason_for(save(random_tensors(SIZES), metadata=metadata), decode) == 'corrupt'


def opened(weights):
    return codec.open_weights(weights, None)


def weights(data, **changed):
    return PolicyWeights(1, 2, codec.sha256(data), data)._replace(**changed)


def test_the_weights_of_a_message_are_opened_if_their_checksum_is_right():
    data = codec.encode_policy(random_policy())
    assert_same(opened(weights(data)).tensors, random_policy().tensors)
    for checksum in ('', codec.sha256(data + b'x'), 'é'):
        assert reason_for(weights(data, sha256=checksum), opened) == 'corrupt'
    damaged = data[:-1] + bytes([data[-1] ^ 1])
    assert reason_for(weights(damaged, sha256=codec.sha256(data)), opened) == 'corrupt'


def test_the_weights_of_a_message_may_be_so_large_and_not_a_byte_larger(monkeypatch):
    data = codec.encode_policy(random_policy())
    monkeypatch.setattr(codec, 'MAX_POLICY_BYTES', len(data))
    opened(weights(data))
    monkeypatch.setattr(codec, 'MAX_POLICY_BYTES', len(data) - 1)
    assert reason_for(weights(data), opened) == 'oversized'
    assert reason_for(weights(data, sha256='unread'), opened) == 'oversized'


# What is something else.


@both
def test_a_file_cut_off_anywhere_is_refused(data, decode):
    assert {reason_for(data[:length], decode) for length in range(len(data))} == {'corrupt'}
    assert reason_for(data + b'\0', decode) == 'corrupt'


# Written by hand, so that no test has to import what nobody here may: loaded, each would end the process.
PICKLES = [b'cbuiltins\nexit\n(I3\ntR.', b'\x80\x04\x8c\x08builtins\x8c\x04exit\x93K\x03\x85R.']
FOREIGN = {
    'nothing': b'', 'text': b'hello', 'JSON': b'{"__metadata__": {}}', 'zeros': bytes(1000), 'ones': b'\xff' * 1000,
    'a pickle': PICKLES[0], 'a newer pickle': PICKLES[1], 'an archive': b'PK\x03\x04' + PICKLES[1],
    'an archive with a pickle': struct.pack('<Q', len(PICKLES[0])) + PICKLES[0],
    'safetensors of someone else': save({'weight': np.zeros(3)}),
    'safetensors with other metadata': save({'weight': np.zeros(3)}, metadata={'format': 'pt'}),
    'metadata that are no JSON': save({}, metadata={'dae_ros': '{'}),
    'metadata that are a list': save({}, metadata={'dae_ros': '["format"]'}),
    'metadata that are a number': save({}, metadata={'dae_ros': '5'}),
    'metadata without a format': save({}, metadata={'dae_ros': '{}'}),
    'a format of another version': save({}, metadata={'dae_ros': '{"format": "dae_ros.policy/2"}'}),
    'a format that is a list': save({}, metadata={'dae_ros': '{"format": ["dae_ros.policy/1"]}'}),
    'a header of lists': with_header(b'[' * 20_000),
    'a header that is a list': with_header([]),
    'a header of another encoding': with_header('{"ü": 1}'.encode('utf-16')),
    'metadata that are a text': with_header({'__metadata__': 'dae_ros'}),
    'a header longer than the file': struct.pack('<Q', 2**63) + b'{}',
    'a header longer than there are numbers': struct.pack('<Q', 2**64 - 1) + b'{}',
}


@pytest.mark.parametrize('data', FOREIGN.values(), ids=FOREIGN)
def test_a_foreign_file_is_refused(data):
    for decode in (codec.decode_policy, codec.decode_checkpoint):
        assert reason_for(data, decode) == 'corrupt'


def test_a_checkpoint_is_no_policy_and_a_policy_no_checkpoint():
    assert reason_for(encoded_checkpoint()) == 'corrupt'
    assert reason_for(codec.encode_policy(random_policy()), codec.decode_checkpoint) == 'corrupt'


ENTRIES = {
    'beyond the file': {'dtype': 'F32', 'shape': [4], 'data_offsets': [10**6, 10**6 + 16]},
    'backwards': {'dtype': 'F32', 'shape': [4], 'data_offsets': [16, 0]},
    'negative': {'dtype': 'F32', 'shape': [4], 'data_offsets': [-16, 0]},
    'too short for its shape': {'dtype': 'F32', 'shape': [400], 'data_offsets': [0, 8]},
    'of a shape beyond all numbers': {'dtype': 'F32', 'shape': [2**63, 2], 'data_offsets': [0, 0]},
    'of no elements and too many': {'dtype': 'F32', 'shape': [0, 2**64 - 1], 'data_offsets': [8, 8]},
    'of a hundred dimensions': {'dtype': 'F32', 'shape': [0] * 100, 'data_offsets': [8, 8]},
    'of an unknown type': {'dtype': 'Q8', 'shape': [1], 'data_offsets': [0, 1]},
    'of a type numpy lacks': {'dtype': 'BF16', 'shape': [4], 'data_offsets': [0, 8]},
    'of half a byte': {'dtype': 'F4', 'shape': [16], 'data_offsets': [0, 8]},
    'without a shape': {'dtype': 'F32', 'data_offsets': [0, 8]},
    'that is a number': 5,
}


@pytest.mark.parametrize('entry', ENTRIES.values(), ids=ENTRIES)
def test_a_tensor_that_cannot_be_is_refused(entry):
    formats = {codec.POLICY_FORMAT: codec.decode_policy, codec.CHECKPOINT_FORMAT: codec.decode_checkpoint}
    for kind, decode in formats.items():
        metadata = {'dae_ros': json.dumps({'format': kind, **SIZES._asdict()})}
        assert reason_for(with_header({'__metadata__': metadata, 'weight': entry}, bytes(8)), decode) == 'corrupt'


def without(name):
    return {key: tensor for key, tensor in random_tensors().items() if key != name}


SHAPES = {
    'a tensor missing': file_of(without('gru.bias_hh')),
    'a tensor more': file_of({**random_tensors(), 'more': np.zeros(1, np.float32)}),
    'a tensor transposed': file_of({**random_tensors(), 'head.weight': np.zeros((4, 2), np.float32)}),
    'no tensors': file_of({}),
    'another architecture': file_of(hidden_size=5),
    'another number of layers': file_of(mlp_layers=2),
    'a size of zero': file_of(observation_size=0),
    'a negative size': file_of(num_actions=-1),
    'a size beyond reason': file_of(hidden_size=2**40),
    'layers beyond reason': file_of(mlp_layers=2**40),
    'a size that is a fraction': file_of(hidden_size=4.0),
    'a size that is true': file_of(mlp_layers=True),
    'a size that is text': file_of(hidden_size='4'),
    'an unknown activation': file_of(activation='gelu'),
    'an activation that is a list': file_of(activation=['relu']),
    'an entry missing': file_of(activation=None),
    'an entry more': file_of(dropout=0.5),
}


@pytest.mark.parametrize('data', SHAPES.values(), ids=SHAPES)
def test_tensors_and_sizes_that_do_not_belong_together_are_refused(data):
    assert reason_for(data) == 'wrong_shape'


HOSTILE = {'half a character': '\ud800', 'a long one': 'x' * 10**6, 'a new line and a colour': 'a\nb\x1b[31m'}


@pytest.mark.parametrize('name', HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_name_in_a_schema_is_refused_with_a_text_that_fits_in_a_line_of_a_log(name):
    for data in (file_of(**{name: 1}), file_of(format=name), file_of(activation=name)):
        with pytest.raises(Refused) as caught:
            codec.decode_policy(data)
        text = str(caught.value)
        assert text.encode().decode().isprintable() and len(text) < 1000


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf], ids=str)
@pytest.mark.parametrize('name', SIZES.shapes())
def test_weights_that_are_not_finite_are_refused(name, value):
    tensors = random_tensors()
    tensors[name].flat[-1] = value
    assert reason_for(file_of(tensors)) == 'not_finite'


@pytest.mark.parametrize('kind', [np.float64, np.float16, np.int32, bool], ids=lambda kind: np.dtype(kind).name)
def test_weights_that_are_not_32_bit_numbers_are_refused(kind):
    tensors = random_tensors()
    tensors['head.bias'] = tensors['head.bias'].astype(kind)
    assert reason_for(file_of(tensors)) in ('not_finite', 'wrong_shape')


MUTATIONS = strategies.lists(strategies.tuples(
    strategies.sampled_from(['flip', 'set', 'insert', 'delete', 'repeat', 'header']), strategies.integers(0, 2**16),
    strategies.integers(0, 255)), min_size=1, max_size=6)


def mutate(data, mutations):
    data = bytearray(data)
    for how, where, value in mutations:
        position = where % len(data)
        if how == 'flip':
            data[position] ^= 1 << value % 8
        elif how == 'set':
            data[position] = value
        elif how == 'insert':
            data.insert(position, value)
        elif how == 'delete' and len(data) > 9:
            del data[position]
        elif how == 'repeat':
            data[position:position] = data[position:position + value]
        elif how == 'header':  # digits and brackets in the header, where the damage is greatest
            data[(8 + where % 1200) % len(data)] = b'0123456789[]{}",:-'[value % 18]
    return bytes(data)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(mutations=MUTATIONS)
def test_a_damaged_policy_is_refused_or_is_a_policy_one_can_act_with(mutations):
    try:
        policy = codec.decode_policy(mutate(codec.encode_policy(random_policy()), mutations))
    except Refused as refusal:
        assert refusal.reason in ('corrupt', 'wrong_shape', 'not_finite')
    else:
        assert {name: tensor.shape for name, tensor in policy.tensors.items()} == policy.architecture.shapes()
        assert all(np.isfinite(tensor).all() for tensor in policy.tensors.values())


@settings(max_examples=300, deadline=None, derandomize=True)
@given(mutations=MUTATIONS)
def test_a_damaged_checkpoint_is_refused_or_has_the_tensors_it_had(mutations):
    try:
        tensors, _ = codec.decode_checkpoint(mutate(encoded_checkpoint(), mutations))
    except Refused as refusal:
        assert refusal.reason == 'corrupt'
    else:
        assert_same(tensors, some_tensors())


@settings(max_examples=200, deadline=None, derandomize=True)
@given(data=strategies.binary(max_size=300), length=strategies.integers(0, 300))
def test_noise_is_refused(data, length):
    for noise in (data, struct.pack('<Q', length) + data):
        for decode in (codec.decode_policy, codec.decode_checkpoint):
            assert reason_for(noise, decode) == 'corrupt'
