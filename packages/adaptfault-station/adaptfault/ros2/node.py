"""The lifecycle node: configure opens the bundle, activate subscribes. Needs rclpy.

The executor's one thread restores frames, another one monitors them
(:mod:`adaptfault.acquisition.watch`).
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy

from adaptfault.acquisition.followed import Follower
from adaptfault.acquisition.watch import Watch
from adaptfault.data.recordings.formats.message_arrays import arrays_at, join, put
from adaptfault.ros2.messages import choose_field, diagnostics_message, message_type, stamp_of
from adaptfault.ros2.parameters import DEFAULTS, Parameters, quoted, unknown
from adaptfault.ros2.rounds import Part, Rounds
from adaptfault.ros2.sensor import sensor_of

NAME = "tactile_diagnostics"

_DEPTH = 50  # frames that may wait to be restored; a longer queue would only make them late


class TactileDiagnostics(LifecycleNode):  # type: ignore[misc]
    """Monitors topics of tactile frames, publishes their faults on /diagnostics, and whole frames
    on other topics.

    A best-effort subscription takes frames of every publisher. A reliable publisher serves every
    subscriber.

    Raises:
        ValueError: a parameter has no value of its type, or nearly the name of one.
    """

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        given = self.get_parameters_by_prefix("")
        for text in unknown(given):
            self.get_logger().warning(text)
        any_type = ParameterDescriptor(dynamic_typing=True, read_only=True)
        values = {}
        for name, default in DEFAULTS.items():
            if name in given:
                values[name] = given[name].value
                self.set_descriptor(name, any_type)
            else:
                values[name] = self.declare_parameter(name, default, any_type).value
        self.parameters = Parameters.from_values(values)
        self._publishers_made: list[Any] = []
        self._subscriptions_made: list[Any] = []
        self._timer: Any = None
        self._monitoring: threading.Thread | None = None
        self._failure: Exception | None = None  # of the thread that monitors

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the bundle, and make the publishers."""
        try:
            self._configure()
        except (ValueError, OSError, NameValidationException) as error:  # parameters or bundle
            self.get_logger().error(" ".join(str(error).split()))
            self._remove_publishers()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def _configure(self) -> None:
        given = self.parameters
        topics = [self.resolve_topic_name(topic) for topic in given.topics]
        if len(set(topics)) < max(1, len(topics)):
            raise ValueError(f"parameter topic {given.topic!r}: name each topic once")
        self._type = message_type(given.topic_type)
        self._field = choose_field(self._type, given.field)
        self._follower = Follower(partial(sensor_of, given), given.bundle or None)
        sensor = self._follower.sensor
        self.watch = Watch(
            sensor,
            name=given.name,
            hardware_id=given.hardware_id,
            lines_held=given.lines_held or None,
        )
        self._diagnostics = self.create_lifecycle_publisher(DiagnosticArray, "/diagnostics", 1)
        self._publishers_made.append(self._diagnostics)
        self._whole = []
        for topic in given.restored_topics if sensor.restorer is not None else ():
            if self.resolve_topic_name(topic) in topics:
                raise ValueError(
                    f"topic and restored are both {topic}: restored frames would come back"
                )
            publisher = self.create_lifecycle_publisher(self._type, topic, QoSProfile(depth=_DEPTH))
            self._whole.append(publisher)
            self._publishers_made.append(publisher)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe, and monitor in a thread of its own."""
        done = super().on_activate(state)  # from now on publishers publish
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.watch.begin()
        self._monitoring = threading.Thread(
            target=self._monitor, name="adaptfault-monitor", daemon=True
        )
        self._monitoring.start()
        self._timer = self.create_timer(1.0, self._each_second)
        topics = self.parameters.topics
        self._rounds = Rounds(len(topics))
        for i, topic in enumerate(topics):
            take = partial(self._take, i)
            self._subscriptions_made.append(self.create_subscription(self._type, topic, take, qos))
        if self.parameters.scan:
            self._subscriptions_made.append(
                self.create_subscription(self._type, self.parameters.scan, self._take_scan, qos)
            )
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe."""
        self._unsubscribe()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up the publishers; the next configuration opens the bundle anew."""
        self._unsubscribe()
        self._remove_publishers()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up everything."""
        return self.on_cleanup(state)

    def _unsubscribe(self) -> None:
        for subscription in self._subscriptions_made:
            self.destroy_subscription(subscription)
        self._subscriptions_made.clear()
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._timer = None
        if self._monitoring is not None:
            self.watch.end()
            self._monitoring.join()
        self._monitoring = None

    def _remove_publishers(self) -> None:
        for publisher in self._publishers_made:
            self.destroy_lifecycle_publisher(publisher)
        self._publishers_made.clear()

    def _take(self, topic: int, message: Any) -> None:
        try:
            values = join(arrays_at(message, self._field), np.float64)
            part = Part(values, message, stamp_of(message))
            for frame in self._rounds.add(topic, part):
                self._pass_on(frame)
        except ValueError as error:
            self.get_logger().warning(f"frame dropped: {error}", throttle_duration_sec=5.0)

    def _take_scan(self, message: Any) -> None:
        try:
            level, *values = join(arrays_at(message, self._field), np.float64).tolist()
            self.watch.scan(level, np.array(values))
        except ValueError as error:
            self.get_logger().warning(f"scan dropped: {error}", throttle_duration_sec=5.0)

    def _pass_on(self, frame: list[Part]) -> None:
        """Publish a frame whole, and have it monitored."""
        received = np.concatenate([part.values for part in frame])
        whole = self.watch.restore(received)
        if whole is not None and self._whole:
            start = 0
            for part, publisher in zip(frame, self._whole, strict=True):
                restored = whole[start : start + part.values.size]
                start += part.values.size
                if part.message is not None:
                    put(arrays_at(part.message, self._field), restored)
                    publisher.publish(part.message)
        stamps = [part.stamp for part in frame if part.stamp is not None]
        self.watch.put(received, max(stamps, default=None))

    def _monitor(self) -> None:
        try:
            self.watch.work_on(lambda fault: self.get_logger().warning(fault.reason))
        except Exception as error:  # of a thread nobody waits for; the timer raises it
            self._failure = error

    def spin(self) -> None:
        """Restore frames as they come; raises ExternalShutdownException at the end."""
        executor = rclpy.get_global_executor()
        executor.add_node(self)
        while True:
            executor.spin_once()

    def _each_second(self) -> None:
        if self._failure is not None:
            raise self._failure
        sensor = self._follower.poll()
        if sensor is not None:
            self.watch.switch(sensor)
            self.get_logger().info(
                f"{sensor.version} of the bundle, {len(sensor.known)} known faulty cells"
            )
        if self.watch.queue.left_out:
            what = (
                f"monitoring is behind: {self.watch.queue.left_out} frames were restored and not"
                " monitored"
            )
            self.get_logger().warning(what, throttle_duration_sec=10.0)
        silent = [self.parameters.topics[i] for i in self._rounds.silent]
        if silent:
            self.watch.refused = f"nothing came on {', '.join(silent)}"
        now = self.get_clock().now().nanoseconds / 1e9
        self._diagnostics.publish(diagnostics_message(self.watch.diagnostics(now)))


def run(arguments: Sequence[str]) -> int:
    """Run the node until it is shut down; return the exit code, 3 for parameters or a bundle that
    cannot be used."""
    rclpy.init(args=quoted(arguments))
    try:
        try:
            node = TactileDiagnostics()
        except ValueError as error:
            print(f"{NAME}: {error}", file=sys.stderr)
            return 3
        if node.parameters.autostart:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                return 3
            if node.trigger_activate() != TransitionCallbackReturn.SUCCESS:
                return 3
        node.spin()
    except ExternalShutdownException:
        pass
    except Exception:
        if rclpy.ok():  # otherwise a signal came in the middle of a call
            raise
    finally:
        rclpy.try_shutdown()
    return 0
