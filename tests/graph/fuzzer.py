"""A stranger on the team's network: hears everything, and sends it back replayed, reordered, damaged or as rubbish.

What it sends is never what an honest node could send now: of the right run, of the rollout under way and in order. Without
DDS security such a forgery could not be told from the truth.
"""

from __future__ import annotations

import random
from array import array
from collections import Counter, deque
from functools import partial

from dae_ros_msgs import msg
from harness import Listener
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.serialization import deserialize_message, serialize_message

from dae_ros.ros import names, qos
from dae_ros.ros.recorded import team_topics

LONGEST = 2**20  # bytes of a message it sends again
EXTREMES = (0, 1, 2, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1)
HOSTILE_TEXTS = ('', 'x' * 10_000, '\x1b[2J\x1b[31m', 'a\nb\r\0c', '[bold]%s{0}', '🤖' * 100)


class Fuzzer:
    """Sends a hostile message for each it hears of the team in `run`, and at most so many; `sent` counts them by kind."""

    def __init__(self, listener: Listener, run: int, num_agents: int, seed: int, most: int):
        self.sent: Counter[str] = Counter()
        self._run = run
        self._most = most
        self._draw = random.Random(seed)
        self._newest = 0  # rollout asked for
        topics = {topic.name: (topic.kind, topic.profile) for topic in team_topics(num_agents, 1, everything=True)}
        topics[names.POLICY_UPDATE] = (msg.PolicyWeights, qos.RECORDED_LATCHED)
        self._heard = {topic: deque(maxlen=300) for topic in topics}
        self._kinds = {topic: kind for topic, (kind, _) in topics.items()}
        self._known: set[int] = set()  # what it has sent or heard
        self._publishers = {topic: listener.node.create_publisher(kind, topic, qos.LATCHED_INPUT)
                            for topic, (kind, _) in topics.items()}
        for topic, (kind, profile) in topics.items():
            listener.node.create_subscription(kind, topic, partial(self._hear, topic), profile, raw=True)

    def _hear(self, topic: str, data: bytes) -> None:
        forms = (hash(data[4:len(data) - filled]) for filled in range(4))  # DDS fills up to four bytes
        if len(data) > LONGEST or not self._known.isdisjoint(forms):
            return
        self._known.add(hash(data[4:]))
        try:
            message = deserialize_message(data, self._kinds[topic])
        except _rclpy.RMWError:
            return  # some of its own rubbish
        self._heard[topic].append(data)
        if topic == names.ROLLOUT_REQUEST:
            self._newest = max(self._newest, message.rollout)
        if self.sent.total() < self._most:
            self.attack()

    def attack(self) -> None:
        """Sends one hostile message."""
        topic = self._draw.choice([topic for topic, heard in self._heard.items() if heard])
        how = self._draw.choice((self._replayed, self._of_another_run, self._damaged, self._of_a_rollout_that_is_over,
                                 self._rubbish))
        data = self._draw.choice(self._heard[topic])
        hostile = how(deserialize_message(data, self._kinds[topic]))
        if hostile is None:
            return
        raw = hostile if isinstance(hostile, bytes) else serialize_message(hostile)
        self._known.add(hash(raw[4:]))
        self._publishers[topic].publish(raw)
        self.sent[how.__name__.lstrip('_')] += 1

    # The kinds of attack. None: not possible with this message.

    def _replayed(self, message):
        return message

    def _of_another_run(self, message):
        self._scramble(message)
        foreign = self._run ^ 1 << self._draw.randrange(62)
        if hasattr(message, 'stamp'):
            message.stamp.run = foreign
        else:
            message.run = foreign
        return message

    def _damaged(self, message):
        """Something is missing, too much or no number: to be refused whatever rollout it is of."""
        if isinstance(message, msg.RolloutRequest):
            message.num_steps = 0
            return message
        fields = [name for name in message.get_fields_and_field_types() if isinstance(getattr(message, name), array)]
        if not fields:
            return None
        name = self._draw.choice(fields)
        values = getattr(message, name)
        choices = [values[:-1], values + values[:1], values * 5, array(values.typecode)]
        if values.typecode == 'f' and values:
            place, wrong = self._draw.randrange(len(values)), self._draw.choice((float('nan'), float('inf'), -float('inf')))
            choices += [values[:place] + array('f', [wrong]) + values[place + 1:]] * 4
        setattr(message, name, self._draw.choice(choices))
        return message

    def _of_a_rollout_that_is_over(self, message):
        """Anything at all, with a stamp that is stale. Policies have signatures, and nothing is decided by a status."""
        rollout = getattr(message, 'stamp', message)
        if hasattr(rollout, 'rollout') and rollout.rollout >= self._newest:
            return None
        self._scramble(message)
        return message

    def _rubbish(self, message):
        """Bytes that are no message, or one that says it is longer than it is."""
        data = serialize_message(message)
        length = self._draw.randrange(4, len(data))  # no more: DDS keeps so much for a message of a fixed size
        return data[:length] if self._draw.random() < 0.5 else data[:4] + self._draw.randbytes(length - 4)

    def _scramble(self, message) -> None:
        """Sets some fields to extremes, but for what says of which run and rollout the message is."""
        for name, kind in message.get_fields_and_field_types().items():
            if name in ('stamp', 'run', 'rollout', 'attempt') or self._draw.random() < 0.5:
                continue
            value = getattr(message, name)
            if isinstance(value, array):
                value = array(value.typecode, self._draw.randbytes(value.itemsize * self._draw.choice((0, 1, len(value), 5_000))))
            elif isinstance(value, str):
                value = self._draw.choice(HOSTILE_TEXTS)
            elif isinstance(value, bool):
                value = not value
            elif isinstance(value, float):
                value = self._draw.choice((0.0, -1.0, float('nan'), float('inf'), -float('inf'), 5e-324, 1.7e308))
            else:
                value = self._draw.choice(EXTREMES) % 2**{'uint8': 8, 'uint32': 32, 'uint64': 64}[kind]
            setattr(message, name, value)
        if hasattr(message, 'stamp'):
            message.stamp.step = self._draw.choice((message.stamp.step, *EXTREMES))
