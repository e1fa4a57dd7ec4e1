"""python -m benchmarks.execution: milliseconds from an observation that reaches a robot's agent to its action, over DDS.

The agent is a process of its own and says its times on /diagnostics; the round trip is what the sender of the observations sees.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np

from benchmarks.machine import ROOT

ANSWERS = 1000  # as many as the agent remembers
PERIOD = 0.01   # s between observations
TIMEOUT = 60.0  # s without an answer
POLICY = ROOT / 'config' / 'policies' / 'navigation.safetensors'


def measure() -> dict[str, float]:
    """Median and 99th percentile of the agent's own time and of the round trip, in ms; navigation with three robots."""
    import rclpy
    from dae_ros_msgs import msg
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor

    from dae_ros.ros import convert, names, qos
    from dae_ros.ros.farewell import leave
    from dae_ros.ros.graph import node_environment
    from dae_ros.types import Observation, Stamp

    os.environ.update(node_environment())
    agent = subprocess.Popen([sys.executable, '-m', 'dae_ros_nodes.agent', '--ros-args', '-p', f'policy_file:={POLICY}'])
    rclpy.init(args=[])
    node = rclpy.create_node('benchmark')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    answers, said = [], {}
    publisher = node.create_publisher(msg.Observation, names.OBSERVATION.format(0), qos.LATCHED)
    node.create_subscription(msg.Action, names.ACTION.format(0), answers.append, qos.ROLLOUT)
    node.create_subscription(DiagnosticArray, names.DIAGNOSTICS,
                             lambda heard: said.update((value.key, value.value) for value in heard.status[0].values), qos.EVENTS)

    def spin_until(condition) -> None:
        end = time.monotonic() + TIMEOUT
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError('the agent does not answer')
            executor.spin_once(timeout_sec=0.1)

    try:
        spin_until(lambda: publisher.get_subscription_count() and node.count_publishers(names.ACTION.format(0)))
        draw, taken = np.random.default_rng(0), np.empty(ANSWERS)
        for index in range(ANSWERS):
            values = draw.standard_normal((1, 18), np.float32)
            stamp = Stamp(1, index // 25, 0, index % 25)
            message = convert.observation_message(Observation(stamp, 0, 0, np.array([index % 25 == 0]), values))
            began = time.perf_counter()
            publisher.publish(message)
            spin_until(lambda: len(answers) > index)
            taken[index] = time.perf_counter() - began
            rest = began + PERIOD - time.perf_counter()
            if rest > 0:
                time.sleep(rest)  # the rhythm of a robot, not the haste of a loop
        said.clear()
        spin_until(lambda: 'answer time, median [ms]' in said)
    finally:
        agent.terminate()
        agent.wait()
        executor.shutdown()
        leave([node])
        rclpy.try_shutdown()
    return {'median': float(said['answer time, median [ms]']), 'percentile_99': float(said['answer time, 99th percentile [ms]']),
            'round_trip_median': 1e3 * float(np.median(taken)), 'round_trip_percentile_99': 1e3 * float(np.percentile(taken, 99))}


def main() -> None:
    for name, milliseconds in measure().items():
        print(f'{name:25}{milliseconds:8.3f} ms')


if __name__ == '__main__':
    main()
