"""The lifecycle node: configure opens the bundle, activate subscribes. Needs rclpy."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy

from adaptfault.data.recordings.formats.message_arrays import arrays_at, join, put
from adaptfault.ros2.messages import choose_field, diagnostics_message, message_type, stamp_of
from adaptfault.ros2.parameters import DEFAULTS, Parameters, quoted
from adaptfault.ros2.sensor import Follower
from adaptfault.ros2.watch import Watch

NAME = "tactile_diagnostics"

_DEPTH = 50  # frames that may wait to be restored; a longer queue would only make them late


class TactileDiagnostics(LifecycleNode):  # type: ignore[misc]
    """Monitors a topic of tactile frames, publishes their faults on /diagnostics, and whole frames
    on another topic.

    A best-effort subscription takes frames of every publisher. A reliable publisher serves every
    subscriber.

    Raises:
        ValueError: a parameter has no value of its type.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        any_type = ParameterDescriptor(dynamic_typing=True, read_only=True)
        values = {
            name: self.declare_parameter(name, value, any_type).value
            for name, value in DEFAULTS.items()
        }
        self.parameters = Parameters.from_values(values)
        self._publishers_made: list[Any] = []
        self._subscription: Any = None
        self._timer: Any = None
        self._taken = False  # whether a frame came in the last step

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
        topic = self.resolve_topic_name(given.topic)
        self._type = message_type(given.topic_type)
        self._field = choose_field(self._type, given.field)
        self._follower = Follower(given)
        sensor = self._follower.sensor
        self.watch = Watch(sensor, name=given.name, hardware_id=given.hardware_id)
        self._diagnostics = self.create_lifecycle_publisher(DiagnosticArray, "/diagnostics", 1)
        self._publishers_made.append(self._diagnostics)
        self._whole = None
        if sensor.restorer is not None:
            if self.resolve_topic_name(given.restored) == topic:
                raise ValueError(
                    f"topic and restored are both {given.topic}: restored frames would come back"
                )
            self._whole = self.create_lifecycle_publisher(
                self._type, given.restored, QoSProfile(depth=_DEPTH)
            )
            self._publishers_made.append(self._whole)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe."""
        done = super().on_activate(state)  # from now on publishers publish
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.watch.begin()
        self._timer = self.create_timer(1.0, self._each_second)
        self._subscription = self.create_subscription(
            self._type, self.parameters.topic, self._take, qos
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
        if self._subscription is not None:
            self.destroy_subscription(self._subscription)
            self.destroy_timer(self._timer)
        self._subscription = None
        self._timer = None

    def _remove_publishers(self) -> None:
        for publisher in self._publishers_made:
            self.destroy_lifecycle_publisher(publisher)
        self._publishers_made.clear()

    def _take(self, message: Any) -> None:
        try:
            arrays = arrays_at(message, self._field)
            received = join(arrays, np.float64)
            whole = self.watch.restore(received)
            if whole is not None and self._whole is not None:
                put(arrays, whole)
                self._whole.publish(message)
            self.watch.put(received, stamp_of(message))
        except ValueError as error:
            self.get_logger().warning(f"frame dropped: {error}", throttle_duration_sec=5.0)
        self._taken = True

    def spin(self) -> None:
        """Restore frames as they come, and monitor them in between; raises
        ExternalShutdownException at the end."""
        executor = rclpy.get_global_executor()
        executor.add_node(self)
        while True:
            waits = self._subscription is not None and self.watch.waiting
            self._taken = False
            executor.spin_once(timeout_sec=0.0 if waits else None)
            if waits and not self._taken:
                for fault in self.watch.work():
                    self.get_logger().warning(fault.reason)

    def _each_second(self) -> None:
        sensor = self._follower.poll()
        if sensor is not None:
            self.watch.switch(sensor)
            self.get_logger().info(
                f"{sensor.version} of the bundle, {len(sensor.known)} known faulty cells"
            )
        if self.watch.left_out:
            what = (
                f"monitoring is behind: {self.watch.left_out} frames were restored and not"
                " monitored"
            )
            self.get_logger().warning(what, throttle_duration_sec=10.0)
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
