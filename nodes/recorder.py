"""recorder: writes what a team says into a rosbag2 bag, message for message and without decoding.

    ros2 run dae_ros recorder --ros-args -p num_agents:=3 -p bag:=bags/navigation
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from datetime import datetime
from functools import partial
from pathlib import Path

from dae_ros.config import SETTINGS, RecorderSettings, declarations
from dae_ros.replay.gaps import Gaps
from dae_ros.replay.recording import FLUSH_PERIOD, Recording
from dae_ros.ros.node import TeamNode, run
from dae_ros.ros.recorded import RecordedTopic, as_written, team_topics

NICENESS = 10  # the team comes first: what comes while it works is kept until the recorder's turn


class RecorderNode(TeamNode):
    """Wires topics to a `Recording`."""

    def __init__(self):
        super().__init__('recorder', [*declarations(RecorderSettings), SETTINGS['num_agents'], SETTINGS['world_groups']])
        settings = self.settings
        topics = team_topics(settings['num_agents'], settings['world_groups'], settings['everything'])
        full_names = [self.resolve_topic_name(topic.name) for topic in topics]
        path = Path(settings['bag'] or f'bags/{datetime.now():%Y%m%d-%H%M%S}')
        self._gaps = Gaps()
        self._missed: Counter[str] = Counter()
        self._epoch = time.time_ns() - time.monotonic_ns()  # what is set later neither stops it nor changes the order
        self._recording = Recording(path, [as_written(*topic) for topic in zip(topics, full_names)], settings['storage'],
                                    settings['compression'], settings['split_megabytes'] * 10**6,
                                    settings['split_seconds'] * 10**9)
        for topic, full_name in zip(topics, full_names):
            self.listen(topic.kind, topic.name, topic.profile, partial(self._record, topic, full_name), raw=True)
        self.every(FLUSH_PERIOD / 1e9, lambda: self._recording.flush_if_due(self._now()))
        self.get_logger().info(f'recording {len(topics)} topics in {self._recording.path}')

    def _record(self, topic: RecordedTopic, full_name: str, data: bytes) -> None:
        self._recording.write(full_name, self._now(), data)
        missing = self._gaps.missing(full_name, data) if topic.stamped else 0
        if missing:
            if not self._missed[full_name]:
                self.get_logger().warning(f'{missing} messages on {full_name} were missed (further ones are only counted)')
            self._missed[full_name] += missing

    def _now(self) -> int:
        """The host's clock as it was set when the recorder began [ns]."""
        return self._epoch + time.monotonic_ns()

    def diagnose(self):
        silent = self.silent_topics()
        sentence = f'waiting for {silent}' if silent else 'recording'
        return sentence, {'bag': str(self._recording.path), 'messages': self._recording.messages.total(),
                          **{f'missed {topic}': count for topic, count in sorted(self._missed.items())}}

    def close(self) -> None:
        self._recording.close()
        missed = f'; {self._missed.total()} were missed' if self._missed else ''
        print(f'{self._recording.messages.total()} messages in {self._recording.path}{missed}', flush=True)


def main(args: list[str] | None = None) -> int:
    os.nice(NICENESS)
    return run(RecorderNode, args)


if __name__ == '__main__':
    sys.exit(main())
