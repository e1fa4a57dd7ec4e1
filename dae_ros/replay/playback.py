"""What there is to play in bags: topics, number of messages, times; and the messages, one bag after the other."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Callable, Iterator, NamedTuple

from dae_ros.errors import BagError
from dae_ros.replay.bag import Bag, find_bags
from dae_ros.replay.mcap import Accept, Message


class PlayedTopic(NamedTuple):
    """A topic in the bags."""

    name: str
    type: str
    qos: str  # the profiles it was offered with, as YAML; '' where the bag does not say


class Playback:
    """The messages of some topics in bags, streamed from disk each time they are asked for."""

    def __init__(self, bags: list[str], accept: Accept, wanted: Callable[[str], bool] = lambda topic: True):
        """Reads all bags once; crashed ones have no table of contents. `accept`: as for `Bag`; `wanted`: by a topic's name.

        Raises BagError if there is nothing to play.
        """
        self._paths: list[Path] = find_bags(*bags)
        self._accept = accept
        self._wanted = wanted
        self.damage: Counter[str] = Counter()
        self.topics: dict[str, PlayedTopic] = {}
        self.count = 0
        self.first = self.last = 0  # ns, when the first message was recorded and the last one
        for message in self.messages():
            if message.topic not in self.topics:
                self.topics[message.topic] = PlayedTopic(message.topic, message.type, message.qos)
            self.first = self.first or message.time
            self.last = max(self.last, message.time)
            self.count += 1
        if not self.count:
            raise BagError(f'there is nothing to play in {", ".join(map(str, self._paths))}: no message on a topic asked for '
                           'and of a type that is installed here')

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last."""
        return (self.last - self.first) / 1e9

    def messages(self) -> Iterator[Message]:
        """All of them, in the order they were recorded."""
        self.damage.clear()
        for path in self._paths:
            for message in Bag(path, self.damage, self._accept).messages():
                if self._wanted(message.topic):
                    yield message
