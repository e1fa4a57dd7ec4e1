"""A node takes in the one message of a latched topic that the middleware has received but does not announce."""

from __future__ import annotations

import subprocess
import sys

from harness import TIMEOUT, Listener, preloadable
from std_msgs.msg import String

from dae_ros.ros import qos

HEARER = """
from std_msgs.msg import String
from dae_ros.ros import qos
from dae_ros.ros.node import TeamNode, run

class HearerNode(TeamNode):
    def __init__(self):
        super().__init__('hearer', ())
        self.listen(String, 'said_once', qos.LATCHED_INPUT, self._hear)

    def _hear(self, message):
        print(message.data)
        self.done = True

run(HearerNode)
"""


def test_a_latched_message_that_comes_while_rmw_sets_a_subscription_up_is_heard(domain, tmp_path, monkeypatch):
    counted = tmp_path / 'counted'
    monkeypatch.setenv('COUNTED', str(counted))
    with Listener() as listener:
        speaker = listener.node.create_publisher(String, 'said_once', qos.LATCHED)
        monkeypatch.setenv('LD_PRELOAD', str(preloadable('unannounced.c', tmp_path)))
        hearer = subprocess.Popen([sys.executable, '-c', HEARER], stdout=subprocess.PIPE, text=True)
        try:
            listener.spin_until(lambda: counted.exists() and speaker.get_subscription_count())
            speaker.publish(String(data='once'))
            assert hearer.communicate(timeout=TIMEOUT) == ('once\n', None)
        finally:
            hearer.kill()
