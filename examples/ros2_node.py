"""A ROS 2 node that watches tactile frames and publishes what is wrong on /diagnostics, once a second.

    python examples/ros2_node.py --ros-args -p topic:=/tactile

Frames come as std_msgs/Float32MultiArray. Without ROS it prints one message of those it would publish.
"""

import json
import sys
import time

import numpy as np

from adaptfault.acquisition.ros import diagnostic_array, stale_array
from diagnostics import Monitor, SelfDiagnosis, SensorLayout

SILENCE = 2.0  # seconds without a frame, after which everything is STALE
JUDGE = 10.0  # seconds between two judgements of all cells; what was found is repeated every second

LAYOUT = SensorLayout.paper()


class Watch:
    """What the node does, without ROS."""

    def __init__(self, layout: SensorLayout, clock=time.time):
        self.monitor, self.layout, self.clock = Monitor(SelfDiagnosis(layout)), layout, clock
        self.last = self.judged = -np.inf
        self.news = False
        self.array = stale_array(layout, "no frame yet")

    def take(self, values) -> tuple:
        """Take in one frame; return the faults that are new, changed or gone."""
        self.last = self.clock()
        faults = self.monitor.update(values)
        self.news |= bool(faults)
        return faults

    def diagnostics(self) -> dict:
        """Return the content of the DiagnosticArray to publish now."""
        now = self.clock()
        if now - self.last > SILENCE:
            self.judged = -np.inf
            if np.isfinite(self.last):
                return stale_array(self.layout, f"no frame for {now - self.last:.0f} s", stamp=now)
            return stale_array(self.layout, "no frame yet", stamp=now)
        if self.news or now - self.judged > JUDGE:
            self.array = diagnostic_array(self.monitor.diagnosis())
            self.news, self.judged = False, now
        seconds, rest = divmod(round(now * 1e9), 10**9)
        return {**self.array, "header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": ""}}


def run() -> None:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rclpy.node import Node
    from std_msgs.msg import Float32MultiArray

    class TactileDiagnostics(Node):
        def __init__(self):
            super().__init__("tactile_diagnostics")
            topic = self.declare_parameter("topic", "/tactile").value
            self.watch = Watch(LAYOUT)
            self.publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
            self.create_subscription(Float32MultiArray, topic, self.take, 10)
            self.create_timer(1.0, self.publish)

        def take(self, message):
            if len(message.data) != LAYOUT.n_cells:
                text = f"{len(message.data)} values, expected {LAYOUT.n_cells}"
                self.get_logger().warning(text, throttle_duration_sec=5.0)
                return
            for fault in self.watch.take(np.asarray(message.data)):
                self.get_logger().warning(fault.reason)

        def publish(self):
            content = self.watch.diagnostics()
            message = DiagnosticArray()
            message.header.stamp.sec = content["header"]["stamp"]["sec"]
            message.header.stamp.nanosec = content["header"]["stamp"]["nanosec"]
            for one in content["status"]:
                values = [KeyValue(**pair) for pair in one["values"]]
                level = bytes([one["level"]])  # rclpy's byte
                message.status.append(DiagnosticStatus(**{**one, "level": level, "values": values}))
            self.publisher.publish(message)

    rclpy.init()
    node = TactileDiagnostics()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def show() -> None:
    """Print what would be published for a simulated sensor with a broken row."""
    from adaptfault import simulate
    from diagnostics import FaultKind, Line, inject, line_fault

    watch = Watch(LAYOUT)
    frames = np.concatenate(simulate(1, seed=0).frames)
    for frame in inject(frames, [line_fault(LAYOUT, Line(0, "row", 5), FaultKind.SHORT)], LAYOUT):
        watch.take(frame)
    print(json.dumps(watch.diagnostics(), indent=1))


if __name__ == "__main__":
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print("no ROS 2 here (source /opt/ros/<distro>/setup.bash): this is what would be published", file=sys.stderr)
        show()
    else:
        run()
