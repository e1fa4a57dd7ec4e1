"""export_policy: writes a policy as an ONNX model, with recurrent state in and out, without ROS.

    ros2 run dae_ros export_policy policy.safetensors policy.onnx
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dae_ros.command import run_command
from dae_ros.files import write_atomically
from dae_ros.weights.codec import decode_policy, read_file
from dae_ros.weights.onnx_file import encode_onnx


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='export_policy', description=__doc__.split('\n')[0].removeprefix('export_policy: '))
    parser.add_argument('policy', type=Path, help='the policy.safetensors of a run')
    parser.add_argument('output', type=Path, help='the ONNX model to write')
    return parser.parse_args(arguments)


def export(source: Path, output: Path) -> None:
    """Writes the model and says what goes in and comes out. Raises DaeRosError."""
    policy = read_file(source, decode_policy, 'the file', 'policy')
    data, sizes = encode_onnx(policy), policy.architecture
    write_atomically(output, data)
    print(f'{output}: observation [W, {sizes.observation_size}], state [W, {sizes.hidden_size}] to probabilities '
          f'[W, {sizes.num_actions}], next_state [W, {sizes.hidden_size}]')


def main(args: list[str] | None = None) -> int:
    arguments = parse_arguments(args)

    def act() -> int:
        export(arguments.policy, arguments.output)
        return 0

    return run_command(act, 'stopped; nothing was written')


if __name__ == '__main__':
    sys.exit(main())
