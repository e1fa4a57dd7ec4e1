"""What all nodes share: settings as parameters, refusals counted by reason and shown on /diagnostics, a clean end."""

from __future__ import annotations

import gc
import signal
from collections import Counter
from contextlib import contextmanager
from typing import Any, Callable, Iterable, Iterator
from weakref import WeakSet

import rclpy
from dae_ros_msgs.msg import TrainingStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage

from dae_ros.command import refuse
from dae_ros.config import SettingInfo
from dae_ros.errors import DaeRosError, Refused, SettingsError
from dae_ros.robots.standard_messages import seconds
from dae_ros.ros import names, params, qos, transport
from dae_ros.ros.clock_watch import ClockWatch
from dae_ros.ros.farewell import leave

try:
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:  # an older Jazzy: its executor builds a wait set of everything anew for each message
    from rclpy.executors import SingleThreadedExecutor as Executor

DIAGNOSTICS_PERIOD = 1.0  # s
OVERLOOKED_PERIOD = 1.0  # s between looks for latched messages that were not announced
FAREWELL = Duration(seconds=2)  # to let a node's last words reach who listens
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
LONG = 3600.0  # s; without a limit this executor does not wait but spins


_READ_ONLY = SetParametersResult(successful=False, reason='settings are read-only: start the node with others')


def _set_none(request: SetParameters.Request, response: SetParameters.Response) -> SetParameters.Response:
    response.results = [_READ_ONLY] * len(request.parameters)
    return response


def _set_none_of_all(_: SetParametersAtomically.Request,
                     response: SetParametersAtomically.Response) -> SetParametersAtomically.Response:
    response.result = _READ_ONLY
    return response


_nodes_of_process: WeakSet[TeamNode] = WeakSet()  # also those refused while they were being made

_REFUSALS = {SetParameters: _set_none, SetParametersAtomically: _set_none_of_all}


class TeamNode(Node):
    """A node of the team's graph.

    Subclasses take what they need from `settings`, call `listen` and `publisher`, and may override `on_matched`, called
    whenever an endpoint of theirs found or lost a partner, `on_new_source` and `diagnose`.
    """

    def __init__(self, name: str, declared: Iterable[SettingInfo], clock_of: TeamNode | None = None, **given: Any):
        """`clock_of`: a node of this process that hears simulated time for this one too. `given` are settings that hold whatever
        the command line says."""
        self._clock_of = clock_of or self
        self._clock_hearers: list[Callable[[ClockMessage], None]] = []
        super().__init__(name, automatically_declare_parameters_from_overrides=True,
                         parameter_overrides=[Parameter(key, value=value) for key, value in given.items()])
        _nodes_of_process.add(self)
        self.settings: dict[str, Any] = params.declare(self, declared)
        self.done = False
        self.busy = False  # whether a callback is at work
        self.is_in_trouble = False  # whether diagnostics warn; `diagnose` may set it
        self.failure: BaseException | None = None  # what a callback raised; ends the node
        self._moment: float | None = None  # of simulated time, where each counts
        self._refusals: Counter[tuple[str, str]] = Counter()
        self._subscriptions_by_topic: dict[str, Subscription] = {}
        self._diagnostics = self.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos.EVENTS)
        self.every(DIAGNOSTICS_PERIOD, self.publish_diagnostics)
        look_for_overlooked(self)

    def publisher(self, kind: type, topic: str, profile: QoSProfile) -> Publisher:
        """A publisher whose partners coming and going call `on_matched`."""
        callbacks = PublisherEventCallbacks(matched=self._guarded(lambda _: self.on_matched()))
        return self.create_publisher(kind, topic, profile, event_callbacks=callbacks)

    def listen(self, kind: type, topic: str, profile: QoSProfile, handle: Callable[[Any], None],
               raw: bool = False) -> Subscription:
        """A subscription; a message that `handle` refuses is counted and otherwise ignored. `raw`: as bytes, not decoded."""
        def receive(message) -> None:
            with self.refusing(topic):
                handle(message)

        def match(change) -> None:
            if change.total_count_change > 0:
                self.on_new_source()
            self.on_matched()

        callbacks = SubscriptionEventCallbacks(matched=self._guarded(match))
        subscription = self.create_subscription(kind, topic, self._guarded(receive), profile, event_callbacks=callbacks, raw=raw)
        self._subscriptions_by_topic[topic] = subscription
        return subscription

    def silent_topics(self) -> str:
        """The topics listened to that nobody publishes, for people to read; empty where there are none."""
        return ', '.join(topic for topic, subscription in self._subscriptions_by_topic.items()
                         if not subscription.get_publisher_count())

    def every(self, period: float, act: Callable[[], None]) -> Timer:
        """A timer that calls `act` each `period` seconds, whatever becomes of the host's clock or of simulated time."""
        return self.create_timer(period, self._guarded(act), clock=STEADY)

    def as_time_goes_on(self, period: float, act: Callable[[], None], profile: QoSProfile) -> None:
        """Calls `act` each `period` seconds, or where time is simulated with each message of its clock, once there are any.

        So no moment is passed over, however much faster than ours it runs. `now` is then the one at hand; `profile` says whether
        each counts or the newest.
        """
        def on_clock(message: ClockMessage) -> None:
            self._moment = seconds(message.clock)
            act()

        def on_timer() -> None:
            if not self._moment:
                act()

        self.every(period, on_timer)
        if self.get_parameter('use_sim_time').value:
            self._moment = 0.0
            self.listen(ClockMessage, names.CLOCK, profile, on_clock)

    def create_subscription(self, msg_type: type, topic: str, callback: Callable, *arguments, **options) -> Subscription:
        """A subscription. rclpy makes one of simulated time for each node; `clock_of` has one for several."""
        if not isinstance(getattr(callback, '__self__', None), TimeSource):
            return super().create_subscription(msg_type, topic, callback, *arguments, **options)
        hearers = self._clock_of._clock_hearers
        hearers.append(callback)
        if self is not self._clock_of:
            return self._clock_of._clock_subscription

        def hear(message: ClockMessage) -> None:
            for hearer in hearers:
                hearer(message)

        self._clock_subscription = super().create_subscription(msg_type, topic, hear, *arguments, **options)
        return self._clock_subscription

    def create_service(self, srv_type: type, srv_name: str, callback: Callable, **options) -> Service:
        """A service. Those with which rclpy lets anyone change parameters refuse: it would fall over a value of an unknown type,
        and with simulated time switched on the node's clock stands still."""
        return super().create_service(srv_type, srv_name, _REFUSALS.get(srv_type, callback), **options)

    def _guarded(self, act: Callable[..., None]) -> Callable[..., None]:
        """`act` as a callback whose error `run` raises: raised into the executor, it would also be logged as the executor's."""
        def call(*arguments) -> None:
            try:
                self.busy = True
                act(*arguments)
            except BaseException as error:
                self.failure = error
            finally:
                self.busy = False

        return call

    def now(self) -> float:
        """The time of this node's clock [s]; 0 before simulated time has begun."""
        return self.get_clock().now().nanoseconds / 1e9 if self._moment is None else self._moment

    def refuse(self, topic: str, refusal: Refused) -> None:
        """Counts a refused message; the first one for each topic and reason is also logged."""
        self._refusals[topic, refusal.reason] += 1
        if self._refusals[topic, refusal.reason] == 1:
            self.get_logger().warning(f'refused a message on {topic}: {refusal} (further ones are only counted)')

    @contextmanager
    def refusing(self, topic: str) -> Iterator[None]:
        """What is refused within is counted for this topic and otherwise ignored."""
        try:
            yield
        except Refused as refusal:
            self.refuse(topic, refusal)

    def on_matched(self) -> None:
        """An endpoint found or lost a partner."""

    def on_new_source(self) -> None:
        """Somebody new publishes what this node listens to: a node that has just started, perhaps in place of one that died."""

    def diagnose(self) -> tuple[str, dict[str, Any]]:
        """One sentence on what the node is doing, and values worth showing."""
        return 'running', {}

    def publish_diagnostics(self) -> None:
        """Publishes the node's state and the counts of refused messages."""
        message, values = self.diagnose()
        values |= {f'refused {topic} {reason}': count for (topic, reason), count in sorted(self._refusals.items())}
        self._report(DiagnosticStatus.WARN if self._refusals or self.is_in_trouble else DiagnosticStatus.OK, message, values)

    def _report(self, level: bytes, message: str, values: dict[str, Any]) -> None:
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=message,
                                  values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        report = DiagnosticArray(status=[status])
        report.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(report)

    def say_why(self, error: DaeRosError) -> None:
        """The last report of a node that ends because of this."""
        self._report(DiagnosticStatus.ERROR, str(error), {})
        self._diagnostics.wait_for_all_acked(FAREWELL)

    def close(self) -> None:
        """Releases what the node holds beyond ROS; called once, also after an error."""


def is_over(training: TrainingStatus) -> bool:
    """Whether it has ended, well or not: nodes that joined it and are not bound to its run are free for another."""
    return training.state in (TrainingStatus.FINISHED, TrainingStatus.FAILED)


def look_for_overlooked(node: Node) -> None:
    """Hands latched messages that lie unread to their callbacks, one of each topic each `OVERLOOKED_PERIOD`.

    rmw_fastrtps counts what a new subscription has unread and only then listens for more. What comes between is announced with
    the next message, but a latched one may have none after it: a robot's policy, the landmarks, a trainer that pauses.
    """
    def take() -> None:
        for subscription in node.subscriptions:
            if subscription.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                with subscription.handle:
                    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is not None:
                    subscription.callback(taken[0])

    node.create_timer(OVERLOOKED_PERIOD, take, clock=STEADY)


def set_timers_anew(nodes: Iterable[Node]) -> None:
    """Has the executor wait for the timers' next moments as its clock shows them now."""
    for node in nodes:
        for timer in node.timers:
            timer.reset()


def check_names(nodes: list[TeamNode], who: str) -> None:
    """SettingsError where nodes of one process, `who` in words, have the same name: one that the command line gave them all."""
    if len({node.get_name() for node in nodes}) < len(nodes):
        raise SettingsError(f'{who} cannot all be named {nodes[0].get_name()}; leave __node to each')


def settings_of_process(name: str, declared: Iterable[SettingInfo]) -> dict[str, Any]:
    """What the command line says before the nodes are made whose number and kind depend on it. Raises SettingsError.

    Only a node can read it. It is gone before a node of the same name is made: the graph takes two of one name for one.
    """
    reader = Node(name, enable_rosout=False, start_parameter_services=False, automatically_declare_parameters_from_overrides=True)
    try:
        return params.declare(reader, declared)
    finally:
        leave([reader])


def run(make_node: Callable[[], TeamNode], args: list[str] | None = None) -> int:
    """Runs a node until it is done, interrupted or shut down; the exit code.

    0: done or asked to stop. 2: a setting or the surroundings are wrong, told in one sentence. A bug shows its traceback.
    """
    return run_together(lambda: [make_node()], args)


def run_together(make_nodes: Callable[[], list[TeamNode]], args: list[str] | None = None) -> int:
    """Runs the nodes of one process side by side, until one is done; otherwise as `run`."""
    nodes: list[TeamNode] = []
    executor = watch = None

    def interrupt(number, frame) -> None:
        """Ctrl-C breaks into our own callbacks, not into the executor's work; that stops by itself, as on SIGTERM."""
        if not nodes or any(node.busy for node in nodes):
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)  # rclpy's handler, which shuts the context down, calls this one
    try:
        try:
            transport.choose()
            rclpy.init(args=args)
            nodes += make_nodes()
            executor = Executor()
            for node in nodes:
                executor.add_node(node)
            # What start-up made lives as long as the nodes. Unfrozen, the garbage collector goes through all of it again and
            # again, a quarter of an agent's time, since every message makes a few objects.
            gc.collect()
            gc.freeze()
            watch = ClockWatch(lambda _: set_timers_anew(nodes))
            while rclpy.ok():
                executor.spin_once(LONG)
                for node in nodes:
                    if node.failure is not None:
                        if isinstance(node.failure, DaeRosError):
                            node.say_why(node.failure)
                        raise node.failure
                    if node.done:
                        return 0
            return 0
        except RuntimeError:
            # What rclpy raises when a callback still publishes after a signal has shut the context down.
            if rclpy.ok():
                raise
            return 0
        finally:
            # A terminal and a launch file each send their own Ctrl-C: the second must not break into the cleaning up.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
            if watch is not None:
                watch.close()
            if executor is not None:
                executor.shutdown()
            try:
                for node in nodes:
                    node.close()
            finally:
                leave(list(_nodes_of_process))
                rclpy.try_shutdown()
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (DaeRosError, OSError) as error:
        return refuse(error)
