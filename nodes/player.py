"""player: publishes bags in order, as they were recorded, without decoding them.

    ros2 run dae_ros player bags/navigation --rate 2 --start-paused
    ros2 run dae_ros player bags/navigation --fast --wait-for-subscribers --exclude-topics /training_status

Its services ~/pause, ~/resume and ~/play_next stop it, let it go on, and let one message through. What follows --ros-args is
for ROS, as for every node.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
import time
from typing import Callable

from rclpy.utilities import remove_ros_args
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from std_srvs.srv import Trigger

from dae_ros.errors import SettingsError
from dae_ros.replay.pace import Pace
from dae_ros.replay.playback import Playback
from dae_ros.ros.graph import acknowledging_environment
from dae_ros.ros.node import TeamNode, run
from dae_ros.ros.outlet import Outlet, message_class, playable, recorded_profile

REFRESH_PERIOD = 0.2  # s between two looks of the progress bar


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'must be above 0, not {value:g}')
    return value


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='player', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('bag', nargs='+', help='bags (folders or files) and glob patterns, played one after the other')
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument('-r', '--rate', type=positive, default=1.0, help='times as fast as it was recorded')
    pace.add_argument('--fast', action='store_true',
                      help='as fast as the reliable subscribers take it: what is under way stays within the queues')
    parser.add_argument('-p', '--start-paused', action='store_true', help='wait for ~/resume or ~/play_next')
    parser.add_argument('-l', '--loop', action='store_true', help='begin again at the end')
    parser.add_argument('--start-offset', type=float, default=0.0, metavar='SECONDS', help='leave out the beginning')
    parser.add_argument('--topics', nargs='+', default=[], metavar='TOPIC', help='play these topics alone')
    parser.add_argument('--exclude-topics', nargs='+', default=[], metavar='TOPIC', help='do not play these topics')
    parser.add_argument('--namespace', default='', help='put this before the name of every topic')
    parser.add_argument('--wait-for-subscribers', action='store_true', help='begin when every topic has a subscriber')
    return parser.parse_args(arguments)


class PlayerNode(TeamNode):
    """Wires a `Playback` to publishers. A thread of its own plays, at a `Pace` that the services change."""

    def __init__(self, options: argparse.Namespace):
        super().__init__('player', [])
        self._options = options
        self._playback = Playback(options.bag, playable, self._is_wanted)
        self._damage = dict(self._playback.damage)
        if options.start_offset > self._playback.duration:
            raise SettingsError(f'--start-offset {options.start_offset:g} lies behind the last message, at '
                                f'{self._playback.duration:g} s')
        self._pace = Pace(math.inf if options.fast else options.rate, options.start_paused)
        self._played, self._moment = 0, 0.0  # messages in all, and where in the bag it is [s]
        self._everyone_is_there = threading.Event()
        self._outlets: dict[str, Outlet] = {}
        for topic in self._playback.topics.values():
            profile = recorded_profile(topic.qos)
            publisher = self.publisher(message_class(topic.type), self._played_name(topic.name), profile)
            self._outlets[topic.name] = Outlet(publisher, profile, self._going_on if options.fast else None)
        self._serve('pause', self._pace.pause, 'is paused already')
        self._serve('resume', self._pace.resume, 'is not paused')
        self._serve('play_next', self._pace.play_next, 'is not paused')
        self.get_logger().info(f'{self._playback.count:,} messages on {len(self._outlets)} topics in '
                               f'{self._playback.duration:.1f} s')
        self.on_matched()
        self._playing = threading.Thread(target=self._guarded_play, name='playing')
        self._playing.start()

    def _is_wanted(self, topic: str) -> bool:
        options = self._options
        return (not options.topics or topic in options.topics) and topic not in options.exclude_topics

    def _played_name(self, topic: str) -> str:
        namespace = self._options.namespace.strip('/')
        return f'/{namespace}{topic}' if namespace else topic

    def on_matched(self) -> None:
        if not self._missing():
            self._everyone_is_there.set()

    def _missing(self) -> list[str]:
        """Topics that wait for a subscriber."""
        if not self._options.wait_for_subscribers:
            return []
        return [topic for topic, outlet in self._outlets.items() if not outlet.publisher.get_subscription_count()]

    def _serve(self, name: str, act: Callable[[], bool], refusal: str) -> None:
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success = act()
            response.message = '' if response.success else refusal
            return response

        self.create_service(Trigger, f'~/{name}', answer)

    # In the playing thread.

    def _guarded_play(self) -> None:
        """Ends the node, which looks at least once a second. An error while the node is being ended comes from just that."""
        try:
            self._play()
        except BaseException as error:
            if self.context.ok():
                self.failure = error
        self.done = True

    def _play(self) -> None:
        self._everyone_is_there.wait()
        columns = TextColumn('{task.description}'), BarColumn(bar_width=None), TextColumn('{task.fields[facts]}')
        console = Console(file=sys.stdout)
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            bar = progress.add_task('playing', total=self._playback.count, facts='')
            while self._going_on():
                self._play_once(progress, bar)
                if not self._options.loop:
                    break
        for outlet in self._outlets.values():
            outlet.wait_until_acknowledged(self._going_on)

    def _play_once(self, progress: Progress, bar) -> None:
        self._pace.begin(self._options.start_offset)
        shown_at = 0.0
        for number, message in enumerate(self._playback.messages(), 1):
            moment = (message.time - self._playback.first) / 1e9
            if moment < self._options.start_offset:
                continue
            if not self._pace.wait_for(moment):
                return
            self._outlets[message.topic].publish(bytes(message.data))
            self._played, self._moment = self._played + 1, moment
            if time.monotonic() - shown_at > REFRESH_PERIOD:
                shown_at = time.monotonic()
                progress.update(bar, completed=number, facts=f'{moment:.1f} of {self._playback.duration:.1f} s')

    def _going_on(self) -> bool:
        return not self._pace.stopped

    # In the node's thread.

    def diagnose(self):
        missing = self._missing() if not self._everyone_is_there.is_set() else []
        if missing:
            sentence = f'waiting for subscribers of {", ".join(missing)}'
        else:
            sentence = 'paused' if self._pace.paused else 'playing'
        return sentence, {'messages': self._played, 'seconds': f'{self._moment:.1f} of {self._playback.duration:.1f}',
                          **self._damage}

    def close(self) -> None:
        self._pace.stop()
        self._everyone_is_there.set()
        self._playing.join()
        print(f'{self._played} messages played', flush=True)


def main(args: list[str] | None = None) -> int:
    args = sys.argv if args is None else args
    options = parse_arguments(remove_ros_args(args)[1:])
    os.environ.update(acknowledging_environment())
    return run(lambda: PlayerNode(options), args)


if __name__ == '__main__':
    sys.exit(main())
