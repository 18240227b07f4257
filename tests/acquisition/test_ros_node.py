"""The ROS 2 node as a process of its own, under real rclpy: what it receives, sends, says and how
it ends."""

import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip(
    "rclpy", reason="rclpy is missing: pip install 'adaptfault-station[ros2]'", exc_type=ImportError
)

with warnings.catch_warnings():
    # the parser that it brings imports sre_parse
    warnings.simplefilter("ignore", DeprecationWarning)
    import rosidl_generator_py  # noqa: F401

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile, qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402
from std_msgs.msg import Float32MultiArray  # noqa: E402

from diagnostics import FaultSet  # noqa: E402

LIMIT = 240.0  # seconds until a test gives up; none of them needs so many
OK = DiagnosticStatus.OK[0]
WARN = DiagnosticStatus.WARN[0]
STALE = DiagnosticStatus.STALE[0]
RELIABLE = QoSProfile(depth=50)


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """A ROS domain that no other process of these tests uses, whoever started it: it holds a port
    for each."""
    for number in range(1, 101):
        with socket.socket() as held:
            try:
                held.bind(("127.0.0.1", 26_000 + number))
            except OSError:
                continue
            yield number
            return
    pytest.fail("no ROS domain is free")


class Bench:
    """A node beside the one under test: sends frames, keeps what comes on /diagnostics, and starts
    processes."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "log"),
        }
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("bench", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.arrays: list[DiagnosticArray] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.arrays.append, 50)
        self.processes: list[subprocess.Popen] = []

    def start(self, **parameters: str) -> subprocess.Popen:
        """Start the node; its output goes to a file."""
        given = []
        for name, value in parameters.items():
            given += ["-p", f"{name}:={value}"]
        command = [sys.executable, "-m", "adaptfault.ros2", "--ros-args", *given]
        with open(self.folder / f"output{len(self.processes)}", "w") as output:
            process = subprocess.Popen(
                command, env=self.environment, stdout=output, stderr=subprocess.STDOUT
            )
        self.processes.append(process)
        return process

    def output(self) -> str:
        """Return all that the process started last has written so far."""
        return (self.folder / f"output{len(self.processes) - 1}").read_text()

    def until(
        self, reached: Callable[[], bool], meanwhile: Callable[[], object] = lambda: None
    ) -> None:
        """Wait for a condition; ``meanwhile`` is called about 50 times a second."""
        ends = time.monotonic() + LIMIT
        while not reached():
            assert time.monotonic() < ends, (
                f"not reached in {LIMIT:g} s; the node said:\n{self.output()}"
            )
            due = time.monotonic() + 0.02
            meanwhile()
            while (left := due - time.monotonic()) > 0:
                self.executor.spin_once(timeout_sec=left)

    def levels(self) -> set[int]:
        """Return the levels in the array that came last."""
        return {status.level[0] for status in self.arrays[-1].status} if self.arrays else set()

    def end(self, process: subprocess.Popen, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal to a process; return its exit code and its output."""
        process.send_signal(number)
        code = process.wait(LIMIT)
        return code, self.output()

    def close(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.wait()
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def bench(domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    bench = Bench(domain, tmp_path)
    yield bench
    bench.close()


def test_values_that_yaml_reads_as_other_types_are_taken_and_silence_warns_before_it_is_stale(
    bench,
):
    driver = bench.node.create_publisher(Float32MultiArray, "/skin", RELIABLE)
    process = bench.start(
        topic="/skin",
        layout="2x3x3",
        unit="N",
        full_scale="5",
        rate="31",
        name="1",
        hardware_id="7",
        restored="",
    )
    bench.until(lambda: bool(bench.arrays))
    names = [status.name for status in bench.arrays[0].status]
    first = bench.arrays[0].status[0]
    assert bench.levels() == {WARN}
    assert (first.name, first.message, first.hardware_id) == ("1: pad 0", "no frame yet", "7")
    frame = np.zeros(18, np.float32)
    bench.until(lambda: OK in bench.levels(), lambda: driver.publish(Float32MultiArray(data=frame)))
    slow = iter(range(10**9))

    def send_slowly() -> None:
        if next(slow) % 5 == 0:
            driver.publish(Float32MultiArray(data=frame))

    stream = "frames a second, 31 are declared"
    bench.until(lambda: bench.arrays[-1].status[-1].message.endswith(stream), send_slowly)
    assert bench.arrays[-1].status[-1].level == DiagnosticStatus.WARN
    bench.until(lambda: bench.levels() == {STALE})
    assert all([status.name for status in array.status] == names for array in bench.arrays)
    code, said = bench.end(process, signal.SIGINT)
    assert code == 0
    assert "Traceback" not in said


def test_frames_of_a_best_effort_driver_come_back_whole_also_after_a_new_version(
    bench, bundle, small_grasps
):
    """As images, with stamp and frame_id. A lifecycle manager starts the node; the new version
    needs no restart."""
    frames = np.concatenate(small_grasps.frames).astype("<f4")
    # an idle frame looks the same with exchanged wires
    frames = frames[(frames > 0).sum(axis=1) > 10]
    rows = 6
    columns = 10
    driver = bench.node.create_publisher(Image, "/tactile", qos_profile_sensor_data)
    came: dict[str, list[Image]] = {"reliable": [], "best effort": []}
    bench.node.create_subscription(Image, "/tactile/restored", came["reliable"].append, RELIABLE)
    bench.node.create_subscription(
        Image, "/tactile/restored", came["best effort"].append, qos_profile_sensor_data
    )
    process = bench.start(
        bundle=str(bundle.path), topic_type="sensor_msgs/msg/Image", autostart="false"
    )
    client = bench.node.create_client(ChangeState, "/tactile_diagnostics/change_state")
    bench.until(client.service_is_ready)

    def change(transition: int) -> bool:
        answer = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
        bench.until(answer.done)
        return answer.result().success

    count = iter(range(10**9))

    def send() -> None:
        number = next(count)
        pixels = np.zeros((rows, columns + 1), "<f4")  # each row ends with padding
        pixels[:, :columns] = frames[number % len(frames)].reshape(rows, columns)
        pixels[0, 0] = np.nan
        image = Image(
            height=rows,
            width=columns,
            encoding="32FC1",
            step=4 * (columns + 1),
            data=pixels.tobytes(),
        )
        image.header.frame_id = "left_hand"
        image.header.stamp.sec = 1000 + number
        driver.publish(image)

    def readings(image: Image) -> np.ndarray:
        return np.frombuffer(image.data, "<f4").reshape(rows, columns + 1)[:, :columns].ravel()

    def sent(image: Image) -> np.ndarray:
        return frames[(image.header.stamp.sec - 1000) % len(frames)]

    assert change(Transition.TRANSITION_CONFIGURE)
    assert not bench.arrays
    assert change(Transition.TRANSITION_ACTIVATE)
    bench.until(lambda: all(came.values()) and OK in bench.levels(), send)
    for images in came.values():
        image = images[0]
        assert (image.header.frame_id, image.encoding, image.step) == ("left_hand", "32FC1", 44)
        np.testing.assert_array_equal(readings(image)[1:], sent(image)[1:])
        assert np.isfinite(readings(image)[0])

    source = np.roll(np.arange(bundle.layout.n_cells), 1)
    healthy = bundle.parts.adapter().adapt(FaultSet((), source.size), method="fill")
    bundle.deploy(bundle.write_version(healthy, {"source": source.tolist()}).number)
    moved = source != 0  # the cell that is missing

    def rewired() -> bool:
        images = came["best effort"].copy()
        came["best effort"].clear()
        return any(
            np.array_equal(readings(image)[moved], sent(image)[source][moved]) for image in images
        )

    bench.until(rewired, send)
    assert change(Transition.TRANSITION_DEACTIVATE)
    assert change(Transition.TRANSITION_CLEANUP)
    code, said = bench.end(process)
    assert code == 0
    assert "Traceback" not in said


def test_several_topics_are_one_array_and_each_comes_back_whole(bench, bundle, small_grasps):
    frames = np.concatenate(small_grasps.frames).astype("<f4")
    came: dict[str, list[Float32MultiArray]] = {"/a": [], "/b": []}
    drivers = []
    for topic, kept in came.items():
        drivers.append(bench.node.create_publisher(Float32MultiArray, topic, RELIABLE))
        bench.node.create_subscription(Float32MultiArray, f"{topic}/restored", kept.append, 50)
    process = bench.start(bundle=str(bundle.path), topic="/a,/b", camera_info_url="x")
    count = iter(range(10**9))

    def send() -> None:
        frame = frames[next(count) % len(frames)]
        for driver, values in zip(drivers, np.split(frame, [20]), strict=True):
            driver.publish(Float32MultiArray(data=values))

    bench.until(lambda: all(came.values()) and OK in bench.levels(), send)
    assert [len(kept[0].data) for kept in came.values()] == [20, frames.shape[1] - 20]
    code, said = bench.end(process)
    assert code == 0
    assert "parameter camera_info_url is not used" in said
    assert "Traceback" not in said


def test_a_parameter_that_cannot_be_converted_ends_it_with_one_line(bench):
    process = bench.start(layout="2x3x3", full_scale="N")
    assert process.wait(LIMIT) == 3
    assert (
        bench.output()
        == "tactile_diagnostics: parameter full_scale: expected a number from 0, got False\n"
    )


def test_a_misspelt_parameter_ends_it_with_one_line(bench):
    process = bench.start(layout="2x3x3", trsut="key.pem")
    assert process.wait(LIMIT) == 3
    said = "tactile_diagnostics: parameter trsut: there is none; did you mean trust?\n"
    assert bench.output() == said
