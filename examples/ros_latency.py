"""What the ROS 2 node adds: frames lost, and latency of the restored ones, for both kinds of QoS.

    python examples/ros_latency.py [robot.bundle] [--seconds 20] [--rates 100 500]

Without a bundle, one is made from simulated grasps (a minute). A driver in this process publishes
frames with a broken row, and subscribes to the restored ones with the same QoS: the latency is that
of both ways and of the node between. It ends with exit code 1 where a frame comes twice or out of
order.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
from relay import make_bundle

import adaptfault as af
from diagnostics import Line, inject, line_fault

DOMAIN = 87


def measure(bundle: af.Bundle, frames: np.ndarray, rate: float, reliable: bool) -> bool:
    """Send all frames to a node of its own at a rate, print what came back; return whether it came
    in order."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from std_msgs.msg import Float32MultiArray, MultiArrayLayout

    kind = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    qos = QoSProfile(depth=100, reliability=kind)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    driver = rclpy.create_node("driver", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(driver)
    came: list[tuple[int, float]] = []
    driver.create_subscription(
        Float32MultiArray,
        "/tactile/restored",
        lambda message: came.append((message.layout.data_offset, time.perf_counter())),
        qos,
    )
    publisher = driver.create_publisher(Float32MultiArray, "/tactile", qos)

    def listen() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    messages = []
    for number, frame in enumerate(frames.astype(np.float32)):
        messages.append(Float32MultiArray(layout=MultiArrayLayout(data_offset=number), data=frame))
    command = [
        sys.executable,
        "-m",
        "adaptfault.ros2",
        "--ros-args",
        "-p",
        f"bundle:={bundle.path}",
    ]
    node = subprocess.Popen(
        command, env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}, stderr=subprocess.DEVNULL
    )
    sent = np.zeros(len(messages))
    try:
        while not came and node.poll() is None:  # until the node is there
            publisher.publish(messages[0])
            time.sleep(0.1)
        time.sleep(1.0)
        came.clear()
        process = psutil.Process(node.pid)
        before = sum(process.cpu_times()[:2])
        began = time.perf_counter()
        for number, message in enumerate(messages):
            time.sleep(max(0.0, began + number / rate - time.perf_counter()))
            sent[number] = time.perf_counter()
            publisher.publish(message)
        time.sleep(3.0)
        share = (sum(process.cpu_times()[:2]) - before) / (time.perf_counter() - began)
    finally:
        node.terminate()
        node.wait()
        context.try_shutdown()
        listener.join()
    numbers = np.array([number for number, _ in came], dtype=int)
    latency = 1e3 * (np.array([at for _, at in came]) - sent[numbers])
    name = "reliable" if reliable else "best effort"
    print(
        f"| {name} | {rate:g} | {len(sent)} | {len(came)} |"
        f" {len(sent) - len(set(numbers.tolist()))} | {np.median(latency):.1f} |"
        f" {np.quantile(latency, 0.99):.1f} | {100 * share:.0f} % |",
        flush=True,
    )
    return bool((np.diff(numbers) > 0).all())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", nargs="?")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument(
        "--rates", type=float, nargs="+", default=[100.0, 500.0], help="frames per second"
    )
    args = parser.parse_args()
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        print(f"no ROS 2 here ({error}): pip install 'adaptfault-station[ros2]' on Python 3.11")
        return 0
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    in_order = []
    with tempfile.TemporaryDirectory() as folder:
        bundle = (
            af.Bundle.open(args.bundle)
            if args.bundle
            else make_bundle(Path(folder) / "robot.bundle")
        )
        layout = bundle.layout
        frames = bundle.parts.check_windows().x.reshape(-1, layout.n_cells) * layout.full_scale
        broken = inject(
            frames.astype(float),
            [line_fault(layout, Line(0, "row", layout.rows // 2), "short")],
            layout,
        )
        print(
            "| QoS | frames a second | sent | received | lost | median ms | 99 % ms | of a core |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for reliable in (False, True):
            for rate in args.rates:
                count = round(args.seconds * rate)
                in_order.append(
                    measure(bundle, np.resize(broken, (count, layout.n_cells)), rate, reliable)
                )
    return 0 if all(in_order) else 1


if __name__ == "__main__":
    sys.exit(main())
