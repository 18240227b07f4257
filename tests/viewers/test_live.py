"""Live views: the readers of the formats read what devices sent, while a file grows and after it
ends."""

import asyncio
import base64
import contextlib
import errno
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import FrameRepair, Session, Station, format_packet
from adaptfault.acquisition.live import LiveView
from adaptfault.acquisition.ordering import Frame
from adaptfault.bundle.bundle import Bundle
from adaptfault.cli import main
from adaptfault.viewers.mcap_file import McapMessages
from adaptfault.viewers.timed_log import State
from diagnostics import Monitor, SelfDiagnosis, SensorLayout

pytest.importorskip("mcap")
pytest.importorskip("rerun.chunk", reason="a newer rerun-sdk reads files")

SMALL = SensorLayout(1, 2, 3)
ROOT = Path(__file__).parents[2]
VALUES = np.random.default_rng(0).uniform(0, 5, (40, 6)).round(3).astype(np.float32)
ENDINGS = pytest.mark.parametrize("ending", ["mcap", "rrd"])


def messages(path, topic: str) -> list[tuple[float, dict]]:
    """Time and content of the messages, also of a file that has no end yet."""
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader

    found = []
    with open(path, "rb") as file, contextlib.suppress(EndOfFile):
        for _, _, one in NonSeekingReader(file).iter_messages([topic], log_time_order=False):
            found.append((one.log_time / 1e9, json.loads(one.data)))
    return found


def columns(path, entity: str, name: str) -> list[tuple[float, object]]:
    """Time and value of a column, also of a file that has no end yet."""
    from rerun.chunk import RrdReader

    found = []
    with warnings.catch_warnings(action="ignore"):  # it has no footer yet
        chunks = list(RrdReader(path).stream().to_chunks())
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and {"time", name} <= set(batch.schema.names):
            times = [at.timestamp() for at in batch.column("time").to_pylist()]
            found += zip(times, batch.column(name).to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])


def frames_in(path, device: str, what: str = "readings") -> tuple[list[float], np.ndarray]:
    """Times and frames ``[t, 6]`` of a device's pad."""
    topic = f"/tactile/{device}/0/{what}"
    if Path(path).suffix == ".mcap":
        told = messages(path, topic)
        frames = [np.frombuffer(base64.b64decode(grid["data"]), "<f4") for _, grid in told]
        frames = [frame.reshape(-1, told[0][1]["column_count"])[::-1].ravel() for frame in frames]
    else:
        told = columns(path, topic, "DepthImage:buffer")
        frames = [np.array(image, np.uint8).view("<f4") for _, (image,) in told]
    return [at for at, _ in told], np.array(frames)


@pytest.fixture
def shorted() -> np.ndarray:
    """300 frames in which cell 1 reads full scale, the others a load that comes and goes."""
    rng = np.random.default_rng(0)
    load = np.maximum(0, np.sin(np.arange(300) / 5))[:, None] * rng.uniform(2, 4, 6)
    frames = load + np.abs(rng.normal(0, 0.02, load.shape))
    frames[:, 1] = 5.0
    return frames.round(3)


def fed(view: LiveView, values: np.ndarray, start: int = 0, session: Session | None = None):
    """Show frames of device "a" at 10 Hz."""
    session = session or Session("a", Monitor(SelfDiagnosis(view.layout), wait=True))
    for i, values_ in enumerate(np.asarray(values, dtype=np.float64), start):
        frame = Frame("a", i / 10, values_)
        view.take(frame, session, session.take(frame, i / 10))
    return session


@ENDINGS
def test_a_file_holds_all_frames_at_their_times(ending, tmp_path):
    path = tmp_path / f"live.{ending}"
    view = LiveView(str(path), SMALL, clock=lambda: 1_000_000.0)
    fed(view, VALUES)
    view.close()
    times, frames = frames_in(path, "a")
    np.testing.assert_array_equal(frames, VALUES)
    np.testing.assert_allclose(times, 1_000_000 + np.arange(40) / 10, atol=1e-6)


@ENDINGS
def test_what_is_older_than_a_second_is_in_the_file_while_it_grows(ending, tmp_path):
    path = tmp_path / f"live.{ending}"
    view = LiveView(str(path), SMALL)
    fed(view, VALUES)
    if ending == "rrd":
        view._sink._stream.flush()  # Rerun writes in a thread; this waits for what it was given
    frames = frames_in(path, "a")[1]
    np.testing.assert_array_equal(frames, VALUES[: len(frames)])
    assert len(frames) >= 29
    view.close()


@ENDINGS
def test_a_file_that_exists_is_kept_and_an_hour_begins_the_next_one(ending, tmp_path):
    path = tmp_path / f"live.{ending}"
    path.write_text("yesterday")
    view = LiveView(str(path), SMALL, longest=2.0)
    fed(view, VALUES)
    view.close()
    assert path.read_text() == "yesterday"
    assert view.places == tuple(str(tmp_path / f"live_{i}.{ending}") for i in (2, 3))
    parts = [frames_in(place, "a")[1] for place in view.places]
    assert [len(part) for part in parts] == [20, 20]
    np.testing.assert_array_equal(np.concatenate(parts), VALUES)


def test_states_and_diagnostics_are_those_of_the_last_evaluation(shorted, tmp_path):
    path = tmp_path / "live.mcap"
    view = LiveView(str(path), SMALL)
    session = fed(view, shorted)
    assert session.fault_set.cells == (1,)
    view.close()
    told = messages(path, "/tactile/a/0/states")
    states = [np.frombuffer(base64.b64decode(grid["data"]), np.uint8) for _, grid in told]
    first, *_, last = (packed.reshape(2, 3, 5)[::-1, :, 0].ravel() for packed in states)
    assert first.tolist() == [State.UNTESTED] * 6
    assert last.tolist() == [State.ALIVE, State.FAULTY, *[State.ALIVE] * 4]
    statuses = [array["status"][0] for _, array in messages(path, "/diagnostics")]
    assert statuses[0]["message"] == "not evaluated yet"
    assert statuses[-1]["message"] == "1 of 6 cells faulty"
    assert statuses[-1]["hardware_id"] == "a"


def test_rerun_is_told_faults_and_silence(shorted, tmp_path):
    path = tmp_path / "live.rrd"
    clock = [1_000_000.0]
    view = LiveView(str(path), SMALL, clock=lambda: clock[0])
    session = fed(view, shorted)
    clock[0] += 40
    view.tell("a", session.idle(40.0))
    view.close()
    texts = [text for _, (text,) in columns(path, "/tactile/a/faults", "TextLog:text")]
    assert texts[0].startswith("pad 0, row 0, column 1 is short")
    assert texts[-1] == "no frame for 2 s"
    images = columns(path, "/tactile/a/0/states", "SegmentationImage:buffer")
    assert images[-1][1][0][1] == State.FAULTY


@ENDINGS
def test_of_a_device_that_is_gone_all_frames_are_written_and_nothing_is_kept(ending, tmp_path):
    path = tmp_path / f"live.{ending}"
    view = LiveView(str(path), SMALL)
    fed(view, VALUES)
    view.forget("a")
    assert not view._devices
    view.close()
    np.testing.assert_array_equal(frames_in(path, "a")[1], VALUES)


@ENDINGS
def test_with_a_bundle_restored_frames_stand_beside_those_that_came(ending, made_bundle, tmp_path):
    path = tmp_path / f"live.{ending}"
    bundle = Bundle.open(made_bundle)
    known = bundle.known_faults().fault_set
    restorer = bundle.restorer()
    view = LiveView(str(path), bundle.layout, lambda: FrameRepair(restorer, known))
    values = np.random.default_rng(1).uniform(0, 5, (12, 60))
    values[:, 7] = np.nan
    fed(view, values, session=Session("a", Monitor(SelfDiagnosis(bundle.layout), wait=True)))
    view.close()
    repair = FrameRepair(restorer, known)
    whole = np.array([repair(frame)[0] for frame in values])
    np.testing.assert_array_equal(frames_in(path, "a")[1], values[:, :30].astype(np.float32))
    np.testing.assert_array_equal(
        frames_in(path, "a", "restored")[1], whole[:, :30].astype(np.float32)
    )


def test_devices_have_topics_of_their_own_and_silence_is_stale(tmp_path):
    path = tmp_path / "live.mcap"
    station = Station(SMALL, view=str(path), on_event=lambda event: None, quiet=True)
    for device in ("left", "right"):
        for i, frame in enumerate(VALUES):
            data = format_packet(device, i / 10, frame)
            station.receiver.take(data, i / 10, "10.0.0.1")
    station.receiver.close()
    asyncio.run(station._take_all())
    station._view.tell("left", station._sessions.of["left"].idle(time.monotonic() + 10))
    station._close_view()
    for device in ("left", "right"):
        np.testing.assert_array_equal(frames_in(path, device)[1], VALUES)
    _, last = messages(path, "/diagnostics")[-1]
    assert {(one["level"], one["message"], one["hardware_id"]) for one in last["status"]} == {
        (3, "no frame for 2 s", "left")
    }


def test_a_view_that_cannot_be_written_ends_and_the_station_goes_on(tmp_path, monkeypatch):
    events = []
    station = Station(SMALL, view=str(tmp_path / "live.mcap"), on_event=events.append, quiet=True)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(McapMessages, "add", full)
    for i, frame in enumerate(VALUES[:3]):
        station.receiver.take(format_packet("a", i / 10, frame), i / 10, "10.0.0.1")
    station.receiver.close()
    asyncio.run(station._take_all())
    (trouble,) = [event for event in events if event.kind == "trouble"]
    assert trouble.text == "the view ends: [Errno 28] No space left on device"
    assert station.receiver.counters.kept == 3


def test_viewers_of_rerun_are_served():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    view = LiveView(f"rerun:{port}", SMALL)
    fed(view, VALUES)
    assert view.places == (f"rerun+http://127.0.0.1:{port}/proxy",)
    with socket.create_connection(("127.0.0.1", port), timeout=10):
        pass
    view.close()


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ("live.bag", "--view live.bag: expected FILE.mcap, FILE.rrd or rerun"),
        ("rerun:x", "--view rerun:x: expected FILE.mcap, FILE.rrd or rerun"),
        ("", "--view '': name a file"),
        ("nowhere/live.mcap", "the folder nowhere is not there; create it first"),
    ],
)
def test_a_view_that_is_none_is_named(view, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["listen", "--port", "0", "--quiet", "--view", view]) == 3
    assert message in capsys.readouterr().err


@pytest.mark.slow
@ENDINGS
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_a_process_that_is_ended_or_killed_leaves_a_file_that_can_be_read(ending, end, tmp_path):
    path = tmp_path / f"live.{ending}"
    command = ["listen", "--port", "0", "--shape", "1x2x3", "--view", str(path)]
    code = "import sys; from adaptfault.cli import main; sys.exit(main(sys.argv[1:]))"
    child = subprocess.Popen(
        [sys.executable, "-c", code, *command],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    with child, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        assert child.stderr.readline() == f"view: {path}\n"
        port = int(re.search(r"port (\d+)", child.stderr.readline())[1])
        for i, frame in enumerate(VALUES):
            line.sendto(format_packet("a", i / 10, frame), ("127.0.0.1", port))
        time.sleep(2.0)
        child.send_signal(end)
        assert child.wait(20) == (0 if end == signal.SIGTERM else -signal.SIGKILL)
    frames = frames_in(path, "a")[1]
    assert len(frames) == 40 if end == signal.SIGTERM else len(frames) >= 29
    np.testing.assert_array_equal(frames, VALUES[: len(frames)])
