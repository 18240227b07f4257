"""adaptfault listen, from datagrams on loopback to lines on stdout and files on the disk."""

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import Recorder, Session, Station, format_packet, parse_when
from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.session import CONFIRMED_AFTER, SILENCE
from adaptfault.cli import main
from adaptfault.data.recordings import load
from diagnostics import Fault, FaultSet, SensorLayout

SMALL = SensorLayout(1, 2, 3)
ROOT = Path(__file__).parents[2]


@dataclass
class Reading:
    label: object
    probabilities: object = (0.1, 0.9)
    fault_set: FaultSet = field(default_factory=lambda: FaultSet((), 6))
    events: tuple[Fault, ...] = ()
    faults: tuple[Fault, ...] = ()
    contact: object = None
    classes: object = None


class Scripted:
    """A predictor that says what it was told to."""

    layout = SMALL

    def __init__(self, readings=()):
        self.readings = list(readings)
        self.confirmed = 0
        self.frames = []

    def stream(self, frame, time=None):
        self.frames.append((frame, time))
        return self.readings.pop(0) if self.readings else Reading("cup")

    def confirm(self):
        self.confirmed += 1


def frames(count, value=0.0, start=0):
    return [Frame("a", i / 10, np.full(6, float(value))) for i in range(start, start + count)]


def told(session, given):
    """Feed a session; return its events as (kind, time)."""
    return [
        (event.kind, round(event.time, 3)) for one in given for event in session.take(one, one.time)
    ]


def send(port, datagrams, pause=0.0):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        for data in datagrams:
            line.sendto(data, ("127.0.0.1", port))
            time.sleep(pause)


def packets(values, device="a", start=0):
    return [format_packet(device, (start + i) / 10, frame) for i, frame in enumerate(values)]


# One device


def test_only_changes_of_the_class_are_told_and_none_before_the_window_is_full():
    labels = [None, None, "cup", "cup", "ball", "ball", "cup"]
    session = Session("a", Scripted([Reading(label) for label in labels]))
    assert told(session, frames(7)) == [("class", 0.2), ("class", 0.4), ("class", 0.6)]


def test_labels_of_numpy_become_json_and_lines_begin_with_the_time_of_day():
    session = Session(
        "a",
        Scripted([Reading(np.int64(3), np.array([0.25, 0.75]))]),
        clock=lambda: datetime(2026, 5, 4, 14, 3, 7, 250_000),
    )
    (event,) = session.take(frames(1)[0], 0.0)
    assert json.loads(json.dumps(event.to_dict()))["label"] == 3
    assert str(event) == "14:03:07.2 a class: 3 (75%)"
    assert event.to_dict()["clock"].startswith("2026-05-04T14:03:07.250")


def test_accumulated_classes_are_told_once_a_contact_and_do_not_flip():
    cup = np.array([0.9, 0.1])
    ball = np.array([0.2, 0.8])
    readings = [Reading(1), Reading(1, contact=cup), Reading(0, contact=cup)]
    readings += [Reading(1), Reading(0, contact=cup), Reading(0, contact=ball)]
    session = Session("a", Scripted(readings), accumulate=True)
    events = [event for one in frames(6) for event in session.take(one, one.time)]
    assert [(round(event.time, 1), event.text) for event in events] == [
        (0.1, "0 (90%)"),
        (0.4, "0 (90%)"),
        (0.5, "1 (80%)"),
    ]


def test_a_set_of_classes_is_told_when_it_changes():
    likely = np.array([0.6, 0.3, 0.1])
    sets = [(0,), (0,), (0, 1), ()]
    readings = [Reading(0, probabilities=likely, classes=one) for one in sets]
    session = Session("a", Scripted(readings))
    events = [event for one in frames(4) for event in session.take(one, one.time)]
    assert [event.text for event in events] == [
        "0 (60%), one of {0}",
        "0 (60%), one of {0, 1}",
        "0 (60%), one of {}",
    ]
    assert events[1].to_dict()["classes"] == [0, 1]


def test_faults_are_told_when_they_come_and_when_they_go():
    fault = Fault("short", (4,), probability=0.99, reason="pad 0, row 1, column 1 reads full scale")
    gone = Fault("short", (4,), probability=0.0, reason="gone")
    session = Session(
        "a", Scripted([Reading(None, events=(fault,)), Reading(None, events=(gone,))])
    )
    first, second = (session.take(one, 0.0)[0] for one in frames(2))
    assert (first.kind, first.text, second.kind) == ("fault", fault.reason, "gone")
    assert Fault.from_dict(first.to_dict()["fault"]) == fault


def test_a_predictor_is_confirmed_once_after_it_has_worked_for_a_while():
    predictor = Scripted()
    events = told(Session("a", predictor), frames(CONFIRMED_AFTER - 1))
    assert predictor.confirmed == 0
    session = Session("a", predictor)
    events = told(session, frames(3 * CONFIRMED_AFTER))
    assert predictor.confirmed == 1
    assert [kind for kind, _ in events].count("confirmed") == 1


def test_a_regression_is_confirmed_as_a_classifier_is_and_tells_no_class():
    predictor = Scripted()
    values = types.SimpleNamespace(
        label=None,
        probabilities=None,
        values=np.ones(2),
        fault_set=FaultSet((), 6),
        events=(),
        faults=(),
    )
    predictor.readings = [values] * CONFIRMED_AFTER
    assert [kind for kind, _ in told(Session("a", predictor), frames(CONFIRMED_AFTER))] == [
        "confirmed"
    ]
    assert predictor.confirmed == 1


def test_a_version_that_cannot_be_confirmed_is_reported_once_and_tried_again():
    predictor = Scripted()
    answers = [OSError("no space left"), False, True]

    def confirm():
        answer = answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer

    predictor.confirm = confirm
    events = told(Session("a", predictor), frames(5 * CONFIRMED_AFTER))
    assert [kind for kind, _ in events] == ["class", "trouble", "confirmed"]
    assert not answers


def test_readings_outside_the_range_are_missing_and_counted(listened):
    values = np.zeros((12, 6))
    values[3, 2] = 1e30
    values[5, 1] = -700.0
    lines = listened(packets(values), "--shape", "1x2x3", "--frames", "12", "--json")
    end = json.loads(lines[-1])
    assert end["counters"]["kept"] == 12
    assert end["readings_outside_range"] == 2


def test_a_touch_is_recorded_with_what_came_before_and_after_it(tmp_path):
    session = Session(
        "a", Scripted(), recorder=Recorder(tmp_path, SMALL, "a"), rule=parse_when("contact", SMALL)
    )
    given = [*frames(20), *frames(10, 2.0, 20), *frames(30, 0.0, 30)]
    events = [event for event in told(session, given) if event[0] != "class"]
    assert events == [("recording", 2.0), ("recorded", 4.0)]
    (recorded,) = load(tmp_path, layout=SMALL).recordings.frames
    assert recorded[:, 0].tolist() == [0.0] * 5 + [2.0] * 10 + [0.0] * 10


def test_cells_known_to_be_faulty_start_no_recording(tmp_path):
    fault = Fault("short", (0, 1, 2), probability=0.99, reason="a row")
    predictor = Scripted([Reading(None, events=(fault,))])
    session = Session(
        "a", predictor, recorder=Recorder(tmp_path, SMALL, "a"), rule=parse_when("contact", SMALL)
    )
    shorted = [Frame("a", i / 10, np.array([5.0, 5, 5, 0, 0, 0])) for i in range(20)]
    assert "recording" not in [kind for kind, _ in told(session, shorted)]


def test_a_silent_device_is_told_once_and_its_recording_is_closed(tmp_path):
    session = Session(
        "a", Scripted(), recorder=Recorder(tmp_path, SMALL, "a"), rule=parse_when("always", SMALL)
    )
    told(session, frames(5))
    assert session.idle(SILENCE) == []
    assert [event.kind for event in session.idle(SILENCE + 1)] == ["silent", "recorded"]
    assert session.idle(SILENCE + 2) == []
    assert ("recording", 9.0) in told(session, frames(1, start=90))
    session.close()


def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, SMALL, "a")
    session = Session("a", Scripted(), recorder=recorder, rule=parse_when("always", SMALL))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder, "write", full)
    assert [kind for kind, _ in told(session, frames(10))] == ["class", "trouble"]
    monkeypatch.undo()
    session.command(True)
    assert "recording" in [kind for kind, _ in told(session, frames(1, start=10))]
    session.close()


# The command


@pytest.fixture
def listened(capsys, once_bound):
    """Run the command in this process while datagrams come; return stdout's lines."""

    def listened(datagrams, *arguments):
        sending = once_bound(lambda port: send(port, datagrams, 0.001))
        assert main(["listen", *map(str, arguments), "--port", "0", "--quiet"]) == 0
        sending.join()
        return capsys.readouterr().out.splitlines()

    return listened


def test_what_is_sent_is_recorded_and_the_counters_come_last(tmp_path, listened):
    values = np.arange(60.0).reshape(10, 6) % 5
    datagrams = [b"garbage", b"a,1,2", *packets(values)]
    lines = listened(
        datagrams,
        "--shape",
        "1x2x3",
        "--record",
        tmp_path,
        "--when",
        "always",
        *("--frames", 10, "--seconds", 300),
        "--json",
    )
    dropped, first, *_, last = map(json.loads, lines)
    assert (dropped["kind"], dropped["device"]) == ("trouble", "station")
    assert dropped["text"].startswith("a packet is dropped: 0 values after device and time stamp")
    assert (first["schema"], first["kind"]) == ("adaptfault.event/1", "recording")
    assert last["schema"] == "adaptfault.listen/1"
    assert (last["counters"]["kept"], last["counters"]["malformed"]) == (10, 2)
    np.testing.assert_array_equal(load(tmp_path, layout=SMALL).recordings.frames[0], values)


def test_with_a_bundle_classes_are_told(tmp_path, listened, monkeypatch):
    loaded = []

    class Predictor(Scripted):
        @classmethod
        def load(cls, path, **trust):
            loaded.append((path, cls([Reading(None), Reading("cup"), Reading("ball")])))
            return loaded[-1][1]

    monkeypatch.setattr("adaptfault.prediction.predictor.Predictor", Predictor)
    bare = types.SimpleNamespace(parts=types.SimpleNamespace(calibration=None))
    monkeypatch.setattr("adaptfault.bundle.bundle.Bundle.open", lambda path, **trust: bare)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.bundle").mkdir()
    (tmp_path / "robot.bundle/bundle.json").touch()
    lines = listened(packets(np.zeros((3, 6))), "robot.bundle", "--frames", 3, "--seconds", 300)
    time_of_day = r"\d\d:\d\d:\d\d\.\d"
    assert re.fullmatch(rf"{time_of_day} a class: cup \(90%\)", lines[0])
    assert re.fullmatch(rf"{time_of_day} a class: ball \(90%\)", lines[1])
    assert lines[-1].startswith("end: 3 received = 3 kept")
    ((path, predictor),) = loaded
    assert (path, len(predictor.frames)) == ("robot.bundle", 3)


def test_without_what_a_bundle_needs_the_user_is_told_so(bundle, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "adaptfault.adaptation.result", None)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["listen", str(bundle.path), "--port", "0"]) == 3
    assert "classifying needs" in capsys.readouterr().err
    assert main(["listen", "no.bundle", "--port", "0"]) == 3
    assert "expected a bundle" in capsys.readouterr().err


def test_counts_are_turned_into_newtons_by_a_calibration(tmp_path, listened):
    table = tmp_path / "tables.csv"
    table.write_text(
        "cell,raw,force\n" + "".join(f"{cell},0,0\n{cell},1000,4\n" for cell in range(6))
    )
    datagrams = packets(np.full((5, 6), 500.0))
    options = (
        "--shape",
        "1x2x3",
        "--calibration",
        table,
        "--record",
        tmp_path / "log",
        "--when",
        "always",
    )
    listened(datagrams, *options, "--frames", 5, "--seconds", 300)
    loaded = load(tmp_path / "log", layout=tmp_path / "log" / "layout.json").recordings
    assert (loaded.layout.unit, loaded.layout.full_scale) == ("N", 4.0)
    np.testing.assert_array_equal(loaded.frames[0], 2.0)


def test_a_row_that_breaks_is_told_without_any_bundle(grasps, capsys, once_bound):
    values = np.concatenate(grasps.frames[::7]).copy()[:600]
    values.reshape(-1, 2, 11, 10)[:, 1, 5] = 5.0
    events = []
    station = Station(
        grasps.layout, frames=len(values), seconds=300, quiet=True, on_event=events.append
    )
    sending = once_bound(lambda port: send(port, packets(values), 0.002))
    asyncio.run(station.listen())
    sending.join()
    assert any(event.kind == "fault" and "pad 1, row 5 is short" in event.text for event in events)
    assert capsys.readouterr().out.startswith("end: 600 received")


def wait_for(child, line, count):
    """Wait until the recording that the child tells of has a line so often."""
    path = Path(child.stdout.readline().split()[-1])
    while path.read_text().count(line) < count and child.poll() is None:
        time.sleep(0.01)


@pytest.mark.parametrize(
    "end",
    [
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        signal.SIGHUP,
        "quit",
    ],
)
def test_commands_switch_the_recording_and_every_way_to_end_closes_the_files(tmp_path, end):
    arguments = [
        "listen",
        "--port",
        "0",
        "--shape",
        "1x2x3",
        "--record",
        str(tmp_path),
        "--when",
        "command",
    ]
    code = f"import sys; from adaptfault.cli import main; code = main({arguments!r})"
    code += "\nsys.exit(code or 9 * ('torch' in sys.modules))"
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        text=True,
        env=environment,
        bufsize=1,
    )
    watchdog = threading.Timer(300, child.kill)
    watchdog.start()
    with child:
        port = int(re.search(r"port (\d+)", child.stderr.readline())[1])
        send(port, packets(np.zeros((5, 6)), start=1000))
        time.sleep(1.0)  # a device that restarts is silent for a while
        send(port, packets(np.zeros((2, 6))))
        assert "restart: " in child.stdout.readline()  # so these have been dealt with
        child.stdin.write("record\n")
        assert child.stderr.readline() == "record: recording from now on\n"
        send(port, packets(np.ones((5, 6)), start=2))
        wait_for(child, "1,1,1,1,1,1\n", 5)
        child.stdin.write("stop\n")
        assert " a recorded: " in child.stdout.readline()
        child.stdin.write("what\nauto\nrecord\n")
        answers = [child.stderr.readline() for _ in range(4)]
        assert answers[0] == "stop: not recording\n"
        assert "'what' is not a command" in answers[1]
        assert answers[2] == "auto: recording as the rule says\n"
        send(port, packets(np.full((5, 6), 2.0), start=7))
        wait_for(child, "2,2,2,2,2,2\n", 5)
        if end == "quit":
            child.stdin.write("quit\n")
        else:
            child.send_signal(end)
        out, err = child.communicate(timeout=300)
    watchdog.cancel()
    assert (child.returncode, err) == (0, "")
    recorded, last = out.splitlines()
    assert "5 frames" in recorded
    assert last == "end: 17 received = 17 kept; 1 device, 1 restart"
    recordings = load(tmp_path, layout=tmp_path / "layout.json").recordings
    first, second = (one[:, 0].tolist() for one in recordings.frames)
    assert (first[-5:], second) == ([1.0] * 5, [2.0] * 5)
    assert sum(first[:-5]) == 0 and len(first) <= 6  # noqa: PT018  the last packet before the command may be in time


def test_replays_of_old_packets_leave_a_session_in_one_file(tmp_path, monkeypatch):
    # however slow the machine is
    monkeypatch.setattr("adaptfault.acquisition.station._DRAIN", 60.0)
    station = Station(
        SMALL, record=tmp_path, when="always", on_event=lambda event: None, quiet=True
    )
    values = np.arange(1800.0).reshape(300, 6) % 5
    datagrams = packets(values)
    for i, data in enumerate(datagrams):
        station.receiver.take(data, i / 10, "10.0.0.1")
        for old in datagrams[: max(0, i - 100)][-3:]:
            station.receiver.take(old, i / 10, "10.0.0.1")
    station.receiver.close()
    asyncio.run(station._take_all())
    for session in station._sessions.of.values():
        session.close()
    counters = station.receiver.counters
    assert (counters.received, counters.kept, counters.restarts) == (300 + 3 * 199 - 3, 300, 0)
    (recording,) = load(tmp_path, layout=SMALL).recordings.frames
    np.testing.assert_array_equal(recording, values)


@pytest.mark.slow
def test_it_quits_while_10000_packets_a_second_arrive():
    """The limit is that of a machine that is busy: on an idle one it takes under a second, 10,000
    packets."""
    code = "import sys; from adaptfault.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "listen", "--port", "0", "--shape", "1x2x3"]
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
    child = subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment, bufsize=1
    )
    with child, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        port = int(re.search(r"port (\d+)", child.stderr.readline())[1])
        sent = 0
        began = time.monotonic()
        quit_after = 20_000
        most = 200_000
        while child.poll() is None and sent < most:
            due = int((time.monotonic() - began) * 10_000)
            for i in range(sent, min(due, most)):
                line.sendto(format_packet("a", i / 10_000, np.ones(6)), ("127.0.0.1", port))
            if sent < quit_after <= due:
                child.stdin.write("quit\n")
            sent = max(sent, due)
            time.sleep(0.001)
        assert child.poll() == 0, (
            f"it still runs {sent - quit_after} packets after it was told to quit"
        )
        counted = re.fullmatch(r"end: (\d+) received = .*", child.stdout.read().splitlines()[-1])
    assert int(counted[1]) > 0
    print(f"{sent - quit_after} packets after quit")


def test_the_unit_of_time_stamps_is_a_word_or_a_number(listened):
    datagrams = [b"a,12,1,1,1,1,1,1", b"a,12.5,1,1,1,1,1,1"]
    for ticks in ("s", "1"):
        lines = listened(
            datagrams, "--shape", "1x2x3", "--frames", 2, "--seconds", 300, "--ticks", ticks
        )
        assert lines == ["end: 2 received = 2 kept; 1 device, 4 lost"]


def test_frames_beyond_the_wanted_number_count_as_dropped(listened):
    lines = listened(
        packets(np.zeros((4, 6))), "--shape", "1x2x3", "--frames", 1, "--seconds", 300, "--json"
    )
    counters = json.loads(lines[-1])["counters"]
    assert counters["kept"] == 1
    assert counters["received"] == 1 + counters["dropped"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "70000"], "expected 0 to 65535"),
        (["--port", "0", "--when", "always"], "--when needs --record FOLDER"),
        (["--port", "0", "--shape", "2xx6"], "2xx6"),
        (
            ["--port", "0", "--record", "{tmp}/new", "--when", "never"],
            "--when never: expected always",
        ),
        (["--port", "0", "--record", "{tmp}/file/new"], "Not a directory"),
        (["--port", "0", "--host", "256.1.1.1", "--seconds", "1"], ""),
        (["--port", "0", "--ticks", "0"], "--ticks 0"),
        (["--port", "0", "--accumulate"], "--accumulate needs BUNDLE"),
        (["--port", "0", "--sets", "0.1"], "--sets needs BUNDLE"),
        (["--port", "0", "--frames", "0"], "--frames 0"),
        (["--port", "0", "--record", ""], "--record '': name a folder"),
        (["", "--port", "0"], ": expected a bundle"),
        (["--port", "0", "--layout", "{tmp}/gone.json"], "gone.json"),
    ],
)
def test_unusable_options_are_one_line_and_exit_code_3(tmp_path, capsys, arguments, message):
    (tmp_path / "file").touch()
    assert main(["listen", *(a.format(tmp=tmp_path) for a in arguments)]) == 3
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith("adaptfault listen: error: ")
    assert message in line
    assert said.out == ""
