"""A ROS 2 node that monitors tactile frames, publishes their faults on /diagnostics, and whole frames on a topic.

    ros2 run adaptfault_ros node --ros-args -p topic:=/tactile -p bundle:=/home/robot/robot.bundle

Frames come as std_msgs/Float32MultiArray. Without ROS, ``python -m adaptfault_ros.node`` prints one message for a
simulated sensor.

Parameters:
    topic: of the frames (default /tactile).
    bundle: folder of ``adaptfault train --out X.bundle``: its layout and its healthy model. Exchanged wires that its
        active version puts back are put back here too; restart the node after a maintenance run that deployed one.
    trust: PEM file of the public key that must have signed the bundle; "" = signatures are not checked.
    restored: topic of the repaired frames, each as soon as it comes; "" = none. Needs a bundle. /diagnostics names the
        faulty cells, which are the restored ones.
    layout: without a bundle: a layout file, or a shape as 2x11x10. Cells are then compared with their neighbours.
    full_scale, unit, rate: override the layout; 0 and "" keep it.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from adaptfault.acquisition import FrameRepair
from adaptfault.acquisition.ros import diagnostic_array, stale_array
from adaptfault.data.recordings import parse_shape, read_layout
from adaptfault.data.recordings.layout_file import looks_like_shape
from adaptfault.robot.converter_range import within_range
from diagnostics import FaultSet, Monitor, SelfDiagnosis, SensorLayout

SILENCE = 2.0  # seconds without a frame, after which everything is STALE
PERIOD = 10.0  # seconds between two diagnoses of all cells; the last one is published every second

DEFAULTS = {
    "topic": "/tactile",
    "bundle": "",
    "trust": "",
    "restored": "/tactile/restored",
    "layout": "",
    "full_scale": 0.0,
    "unit": "",
    "rate": 0.0,
}


def bundle_of(parameters: Mapping[str, Any]):
    """Return the bundle; raises ValueError where the trusted key, if one is given, did not sign it."""
    from adaptfault import Bundle

    return Bundle.open(parameters["bundle"], keys=[parameters["trust"]] if parameters["trust"] else None)


def diagnoser_of(parameters: Mapping[str, Any]) -> SelfDiagnosis:
    """Return the diagnosis that the parameters describe.

    Raises:
        ValueError: neither bundle nor layout, or both.
    """
    if bool(parameters["bundle"]) == bool(parameters["layout"]):
        raise ValueError("give the parameter bundle, or the parameter layout (a layout file or a shape as 2x11x10)")
    if parameters["bundle"]:
        return bundle_of(parameters).diagnoser()
    text = parameters["layout"]
    layout = SensorLayout(*parse_shape(text)) if looks_like_shape(text) else read_layout(text)
    stated = {name: parameters[name] for name in ("full_scale", "unit", "rate") if parameters[name]}
    return SelfDiagnosis(replace(layout, **stated))


def repair_of(parameters: Mapping[str, Any]) -> FrameRepair | None:
    """Return what restores frames with the healthy windows of the bundle; None without a bundle or a topic."""
    if not (parameters["bundle"] and parameters["restored"]):
        return None
    bundle = bundle_of(parameters)
    return FrameRepair(bundle.restorer(), bundle.known_faults().fault_set)


def source_of(parameters: Mapping[str, Any]) -> np.ndarray | None:
    """Return the received cell that belongs at each place ``[D]``, as the bundle's active version; None without one."""
    if not parameters["bundle"]:
        return None
    return bundle_of(parameters).active().source


class Watch:
    """The work of the node, without ROS."""

    def __init__(
        self,
        diagnoser: SelfDiagnosis,
        clock: Callable[[], float] = time.time,
        repair: FrameRepair | None = None,
        source: np.ndarray | None = None,
    ):
        self.source = np.arange(diagnoser.layout.n_cells) if source is None else source
        self.repair, self.faulty = repair, np.zeros(diagnoser.layout.n_cells, bool)
        self.monitor, self.layout, self.clock = Monitor(diagnoser), diagnoser.layout, clock
        self.last = self.diagnosed = -np.inf
        self.changed = False
        self.array = stale_array(self.layout, "no frame yet")

    def restore(self, values) -> list[float] | None:
        """Return the frame with its faulty cells and missing readings restored; None where nothing restores it."""
        if self.repair is None or len(values) != self.layout.n_cells:
            return None
        readings = within_range(np.asarray(values, dtype=float)[self.source], self.layout)[0]
        return self.repair(readings)[0].tolist()

    def take(self, values) -> tuple:
        """Take in one frame; return the faults that are new, changed or gone.

        Raises:
            ValueError: another number of values than cells.
        """
        if len(values) != self.layout.n_cells:
            raise ValueError(f"{len(values)} values, expected {self.layout.n_cells}")
        self.last = self.clock()
        faults = self.monitor.update(np.asarray(values, dtype=float)[self.source])
        self.changed |= bool(faults)
        for fault in faults:
            self.faulty[list(fault.cells)] = fault.probability != 0
        if faults and self.repair is not None:
            self.repair.found(FaultSet(tuple(np.flatnonzero(self.faulty).tolist()), self.faulty.size))
        return faults

    def diagnostics(self) -> dict:
        """Return the content of the DiagnosticArray to publish now."""
        now = self.clock()
        if now - self.last > SILENCE:
            self.diagnosed = -np.inf
            if np.isfinite(self.last):
                return stale_array(self.layout, f"no frame for {now - self.last:.0f} s", stamp=now)
            return stale_array(self.layout, "no frame yet", stamp=now)
        if self.changed or now - self.diagnosed > PERIOD:
            self.array = diagnostic_array(self.monitor.diagnosis())
            self.changed, self.diagnosed = False, now
        seconds, rest = divmod(round(now * 1e9), 10**9)
        return {**self.array, "header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": ""}}


def message_of(content: Mapping[str, Any], types: Mapping[str, Any], level: Callable[[int], Any]) -> Any:
    """Return a DiagnosticArray message.

    Args:
        content: of :meth:`Watch.diagnostics`.
        types: the message classes by name: "Time", "Header", "KeyValue", "DiagnosticStatus", "DiagnosticArray".
        level: converts a level to the type of the field, which is one byte in rclpy.
    """
    header = types["Header"](stamp=types["Time"](**content["header"]["stamp"]), frame_id=content["header"]["frame_id"])
    status = [
        types["DiagnosticStatus"](
            level=level(one["level"]),
            name=one["name"],
            message=one["message"],
            hardware_id=one["hardware_id"],
            values=[types["KeyValue"](**pair) for pair in one["values"]],
        )
        for one in content["status"]
    ]
    return types["DiagnosticArray"](header=header, status=status)


def main() -> None:
    """Run the node until it is shut down."""
    import rclpy
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rclpy.node import Node
    from std_msgs.msg import Float32MultiArray, Header

    classes = (Time, Header, KeyValue, DiagnosticStatus, DiagnosticArray)
    types = {kind.__name__: kind for kind in classes}

    class TactileDiagnostics(Node):
        def __init__(self):
            super().__init__("tactile_diagnostics")
            parameters = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
            self.watch = Watch(diagnoser_of(parameters), repair=repair_of(parameters), source=source_of(parameters))
            self.whole = None
            if self.watch.repair is not None:
                self.whole = self.create_publisher(Float32MultiArray, parameters["restored"], 10)
            self.publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
            self.create_subscription(Float32MultiArray, parameters["topic"], self.take, 10)
            self.create_timer(1.0, self.publish)

        def take(self, message):
            # Published first: monitoring takes longer.
            if self.whole is not None and (values := self.watch.restore(message.data)) is not None:
                self.whole.publish(Float32MultiArray(layout=message.layout, data=values))
            try:
                faults = self.watch.take(message.data)
            except ValueError as error:
                self.get_logger().warning(f"frame dropped: {error}", throttle_duration_sec=5.0)
                return
            for fault in faults:
                self.get_logger().warning(fault.reason)

        def publish(self):
            self.publisher.publish(message_of(self.watch.diagnostics(), types, lambda number: bytes([number])))

    rclpy.init()
    try:
        try:
            node = TactileDiagnostics()
        except (ValueError, OSError) as error:  # parameters or bundle; later errors keep their traceback
            print(f"tactile_diagnostics: {error}", file=sys.stderr)
            sys.exit(3)
        rclpy.spin(node)
        node.destroy_node()
    except KeyboardInterrupt:  # Ctrl-C is how a node ends
        pass
    finally:
        rclpy.try_shutdown()


def show() -> None:
    """Print the message for a simulated sensor with a broken row."""
    from adaptfault import simulate
    from diagnostics import FaultKind, Line, inject, line_fault

    layout = SensorLayout.paper()
    watch = Watch(SelfDiagnosis(layout))
    frames = np.concatenate(simulate(1, seed=0).frames)
    for frame in inject(frames, [line_fault(layout, Line(0, "row", 5), FaultKind.SHORT)], layout):
        watch.take(frame)
    print(json.dumps(watch.diagnostics(), indent=1))


if __name__ == "__main__":
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print(
            "no ROS 2 here (source /opt/ros/<distro>/setup.bash); the message of a simulated sensor:", file=sys.stderr
        )
        show()
    else:
        main()
