"""Signatures of policies: who has the key is believed, for the run and the version signed, and nobody else."""

import pytest

from dae_ros.errors import Refused, SettingsError
from dae_ros.weights import codec, signing

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
WEIGHTS = codec.seal(run=7, version=3, data=b'weights', key=KEY)


def key_file(path, content=KEY, mode=0o600):
    path.write_bytes(content)
    path.chmod(mode)
    return path


def test_what_was_signed_is_taken_and_without_a_key_so_is_everything():
    signing.check_signature(WEIGHTS, KEY)
    for weights in (WEIGHTS, WEIGHTS._replace(signature=''), WEIGHTS._replace(data=b'others')):
        signing.check_signature(weights, None)


@pytest.mark.parametrize('changed', [
    {'run': 8}, {'version': 4}, {'run': 3, 'version': 7}, {'data': b'weightS'}, {'data': b''}, {'data': b'weights\0'},
    {'signature': ''},
    {'signature': WEIGHTS.signature[:-1]}, {'signature': WEIGHTS.signature.upper()}, {'signature': 'é'}, {'signature': '\ud800'},
    {'signature': codec.seal(7, 3, b'weights', OTHER).signature}, {'signature': codec.sha256(b'weights')}], ids=str)
def test_weights_that_were_not_signed_as_they_are_are_refused(changed):
    with pytest.raises(Refused) as caught:
        signing.check_signature(WEIGHTS._replace(**changed), KEY)
    assert caught.value.reason == 'forged'


def test_a_signature_is_looked_at_before_anything_is_decoded():
    with pytest.raises(Refused) as caught:
        codec.open_weights(WEIGHTS, OTHER)
    assert caught.value.reason == 'forged'
    with pytest.raises(Refused) as caught:
        codec.open_weights(WEIGHTS, KEY)
    assert caught.value.reason == 'corrupt'  # signed, but no policy


def test_equal_policies_have_equal_signatures_so_that_a_server_signs_as_the_trainer_did():
    assert codec.seal(7, 3, b'weights', KEY) == WEIGHTS


def test_a_key_is_what_the_file_holds(tmp_path):
    for content in (KEY, KEY + b'\n', bytes(4096)):
        assert signing.read_key(key_file(tmp_path / 'key', content)) == content


@pytest.mark.parametrize('content', [b'', KEY[:-1], bytes(4097)], ids=len)
def test_a_key_too_short_or_too_long_is_one_sentence_that_says_how_to_make_one(content, tmp_path):
    with pytest.raises(SettingsError, match=f'^key_file {tmp_path}/key must be a file of 32 to 4096 bytes .*head -c 32'):
        signing.read_key(key_file(tmp_path / 'key', content))


@pytest.mark.parametrize('mode', [0o640, 0o604, 0o620], ids=oct)
def test_a_key_that_others_may_read_or_write_is_one_sentence(mode, tmp_path):
    with pytest.raises(SettingsError, match=f'^key_file {tmp_path}/key is open to other users .*chmod 600 {tmp_path}/key$'):
        signing.read_key(key_file(tmp_path / 'key', mode=mode))


@pytest.mark.parametrize('name, sentence', [('missing', '^cannot read key_file .*missing: '), ('.', '^cannot read key_file '),
                                            ('/dev/zero', '^key_file /dev/zero must be a file of')])
def test_a_key_that_is_no_file_is_one_sentence(name, sentence, tmp_path):
    with pytest.raises(SettingsError, match=sentence):
        signing.read_key(tmp_path / name)
