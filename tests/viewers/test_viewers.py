"""Files for Foxglove and Rerun hold the readings and the states of the log: the readers of the
formats read them."""

import base64
import json
import sys

import numpy as np
import pytest

from adaptfault.data.recordings import InputError
from adaptfault.viewers.mcap_file import CELL, write_mcap
from adaptfault.viewers.rerun_file import write_rrd
from adaptfault.viewers.ros_diagnostics import diagnostic_array
from adaptfault.viewers.timed_log import COLOURS, State, TimedLog
from diagnostics import Diagnosis, Fault, Line, SensorLayout

LAYOUT = SensorLayout(2, 3, 4, rate=4.0, present=np.arange(24) != 5)
ROW = Fault(
    "open", (12, 13, 14, 15), line=Line(1, "row", 0), reason="pad 1, row 0 is open", onset=8
)
CELL_3 = Fault("short", (3,))
LENGTHS = (6, 1, 9)
STARTS = (0.0, 2.5, 3.75)  # a second after the end of the recording before


@pytest.fixture
def recordings(rng) -> list[np.ndarray]:
    frames = [rng.uniform(0, 5, (length, 24)).astype(np.float32) for length in LENGTHS]
    frames[2][4, 20] = np.nan  # a missing reading
    return frames


@pytest.fixture
def log(recordings) -> TimedLog:
    tested = np.arange(24) != 23
    diagnosis = Diagnosis(LAYOUT, (CELL_3, ROW), np.zeros(24), tested, 16, 3)
    pieces = [recordings[0][:4], recordings[0][4:], *recordings[1:]]
    return TimedLog(diagnosis, ("a", "b", "c"), LENGTHS, lambda: iter(pieces))


def expected(recordings: list[np.ndarray]) -> np.ndarray:
    """All readings ``[T, pads, rows, cols]``, with NaN where there is no cell."""
    readings = np.concatenate(recordings)
    readings[:, 5] = np.nan
    return LAYOUT.grid(readings)


def times() -> np.ndarray:
    return np.concatenate([s + np.arange(n) / 4 for s, n in zip(STARTS, LENGTHS, strict=True)])


def test_recordings_follow_one_another_with_a_pause_of_one_second(log, recordings):
    np.testing.assert_array_equal(log.starts, STARTS)
    assert log.seconds == 6.0
    pieces = list(log)
    assert [piece.recording for piece in pieces] == [0, 0, 1, 2]
    np.testing.assert_array_equal(np.concatenate([piece.times for piece in pieces]), times())
    np.testing.assert_array_equal(
        np.concatenate([piece.readings for piece in pieces]), expected(recordings)
    )
    assert [log.place(frame) for frame in (0, 5, 6, 8)] == [
        (0, 0.0),
        (0, 1.25),
        (1, 2.5),
        (2, 4.0),
    ]


def test_each_position_has_a_state(log):
    states = log.states.ravel()
    assert set(np.flatnonzero(states == State.FAULTY)) == {3, 12, 13, 14, 15}
    assert np.flatnonzero(states == State.NO_CELL).tolist() == [5]
    assert np.flatnonzero(states == State.UNTESTED).tolist() == [23]
    assert np.sum(states == State.ALIVE) == 17
    assert COLOURS[State.NO_CELL][3] == 0


# MCAP


@pytest.fixture
def messages(log, tmp_path) -> dict[str, list[tuple[int, dict]]]:
    """Time in ns and content of all messages, by topic."""
    reader = pytest.importorskip("mcap.reader")
    write_mcap(tmp_path / "log.mcap", log)
    found = {}
    with open(tmp_path / "log.mcap", "rb") as file:
        for _, channel, message in reader.make_reader(file).iter_messages():
            assert channel.message_encoding == "json"
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    return found


def cells(grid: dict) -> np.ndarray:
    """The cells of a grid as its own fields describe them, the top row first."""
    kinds = {1: "u1", 7: "<f4"}
    packed = np.dtype(
        {
            "names": [field["name"] for field in grid["fields"]],
            "formats": [kinds[field["type"]] for field in grid["fields"]],
            "offsets": [field["offset"] for field in grid["fields"]],
            "itemsize": grid["cell_stride"],
        }
    )
    assert grid["row_stride"] == grid["column_count"] * grid["cell_stride"]
    flat = np.frombuffer(base64.b64decode(grid["data"]), packed)
    return flat.reshape(-1, grid["column_count"])[::-1]


def test_mcap_holds_every_reading_at_its_time(messages, recordings):
    for pad in range(2):
        told = messages[f"/tactile/{pad}/readings"]
        assert [at for at, _ in told] == np.round(times() * 1e9).astype(int).tolist()
        assert [g["timestamp"]["sec"] * 10**9 + g["timestamp"]["nsec"] for _, g in told] == [
            at for at, _ in told
        ]
        np.testing.assert_array_equal(
            [cells(grid)["reading"] for _, grid in told], expected(recordings)[:, pad]
        )


def test_mcap_repeats_states_and_diagnostics_each_second(messages, log):
    seconds = [0, 1, 2.5, 3.75, 4.75, 5.75]
    for topic in ("/tactile/0/states", "/tactile/1/states", "/diagnostics"):
        assert [at / 1e9 for at, _ in messages[topic]] == seconds
    for pad in range(2):
        for _, grid in messages[f"/tactile/{pad}/states"]:
            np.testing.assert_array_equal(cells(grid)["state"], log.states[pad])
    absent = cells(messages["/tactile/0/states"][0][1])[1, 1]
    assert tuple(absent) == (State.NO_CELL, 0, 0, 0, 0)
    _, last = messages["/diagnostics"][-1]
    assert last["header"]["stamp"] == {"sec": 5, "nsec": 750_000_000}
    assert last["status"] == diagnostic_array(log.diagnosis)["status"]


def test_grids_of_an_mcap_file_lie_beside_each_other(messages):
    places = [
        messages[f"/tactile/{pad}/{what}"][0][1]["pose"]["position"]
        for pad in range(2)
        for what in ("readings", "states")
    ]
    width, height = 4 * CELL, 3 * CELL
    for i, one in enumerate(places):
        for other in places[:i]:
            apart = abs(one["x"] - other["x"]) > width or abs(one["y"] - other["y"]) > height
            assert apart


def test_messages_of_an_mcap_file_have_the_fields_of_their_schemas(log, tmp_path, messages):
    reader = pytest.importorskip("mcap.reader")
    with open(tmp_path / "log.mcap", "rb") as file:
        summary = reader.make_reader(file).get_summary()
        (about,) = reader.make_reader(file).iter_metadata()
    assert about.metadata == {"0": "a", "1": "b", "2": "c"}
    schemas = {schema.name: json.loads(schema.data) for schema in summary.schemas.values()}
    assert set(schemas) == {"foxglove.Grid", "diagnostic_msgs/DiagnosticArray"}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert schema.encoding == "jsonschema"
        for _, message in messages[channel.topic]:
            agree(message, schemas[schema.name])


def agree(value, schema: dict) -> None:
    """Check a value against the part of JSON Schema that is used here."""
    if "oneOf" in schema:
        assert value in [option["const"] for option in schema["oneOf"]]
        return
    kinds = {"object": dict, "array": list, "string": str, "integer": int, "number": float}
    assert isinstance(value, kinds[schema["type"]])
    if schema["type"] == "object":
        assert value.keys() == schema["properties"].keys()
        for name, part in value.items():
            agree(part, schema["properties"][name])
    if schema["type"] == "array":
        for item in value:
            agree(item, schema["items"])


# Rerun


@pytest.fixture
def batches(log, tmp_path) -> dict[str, list]:
    """Tables of all chunks, by entity."""
    chunk = pytest.importorskip("rerun.chunk", reason="a newer rerun-sdk reads files")
    write_rrd(tmp_path / "log.rrd", log)
    found = {}
    for part in chunk.RrdReader(tmp_path / "log.rrd").stream().to_chunks():
        found.setdefault(part.entity_path, []).append(part.to_record_batch())
    return found


def column(batches: list, name: str) -> list:
    """All values of a column, in the order of time."""
    rows = []
    for batch in batches:
        if name in batch.schema.names:
            at = batch.column("time").to_pylist() if "time" in batch.schema.names else [None]
            rows += zip(at, batch.column(name).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def seconds_of(batches: list) -> list[float]:
    return [at.total_seconds() for at in column(batches, "time")]


def test_rerun_holds_every_reading_at_its_time(batches, recordings):
    for pad in range(2):
        of_pad = batches[f"/tactile/{pad}/readings"]
        images = [
            np.array(image, np.uint8).view("<f4").reshape(3, 4)
            for (image,) in column(of_pad, "DepthImage:buffer")
        ]
        np.testing.assert_array_equal(images, expected(recordings)[:, pad])
        assert seconds_of(of_pad) == times().tolist()
        assert column(of_pad, "recording") == [0] * 6 + [1] + [2] * 9
        ((shape,),) = column(of_pad, "DepthImage:format")
        assert (shape["width"], shape["height"]) == (4, 3)


def test_rerun_shows_states_in_colours_with_names(batches, log):
    for pad in range(2):
        ((image,),) = column(batches[f"/tactile/{pad}/states"], "SegmentationImage:buffer")
        np.testing.assert_array_equal(np.reshape(image, (3, 4)), log.states[pad])
    (classes,) = column(batches["/tactile"], "AnnotationContext:context")
    told = [one["class_description"]["info"] for part in classes for one in part]
    assert {one["id"]: one["label"] for one in told} == {state.value: str(state) for state in State}
    assert next(one["color"] for one in told if one["id"] == State.NO_CELL) == 0


def test_rerun_covers_what_has_no_reading_from_the_frame_on_where_that_changes(batches):
    of_pad = {pad: batches[f"/tactile/{pad}/readings/missing"] for pad in range(2)}
    covers = {
        pad: [np.reshape(image, (3, 4)) for (image,) in column(part, "SegmentationImage:buffer")]
        for pad, part in of_pad.items()
    }
    absent = np.arange(12).reshape(3, 4) == 5
    np.testing.assert_array_equal(covers[0], [absent])
    missing = np.arange(12).reshape(3, 4) == 8
    np.testing.assert_array_equal(covers[1], [missing, np.zeros((3, 4))])
    assert [seconds_of(of_pad[pad]) for pad in range(2)] == [[0.0], [4.75, 5.0]]


def test_rerun_lists_faults_at_their_onset_and_recordings(batches):
    faults = batches["/tactile/faults"]
    assert seconds_of(faults) == [0.0, 4.0]
    assert column(faults, "TextLog:text") == [["pad 0, row 0, column 3: short"], [ROW.reason]]
    assert column(faults, "TextLog:level") == [["WARN"], ["ERROR"]]
    assert column(batches["/tactile/recordings"], "TextLog:text") == [["a"], ["b"], ["c"]]
    assert seconds_of(batches["/tactile/recordings"]) == list(STARTS)


# Both


@pytest.mark.parametrize(("write", "package"), [(write_mcap, "mcap.writer"), (write_rrd, "rerun")])
def test_a_missing_package_is_named_with_its_remedy(write, package, log, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"install it: pip install 'adaptfault-viewers\[view\]'"):
        write(tmp_path / "log.x", log)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("write", "package"), [(write_mcap, "mcap"), (write_rrd, "rerun")])
def test_a_file_that_cannot_be_finished_leaves_the_old_one(write, package, log, tmp_path):
    pytest.importorskip(package)
    (tmp_path / "log.x").write_text("old")

    def damaged():
        yield from list(log.pieces())[:2]
        raise OSError("a disk that fails")

    broken = TimedLog(log.diagnosis, log.names, log.lengths, damaged)
    with pytest.raises(OSError, match="a disk that fails"):
        write(tmp_path / "log.x", broken)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("log.x", "old")]


@pytest.mark.parametrize(("write", "package"), [(write_mcap, "mcap"), (write_rrd, "rerun")])
def test_a_log_without_a_fault_is_written_too(write, package, log, recordings, tmp_path):
    pytest.importorskip(package)
    healthy = Diagnosis(LAYOUT, (), np.zeros(24), np.ones(24, bool), 16, 3)
    write(tmp_path / "log.x", TimedLog(healthy, log.names, LENGTHS, lambda: iter(recordings)))
    assert (tmp_path / "log.x").stat().st_size > 1000
