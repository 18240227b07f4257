"""Frames of a scan among the others: they are no readings, and what they say is told."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.acquisition import (
    PacketError,
    Receiver,
    Recorder,
    Session,
    format_packet,
    parse_packet,
)
from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.scanning import Scans
from diagnostics import Monitor, SelfDiagnosis, SensorLayout
from diagnostics.simulation.circuit import Circuit, CutLine, StuckCell
from diagnostics.simulation.scan import scan_circuit
from diagnostics.wiring import Line

LAYOUT = SensorLayout(1, 6, 5)
D = LAYOUT.n_cells
RATE = LAYOUT.rate
SCAN = scan_circuit(
    Circuit(LAYOUT, faults=(StuckCell(7, np.inf), CutLine(Line(0, "row", 4), 0))),
    np.full(D, 0.01),
)


class Watcher(Monitor):
    """Notes which frames it is given."""

    def __init__(self):
        super().__init__(SelfDiagnosis(LAYOUT))
        self.given = []

    def update(self, frame, time=None):
        self.given.append(time)
        return super().update(frame, time)


def stream(scan=SCAN, before=5, after=25, start=0.0):
    """Frames, a scan, frames, at an even rate."""
    ordinary = [(None, np.zeros(D))]
    between = list(zip(scan.levels.tolist(), scan.readings, strict=True))
    every = before * ordinary + between + after * ordinary
    return [
        Frame("a", start + i / RATE, values, scan=level) for i, (level, values) in enumerate(every)
    ]


def events_of(session, frames):
    return [event for one in frames for event in session.take(one, one.time)]


levels = st.floats(0, 1).map(lambda level: float(f"{level:.9g}"))
numbers = st.lists(st.floats(0, 1, width=16), min_size=1, max_size=9)


@given(levels, numbers)
def test_a_packet_of_a_scan_comes_back_and_one_without_is_of_version_1(level, values):
    packet = parse_packet(format_packet("a", 1.0, values, scan=level), len(values))
    assert packet.scan == level
    np.testing.assert_allclose(packet.values, values, rtol=5e-6)
    plain = format_packet("a", 1.0, values)
    assert parse_packet(plain, len(values)).scan is None
    assert plain == format_packet("a", 1.0, values, scan=level).replace(
        b",scan=%s" % f"{level:.9g}".encode(), b""
    )


@pytest.mark.parametrize("level", ["2", "-0.1", "nan", "", "half"])
def test_a_scan_at_another_level_is_malformed_in_one_line(level):
    with pytest.raises(PacketError) as caught:
        parse_packet(f"a,1,scan={level},1,2".encode(), 2)
    assert "\n" not in str(caught.value)


def test_a_level_that_could_not_be_read_back_is_not_sent():
    with pytest.raises(ValueError, match=r"scan=2: expected the share of the drive, 0 to 1"):
        format_packet("a", 1.0, [0.0], scan=2)


def test_a_scan_passes_the_receiver_in_order_with_its_levels():
    receiver = Receiver(LAYOUT)
    got = []
    receiver.on_frame = got.append
    for i, (level, values) in enumerate(zip(SCAN.levels, SCAN.readings, strict=True)):
        receiver.take(format_packet("a", i / RATE, values, scan=level), i / RATE)
    assert [one.scan for one in got] == SCAN.levels.tolist()
    assert receiver.counters.malformed == 0


def test_a_scan_is_told_with_its_faults_and_is_neither_monitored_nor_lost_frames():
    watcher = Watcher()
    session = Session("a", watcher, scans=Scans(LAYOUT))
    events = events_of(session, stream())
    assert [event.kind for event in events] == ["scan", "fault", "fault"]
    assert events[0].data["tested"] == D
    assert set(session.fault_set) == {7, *LAYOUT.cells_on(Line(0, "row", 4)).tolist()}
    np.testing.assert_allclose(watcher.given, np.arange(30) / RATE)
    assert set(watcher.diagnosis().fault_set) >= set(session.fault_set)
    again = events_of(session, stream(start=100.0))
    assert [event.kind for event in again] == ["scan"]  # the faults are known


def test_a_scan_that_was_interrupted_is_told_and_blames_nobody():
    session = Session("a", Watcher(), scans=Scans(LAYOUT))
    frames = stream()
    (event,) = events_of(session, frames[:30] + frames[-5:])
    assert event.kind == "scan"
    assert "incomplete" in event.data["incomplete"]
    assert event.data["faults"] == []


def test_a_scan_at_the_end_is_told_when_the_session_ends():
    session = Session("a", Watcher(), scans=Scans(LAYOUT))
    assert not events_of(session, stream(after=0))
    assert session.finish()[0].kind == "scan"
    assert not session.finish()


def test_ordinary_frames_may_come_between_those_of_a_scan():
    watcher = Watcher()
    session = Session("a", watcher, scans=Scans(LAYOUT))
    between = []
    for i, frame in enumerate(stream(before=0, after=0)):
        between += [frame, Frame("a", frame.time + 0.05, np.zeros(D))]
        between[-2] = Frame("a", i / RATE, frame.values, scan=frame.scan)
    behind = [Frame("a", 10 + i / RATE, np.zeros(D)) for i in range(2)]
    events = events_of(session, between + behind)
    assert [event.kind for event in events] == ["scan", "fault", "fault"]
    assert len(watcher.given) == len(between) // 2 + 2
    assert (np.diff(watcher.given) > 0).all()


def test_a_recorder_keeps_the_scan_in_a_file_of_its_own(tmp_path):
    recorder = Recorder(tmp_path, LAYOUT, "a:1")
    session = Session("a:1", Watcher(), recorder=recorder, scans=Scans(LAYOUT))
    events = events_of(session, stream())
    (path,) = tmp_path.glob("*_scan.csv")
    assert events[-1].data["path"] == str(path)
    lines = path.read_text().splitlines()
    assert lines[0].split(",")[:2] == ["scan", "c0"]
    written = np.array([line.split(",") for line in lines[1:]], float)
    np.testing.assert_allclose(written[:, 0], SCAN.levels)
    np.testing.assert_allclose(written[:, 1:], SCAN.readings, rtol=1e-6)
