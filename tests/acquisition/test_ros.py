"""Diagnoses as ROS diagnostics: levels, names that stay, and bags that hold them."""

import json
import re
import subprocess
import sys
import threading
from array import array
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from adaptfault.acquisition.followed import BundleAt, Follower, Sensor
from adaptfault.acquisition.watch import WAITING, Watch
from adaptfault.data.calibration import Calibration
from adaptfault.data.recordings.formats.message_arrays import arrays_at, join, put
from adaptfault.imputation.restorer import Restorer
from adaptfault.ros2 import parameters
from adaptfault.ros2.parameters import DEFAULTS, Parameters, quoted, unknown
from adaptfault.ros2.rounds import Part, Rounds
from adaptfault.ros2.sensor import sensor_of
from adaptfault.viewers.ros_diagnostics import (
    Level,
    diagnostic_array,
    stale_array,
    write_diagnostics,
)
from diagnostics import (
    Fault,
    FaultKind,
    FaultSet,
    Line,
    SelfDiagnosis,
    SensorLayout,
    inject,
    line_fault,
    lose_frames,
)
from diagnostics.simulation.circuit import Circuit, StuckCell
from diagnostics.simulation.scan import scan_circuit

LAYOUT = SensorLayout.paper()


@pytest.fixture(scope="module")
def log(grasps):
    return np.concatenate([grasps.frames[i] for i in range(1, 140, 7)]).astype(float)


@pytest.fixture(scope="module")
def busy(log):
    """The cell of pad 0 that is loaded most."""
    return int(log[:, :110].mean(axis=0).argmax())


def statuses(array) -> dict[str, dict]:
    return {status["name"]: status for status in array["status"]}


def levels(array) -> dict[str, int]:
    return {
        name.removeprefix("tactile: "): status["level"] for name, status in statuses(array).items()
    }


def test_a_healthy_sensor_is_ok_everywhere(fitted, log):
    array = diagnostic_array(fitted.diagnose(log), stamp=12.25, hardware_id="glove-7")
    assert set(levels(array).values()) == {Level.OK}
    assert array["header"]["stamp"] == {"sec": 12, "nanosec": 250_000_000}
    assert {status["hardware_id"] for status in array["status"]} == {"glove-7"}


def test_single_cells_warn_and_wires_are_errors_on_their_pad_and_group_only(fitted, log, busy):
    one = levels(diagnostic_array(fitted.diagnose(inject(log, [Fault("short", (busy,))], LAYOUT))))
    assert {name for name, level in one.items() if level} == {"pad 0"}
    assert one["pad 0"] == Level.WARN
    row = line_fault(LAYOUT, Line(1, "row", 5), FaultKind.SHORT)
    found = next(
        f for f in fitted.diagnose(inject(log, [row], LAYOUT)).faults if f.line == row.line
    )
    array = diagnostic_array(replace(fitted.diagnose(log), faults=(found,)))
    two = levels(array)
    assert {name: level for name, level in two.items() if level} == {
        "pad 1": Level.ERROR,
        "pad 1 rows": Level.ERROR,
    }
    wires = statuses(array)["tactile: pad 1 rows"]
    assert wires["message"] == "row 5"
    assert {"key": "faulty", "value": "1"} in wires["values"]


def test_a_tenth_of_a_pad_is_an_error_without_any_wire(fitted, log):
    loaded = np.argsort(-log[:, :110].mean(axis=0))[:24:2].tolist()
    # Each at a value of its own: no wire explains two of them.
    stuck = [Fault("stuck", (cell,), value=1 + 0.25 * i) for i, cell in enumerate(loaded)]
    diagnosis = fitted.diagnose(inject(log, stuck, LAYOUT))
    assert len(diagnosis.fault_set) >= 11
    assert not any(fault.line for fault in diagnosis.faults)
    assert levels(diagnostic_array(diagnosis))["pad 0"] == Level.ERROR


def test_lost_frames_are_a_warning_of_the_stream_and_of_nothing_else(fitted, log):
    found = levels(diagnostic_array(fitted.diagnose(lose_frames(log, 0.1, seed=0))))
    assert {name for name, level in found.items() if level} == {"stream"}


def test_the_names_are_the_same_whatever_is_wrong_and_no_cell_has_one(fitted, log, busy):
    arrays = [
        diagnostic_array(fitted.diagnose(log)),
        diagnostic_array(fitted.diagnose(inject(log, [Fault("open", (busy,))], LAYOUT))),
        diagnostic_array(SelfDiagnosis(LAYOUT).diagnose(np.zeros((50, 220)))),
        stale_array(LAYOUT),
    ]
    names = [[status["name"] for status in array["status"]] for array in arrays]
    assert all(one == names[0] for one in names)
    assert len(set(names[0])) == len(names[0]) == 2 * 5 + 1
    assert set(levels(arrays[2]).values()) == {Level.OK}  # nothing was tested: no alarm
    assert set(levels(arrays[3]).values()) == {Level.STALE}


def test_masked_positions_and_other_shapes_do_no_harm():
    layout = SensorLayout(3, 2, 2, present=[[[1, 1], [1, 0]]] * 3)
    frames = np.zeros((64, 12))
    frames[10:40] = 3.0
    array = diagnostic_array(SelfDiagnosis(layout).diagnose(frames))
    assert {"key": "cells", "value": "3"} in statuses(array)["tactile: pad 2"]["values"]
    assert len(array["status"]) == 3 * 5 + 1


def test_everything_is_plain_json_and_all_values_are_text(fitted, log, busy):
    array = diagnostic_array(fitted.diagnose(inject(log, [Fault("short", (busy,))], LAYOUT)))
    assert json.loads(json.dumps(array, allow_nan=False)) == array
    assert all(
        isinstance(pair["value"], str) for status in array["status"] for pair in status["values"]
    )
    values = {pair["key"]: pair["value"] for pair in statuses(array)["tactile: pad 0"]["values"]}
    assert values["faulty cells"] == "{1}.{2}".format(*LAYOUT.position(busy))


def test_what_is_written_into_a_bag_is_read_back(fitted, log, tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    row = line_fault(LAYOUT, Line(1, "row", 5), FaultKind.SHORT)
    arrays = [
        diagnostic_array(fitted.diagnose(inject(log, [row], LAYOUT)), stamp=100.0),
        stale_array(LAYOUT, stamp=101.5),
    ]
    write_diagnostics(tmp_path / "bag", arrays)
    assert "version: 8" in (tmp_path / "bag" / "metadata.yaml").read_text()
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with rosbag2.Reader(tmp_path / "bag") as reader:
        read = [
            (c.topic, at, store.deserialize_cdr(data, c.msgtype))
            for c, at, data in reader.messages()
        ]
    assert [(topic, at) for topic, at, _ in read] == [
        ("/diagnostics", 100 * 10**9),
        ("/diagnostics", 1015 * 10**8),
    ]
    for (_, _, message), wanted in zip(read, arrays, strict=True):
        for status, expected in zip(message.status, wanted["status"], strict=True):
            assert (status.level, status.name, status.message) == (
                expected["level"],
                expected["name"],
                expected["message"],
            )
            assert [{"key": p.key, "value": p.value} for p in status.values] == expected["values"]
    with pytest.raises(ValueError, match="exists already"):
        write_diagnostics(tmp_path / "bag", arrays)


def test_writing_without_rosbags_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(ValueError, match="adaptfault-viewers\\[ros\\]"):
        write_diagnostics(tmp_path / "bag", [stale_array(LAYOUT)])


PACKAGE = Path(__file__).parents[2] / "examples" / "ros2"


def test_the_node_takes_its_array_from_its_parameters(tmp_path):
    given = Parameters(layout="2x6x5", full_scale=3.3, unit="V", rate=50.0)
    assert sensor_of(given).layout == SensorLayout(2, 6, 5, full_scale=3.3, unit="V", rate=50)
    (tmp_path / "layout.json").write_text(json.dumps(LAYOUT.to_dict()))
    assert sensor_of(Parameters(layout=str(tmp_path / "layout.json"))).layout == LAYOUT
    with pytest.raises(ValueError, match="give the parameter bundle, or the parameter layout"):
        sensor_of(Parameters())
    with pytest.raises(ValueError, match=f"frames of 7 values come, expected {LAYOUT.n_cells}"):
        watch_of(SelfDiagnosis(LAYOUT)).put(np.zeros(7))


@pytest.mark.parametrize(
    ("given", "read"),
    [
        (["-p", "unit:=N"], ["-p", 'unit:="N"']),
        (["--param", "left:layout:=10"], ["--param", 'left:layout:="10"']),
        (["-p", "restored:="], ["-p", 'restored:=""']),
        (["-p", "unit:='y'", "-p", "rate:=31"], ["-p", "unit:='y'", "-p", "rate:=31"]),
        (["-r", "unit:=N", "-p", "other:=N"], ["-r", "unit:=N", "-p", "other:=N"]),
        (["--", "-p", "unit:=N"], ["--", "-p", "unit:=N"]),
    ],
)
def test_text_on_the_command_line_is_put_in_quotes_where_text_is_expected(given, read):
    assert quoted(["node", "--ros-args", *given]) == ["node", "--ros-args", *read]


def test_values_of_other_types_are_converted_and_refused_where_that_is_impossible():
    assert Parameters.from_values({"unit": False}).unit == "N"  # unit: N in a parameter file
    assert Parameters.from_values({"unit": 1, "layout": 10}) == Parameters(unit="1", layout="10")
    assert Parameters.from_values(
        {"full_scale": 5, "rate": "31", "autostart": 0, "name": None}
    ) == Parameters(full_scale=5.0, rate=31.0, autostart=False)
    for name, value in {
        "unit": True,
        "topic": False,
        "layout": [2, 6],
        "rate": True,
        "full_scale": -1.0,
    }.items():
        with pytest.raises(ValueError, match=f"parameter {name}: "):
            Parameters.from_values({name: value})
    with pytest.raises(ValueError, match="parameter autostart: 'N' is neither true nor false"):
        Parameters.from_values({"autostart": "N"})


def test_the_launch_file_and_the_package_name_the_parameters_and_packages_of_the_node():
    launch = (PACKAGE / "launch" / "tactile.launch.py").read_text()
    listed = re.findall(r'^    "(\w+)": \("(.*)", (\w+)\)', launch, re.MULTILINE)
    assert {name: kind for name, _, kind in listed} == {
        name: type(v).__name__ for name, v in DEFAULTS.items()
    }
    assert Parameters.from_values({name: value for name, value, _ in listed}) == Parameters()
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert (PACKAGE / "resource" / package.findtext("name")).is_file()
    imported = set()
    for name in ("node.py", "messages.py"):
        code = (Path(parameters.__file__).parent / name).read_text()
        imported |= set(re.findall(r"^ *from (\w+)\.msg import", code, re.MULTILINE))
    assert "diagnostic_msgs" in imported
    assert imported <= {one.text for one in package.findall("exec_depend")}


def watch_of(diagnoser, clock=lambda: 1000.0, **sensor) -> Watch:
    return Watch(
        Sensor(diagnoser, **{"known": FaultSet((), diagnoser.layout.n_cells), **sensor}),
        clock=clock,
    )


def take(watch: Watch, frame: np.ndarray) -> None:
    watch.put(frame)
    watch.work()


def test_silence_is_a_warning_before_the_first_frame_then_stale_and_ends_with_a_frame(log):
    now = [1000.0]
    watch = watch_of(SelfDiagnosis(LAYOUT), clock=lambda: now[0])
    assert set(levels(watch.diagnostics(5.0)).values()) == {Level.WARN}
    assert watch.diagnostics(5.0)["status"][0]["message"] == "no frame yet"
    now[0] += 6
    assert set(levels(watch.diagnostics(5.0)).values()) == {Level.STALE}
    take(watch, log[0])
    first = watch.diagnostics(5.0)
    assert set(levels(first).values()) == {Level.WARN}
    assert first["status"][0]["message"] == "the first frames are being evaluated"
    for frame in log[1:60]:
        take(watch, frame)
        now[0] += 0.1
    assert set(levels(watch.diagnostics(5.0)).values()) == {Level.OK}
    assert watch.diagnostics(1004.25)["header"]["stamp"] == {"sec": 1004, "nanosec": 250_000_000}
    now[0] += 5
    stale = watch.diagnostics(5.0)
    assert set(levels(stale).values()) == {Level.STALE}
    assert stale["status"][0]["message"] == "no frame for 5 s"
    take(watch, log[60])
    assert set(levels(watch.diagnostics(5.0)).values()) == {Level.OK}


def test_frames_below_the_declared_rate_are_a_warning_of_the_stream_and_a_slow_sensor_is_not_stale(
    log,
):
    now = [1000.0]
    watch = watch_of(SelfDiagnosis(LAYOUT), clock=lambda: now[0])
    for frame in log[:60]:
        take(watch, frame)
        now[0] += 0.2
    found = watch.diagnostics(5.0)
    assert {name for name, level in levels(found).items() if level} == {"stream"}
    assert found["status"][-1]["message"] == "5 frames a second, 10 are declared"
    slow = watch_of(SelfDiagnosis(replace(LAYOUT, rate=0.5)), clock=lambda: now[0])
    for frame in log[:60]:
        take(slow, frame)
        now[0] += 2.0
    now[0] += 5.0
    assert set(levels(slow.diagnostics(5.0)).values()) == {Level.OK}


def test_frames_of_another_sensor_are_told_as_such():
    watch = watch_of(SelfDiagnosis(LAYOUT))
    with pytest.raises(ValueError, match="frames of 7 values"):
        watch.put(np.zeros(7))
    assert watch.diagnostics(5.0)["status"][0]["message"] == "frames of 7 values come, expected 220"


def test_frames_that_wait_to_be_monitored_are_counted_where_too_many_wait(log):
    watch = watch_of(SelfDiagnosis(LAYOUT))
    assert watch.work() == ()
    for frame in np.resize(log, (WAITING + 2, 220)):
        watch.put(frame)
    assert watch.queue.left_out == 2


def test_frames_are_restored_and_no_status_is_stale_while_the_monitor_is_busy(
    fitted, grasps, log, monkeypatch
):
    now = [1000.0]
    known = FaultSet((115,), LAYOUT.n_cells)
    restorer = Restorer(LAYOUT).fit(grasps.frames[::7])
    watch = watch_of(fitted, clock=lambda: now[0], known=known, restorer=restorer)
    for frame in log[:60]:
        take(watch, frame)
    begun = threading.Event()
    goes_on = threading.Event()
    fault = Fault("short", (7,), probability=1.0)

    def busy(*frame: object) -> tuple[Fault, ...]:
        begun.set()
        assert goes_on.wait(60)
        return (fault,)

    monkeypatch.setattr(watch.monitor, "update", busy)
    told = []
    thread = threading.Thread(target=watch.work_on, args=[told.append])
    thread.start()
    watch.put(log[60])
    assert begun.wait(60)
    for frame in log[61:90]:
        now[0] += 0.5  # a diagnosis of 15 s
        assert watch.restore(frame)[3] == frame[3]
        watch.put(frame)
        assert Level.STALE not in levels(watch.diagnostics(5.0)).values()
    assert not told
    watch.end()
    goes_on.set()
    thread.join(60)
    assert told == [fault]
    assert set(watch.repair.fault_set) == {7, 115}


def test_a_frame_that_is_monitored_while_a_version_changes_tells_nothing_of_the_new_one(
    fitted, log, monkeypatch
):
    watch = watch_of(fitted)
    other = replace(watch.sensor, parts={"model": "other"})

    def switched(*frame: object) -> tuple[Fault, ...]:
        watch.switch(other)
        return (Fault("short", (7,), probability=1.0),)

    monkeypatch.setattr(watch.monitor, "update", switched)
    watch.put(log[0])
    assert watch.work() == ()
    assert not watch.faulty.any()


def part(*values: float, of: str) -> Part:
    return Part(np.array(values), of)


def of_each(frame: list[Part]) -> list[str | None]:
    return [one.message for one in frame]


def test_messages_of_several_topics_become_frames_and_a_topic_that_fails_is_missing_in_them():
    rounds = Rounds(2)
    assert rounds.silent == []
    assert rounds.add(0, part(1, 2, of="a1")) == []
    assert rounds.silent == [1]
    assert rounds.add(0, part(3, 4, of="a2")) == []  # the size of the other one is unknown
    (frame,) = rounds.add(1, part(5, of="b1"))
    assert of_each(frame) == ["a2", "b1"]
    assert rounds.silent == []
    assert rounds.add(1, part(6, of="b2")) == []
    (late,) = rounds.add(1, part(7, of="b3"))
    assert of_each(late) == [None, "b2"]
    np.testing.assert_array_equal(late[0].values, [np.nan, np.nan])
    (both,) = rounds.add(0, part(8, 9, of="a3"))
    assert of_each(both) == ["a3", "b3"]


def test_a_misspelt_parameter_is_refused_and_a_foreign_one_is_named():
    with pytest.raises(ValueError, match="parameter bundel: there is none; did you mean bundle"):
        unknown(["topic", "bundel"])
    assert unknown([*DEFAULTS, "use_sim_time", "qos_overrides./tactile.depth"]) == []
    (told,) = unknown(["camera_info_url"])
    assert told.startswith("parameter camera_info_url is not used; there are topic, ")


def test_each_of_several_topics_has_its_restored_one():
    assert Parameters(topic="/skin").restored_topics == ("/tactile/restored",)
    several = Parameters.from_values({"topic": ["/f/0", "/f/1"]})
    assert several == Parameters(topic="/f/0, /f/1".replace(" ", ""))
    assert several.topics == ("/f/0", "/f/1")
    assert several.restored_topics == ("/f/0/restored", "/f/1/restored")
    assert replace(several, restored="").restored_topics == ()
    with pytest.raises(ValueError, match="restored names 1 topics, topic 2: name one for each"):
        _ = replace(several, restored="/whole").restored_topics


@pytest.mark.usefixtures("seldom_evaluated")
def test_the_node_restores_known_faults_and_those_that_its_monitor_finds(fitted, grasps, log):
    known = FaultSet((115,), LAYOUT.n_cells)
    watch = watch_of(fitted, known=known, restorer=Restorer(LAYOUT).fit(grasps.frames[::7]))
    row = line_fault(LAYOUT, Line(1, "row", 5), FaultKind.SHORT)
    broken = inject(log, [row], LAYOUT)
    first = watch.restore(broken[0])
    assert np.flatnonzero(first != broken[0]).tolist() in ([], [115])
    assert first[row.cells[0]] == broken[0, row.cells[0]]
    for frame in broken:
        take(watch, frame)
    whole = np.array([watch.restore(frame) for frame in broken])
    cells = list(row.cells)
    others = np.setdiff1d(np.arange(LAYOUT.n_cells), [*watch.repair.fault_set])
    assert set(cells) <= set(watch.repair.fault_set)
    np.testing.assert_array_equal(whole[:, others], broken[:, others])
    assert ((whole - log)[:, cells] ** 2).mean() < 0.1 * ((broken - log)[:, cells] ** 2).mean()
    watch.switch(replace(watch.sensor, known=FaultSet((3,), LAYOUT.n_cells)))
    assert {3, *cells} <= set(watch.repair.fault_set)


def test_the_node_converts_counts_with_the_calibration_of_the_bundle_and_restored_values_back(
    grasps,
):
    layout = grasps.layout
    calibration = Calibration(np.tile([100.0, 1100.0], (220, 1)), np.tile([0.0, 5.0], (220, 1)))
    restorer = Restorer(layout).fit(grasps.frames[::7])
    known = FaultSet((7,), 220)
    plain = watch_of(SelfDiagnosis(layout), restorer=restorer, known=known)
    raw = watch_of(SelfDiagnosis(layout), restorer=restorer, known=known, calibration=calibration)
    frame = grasps.frames[3][20].astype(float)
    counts = 100 + 200 * frame
    whole = raw.restore(counts)
    np.testing.assert_array_equal(np.delete(whole, 7), np.delete(counts, 7))
    np.testing.assert_allclose(
        whole[7], 100 + 200 * np.clip(plain.restore(frame)[7], 0, 5), rtol=1e-4
    )


def test_the_node_restores_nothing_without_a_bundle_or_a_frame_of_its_sensor(made_bundle):
    assert sensor_of(Parameters(layout="2x6x5")).restorer is None
    assert sensor_of(Parameters(bundle=str(made_bundle), restored="")).restorer is None
    assert watch_of(SelfDiagnosis(LAYOUT)).restore(np.zeros(220)) is None
    watch = Watch(sensor_of(Parameters(bundle=str(made_bundle))))
    assert watch.restore(np.zeros(7)) is None
    assert watch.restore(np.full(60, 1e30)).shape == (60,)
    with pytest.raises(ValueError, match="the bundle states unit"):
        sensor_of(Parameters(bundle=str(made_bundle), unit="V"))


def test_the_node_puts_exchanged_wires_back_as_the_version_that_the_bundle_runs(
    bundle, small_grasps
):
    follower = Follower(BundleAt(bundle.path).sensor, bundle.path)
    watch = Watch(follower.sensor)
    rows = bundle.layout.grid(np.arange(bundle.layout.n_cells)).copy()
    rows[0, [1, 4]] = rows[0, [4, 1]]
    wired = rows.ravel()
    healthy = bundle.parts.adapter().adapt(FaultSet((), wired.size), method="fill")
    assert follower.poll() is None
    bundle.deploy(bundle.write_version(healthy, {"source": np.argsort(wired).tolist()}).number)
    assert follower.poll() is None  # a thread loads it
    follower.reload.thread.join()
    watch.switch(follower.poll())
    assert watch.sensor.restorer is not None
    np.testing.assert_array_equal(watch.sensor.version.source, np.argsort(wired))
    row = line_fault(bundle.layout, Line(0, "row", 1), FaultKind.SHORT)
    frames = inject(np.concatenate(small_grasps.frames[::3]).astype(float), [row], bundle.layout)
    for frame in frames[:, wired]:
        take(watch, frame)
    assert np.flatnonzero(watch.faulty).tolist() == list(row.cells)
    others = np.flatnonzero(~watch.faulty)
    np.testing.assert_array_equal(watch.restore(frames[5][wired])[others], frames[5][others])


def test_a_scan_of_the_read_out_is_evidence_of_the_node(small_grasps):
    layout = small_grasps.layout
    now = [1000.0]
    restorer = Restorer(layout).fit(small_grasps.frames[::7])
    watch = watch_of(SelfDiagnosis(layout), clock=lambda: now[0], restorer=restorer)
    frame = np.zeros(layout.n_cells)
    for _ in range(100):
        take(watch, frame)
    idle = np.full(layout.n_cells, 0.01)
    scan = scan_circuit(Circuit(layout, faults=(StuckCell(33, np.inf),)), idle, repeats=5)
    for level, values in zip(scan.levels, scan.readings, strict=True):
        watch.scan(level, values)
    watch.diagnostics(5.0)
    assert watch.read_out is None  # it may go on
    now[0] += 2.1
    take(watch, frame)
    told = levels(watch.diagnostics(5.0))
    assert [fault.cells for fault in watch.read_out.faults] == [(33,)]
    assert Level.WARN in told.values()
    assert watch.repair.fault_set == FaultSet((33,), layout.n_cells)
    with pytest.raises(ValueError, match="a frame of a scan has level 2 and 7 values, expected 0"):
        watch.scan(2.0, np.zeros(7))


def test_a_bundle_that_can_no_longer_be_read_leaves_the_node_as_it_is(bundle, caplog):
    follower = Follower(BundleAt(bundle.path).sensor, bundle.path)
    bundle.deploy(1)
    for file in bundle.path.glob("bundle*.json"):
        file.unlink()
    assert follower.poll() is None
    follower.reload.thread.join()
    assert follower.poll() is None
    assert "all goes on as before" in caplog.text


def test_values_are_written_into_the_arrays_of_a_message_in_their_type():
    pad = SimpleNamespace(values=array("H", [1, 2]))
    message = SimpleNamespace(pads=[pad, SimpleNamespace(values=np.zeros(1, "u1"))])
    arrays = arrays_at(message, "pads.values")
    np.testing.assert_array_equal(join(arrays, np.float64), [1, 2, 0])
    put(arrays, np.array([3.6, -1.0, 300.0]))
    assert pad.values.tolist() == [4, 0]
    assert message.pads[1].values.tolist() == [255]


@pytest.mark.parametrize(
    ("encoding", "dtype"), [("mono16", "u2"), ("16SC1", "i2"), ("32FC1", "f4"), ("8UC2", "u1")]
)
@pytest.mark.parametrize("big", [False, True])
def test_an_image_gives_its_pixels_without_the_padding_of_its_rows(encoding, dtype, big):
    pixels = np.arange(8, dtype=np.dtype(dtype).newbyteorder(">" if big else "<")).reshape(2, 4)
    width = 2 if encoding.endswith("2") else 4
    step = 4 * pixels.itemsize + 3
    data = array("B", b"".join(row.tobytes() + b"xyz" for row in pixels))
    image = SimpleNamespace(
        height=2, width=width, encoding=encoding, is_bigendian=int(big), step=step, data=data
    )
    np.testing.assert_array_equal(join(arrays_at(image, "data"), np.float64), np.arange(8))
    image.height = 3
    with pytest.raises(ValueError, match="do not fit"):
        arrays_at(image, "data")
    image.encoding = "rgb8"
    assert arrays_at(image, "data")[0].tolist() == data.tolist()


def test_importing_the_package_imports_no_ros():
    code = "import sys, adaptfault, adaptfault.ros2.sensor; assert 'rclpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
