"""Diagnoses as ROS diagnostics: levels, names that stay, and bags that hold them."""

import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from adaptfault.acquisition import FrameRepair
from adaptfault.acquisition.ros import Level, diagnostic_array, stale_array, write_diagnostics
from adaptfault.imputation.restorer import Restorer
from diagnostics import Fault, FaultKind, FaultSet, Line, SelfDiagnosis, SensorLayout, inject, line_fault, lose_frames

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
    return {name.removeprefix("tactile: "): status["level"] for name, status in statuses(array).items()}


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
    found = next(f for f in fitted.diagnose(inject(log, [row], LAYOUT)).faults if f.line == row.line)
    array = diagnostic_array(replace(fitted.diagnose(log), faults=(found,)))
    two = levels(array)
    assert {name: level for name, level in two.items() if level} == {"pad 1": Level.ERROR, "pad 1 rows": Level.ERROR}
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
    assert all(isinstance(pair["value"], str) for status in array["status"] for pair in status["values"])
    values = {pair["key"]: pair["value"] for pair in statuses(array)["tactile: pad 0"]["values"]}
    assert values["faulty cells"] == "{1}.{2}".format(*LAYOUT.position(busy))


def test_what_is_written_into_a_bag_is_read_back(fitted, log, tmp_path):
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    row = line_fault(LAYOUT, Line(1, "row", 5), FaultKind.SHORT)
    arrays = [
        diagnostic_array(fitted.diagnose(inject(log, [row], LAYOUT)), stamp=100.0),
        stale_array(LAYOUT, stamp=101.5),
    ]
    write_diagnostics(tmp_path / "bag", arrays)
    assert "version: 8" in (tmp_path / "bag" / "metadata.yaml").read_text()
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with rosbag2.Reader(tmp_path / "bag") as reader:
        read = [(c.topic, at, store.deserialize_cdr(data, c.msgtype)) for c, at, data in reader.messages()]
    assert [(topic, at) for topic, at, _ in read] == [("/diagnostics", 100 * 10**9), ("/diagnostics", 1015 * 10**8)]
    for (_, _, message), array in zip(read, arrays, strict=True):
        for status, expected in zip(message.status, array["status"], strict=True):
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
    with pytest.raises(ValueError, match="adaptfault\\[ros\\]"):
        write_diagnostics(tmp_path / "bag", [stale_array(LAYOUT)])


PACKAGE = Path(__file__).parents[1] / "examples" / "ros2"


@pytest.fixture(scope="module")
def node():
    """The module of the ROS 2 node."""
    spec = importlib.util.spec_from_file_location("ros2_node", PACKAGE / "adaptfault_ros" / "node.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_message_of_the_node_fits_the_definitions_of_ros(node, log):
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    names = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    names += tuple(f"diagnostic_msgs/msg/{name}" for name in ("KeyValue", "DiagnosticStatus", "DiagnosticArray"))
    types = {name.rpartition("/")[2]: store.types[name] for name in names}
    watch = node.Watch(SelfDiagnosis(LAYOUT), clock=lambda: 1000.5)
    for frame in log[:40]:
        watch.take(frame)
    content = watch.diagnostics()
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    read = store.deserialize_cdr(store.serialize_cdr(node.message_of(content, types, int), kind), kind)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1000, 500_000_000)
    assert [(s.level, s.name, s.message) for s in read.status] == [
        (s["level"], s["name"], s["message"]) for s in content["status"]
    ]
    assert [{v.key: v.value for v in s.values} for s in read.status] == [
        {v["key"]: v["value"] for v in s["values"]} for s in content["status"]
    ]


def test_the_node_takes_its_array_from_its_parameters(node, tmp_path):
    given = {**node.DEFAULTS, "layout": "2x6x5", "full_scale": 3.3, "unit": "V", "rate": 50.0}
    assert node.diagnoser_of(given).layout == SensorLayout(2, 6, 5, full_scale=3.3, unit="V", rate=50)
    (tmp_path / "layout.json").write_text(json.dumps(LAYOUT.to_dict()))
    assert node.diagnoser_of({**node.DEFAULTS, "layout": str(tmp_path / "layout.json")}).layout == LAYOUT
    with pytest.raises(ValueError, match="give the parameter bundle, or the parameter layout"):
        node.diagnoser_of(node.DEFAULTS)
    with pytest.raises(ValueError, match=f"7 values, expected {LAYOUT.n_cells}"):
        node.Watch(SelfDiagnosis(LAYOUT)).take(np.zeros(7))


def test_the_launch_file_and_the_package_name_the_parameters_and_files_of_the_node(node):
    launch = (PACKAGE / "launch" / "tactile.launch.py").read_text()
    assert set(re.findall(r'^    "(\w+)": \(', launch, re.MULTILINE)) == set(node.DEFAULTS)
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert (PACKAGE / "resource" / package.findtext("name")).is_file()
    imported = set(re.findall(r"^    from (\w+)\.msg import", (PACKAGE / "adaptfault_ros/node.py").read_text(), re.M))
    assert imported <= {one.text for one in package.findall("exec_depend")}


def test_the_node_goes_stale_without_frames_and_comes_back(node, log):
    now = [1000.0]
    watch = node.Watch(SelfDiagnosis(LAYOUT), clock=lambda: now[0])
    assert set(levels(watch.diagnostics()).values()) == {Level.STALE}
    for frame in log[:40]:
        watch.take(frame)
        now[0] += 0.1
    assert set(levels(watch.diagnostics()).values()) == {Level.OK}
    assert watch.diagnostics()["header"]["stamp"]["sec"] == 1004
    now[0] += 5
    stale = watch.diagnostics()
    assert set(levels(stale).values()) == {Level.STALE}
    assert stale["status"][0]["message"] == "no frame for 5 s"
    watch.take(log[40])
    assert set(levels(watch.diagnostics()).values()) == {Level.OK}


def test_the_node_restores_known_faults_and_those_that_its_monitor_finds(node, fitted, grasps, log):
    repair = FrameRepair(Restorer(LAYOUT).fit(grasps.frames[::7]), FaultSet((115,), LAYOUT.n_cells))
    watch = node.Watch(fitted, clock=lambda: 1000.0, repair=repair)
    row = line_fault(LAYOUT, Line(1, "row", 5), FaultKind.SHORT)
    broken = inject(log, [row], LAYOUT)
    first = watch.restore(broken[0])
    assert np.flatnonzero(first != broken[0]).tolist() in ([], [115])
    assert first[row.cells[0]] == broken[0, row.cells[0]]
    for frame in broken:
        watch.take(frame)
    whole = np.array([watch.restore(frame) for frame in broken])
    cells, others = list(row.cells), np.setdiff1d(np.arange(LAYOUT.n_cells), [*repair.fault_set])
    assert set(cells) <= set(repair.fault_set)
    np.testing.assert_array_equal(whole[:, others], broken[:, others])
    assert ((whole - log)[:, cells] ** 2).mean() < 0.1 * ((broken - log)[:, cells] ** 2).mean()


def test_the_node_restores_nothing_without_a_bundle_or_a_frame_of_its_sensor(node, made_bundle):
    assert node.repair_of({**node.DEFAULTS, "layout": "2x6x5"}) is None
    assert node.repair_of({**node.DEFAULTS, "bundle": str(made_bundle), "restored": ""}) is None
    assert node.Watch(SelfDiagnosis(LAYOUT)).restore(np.zeros(220)) is None
    repair = node.repair_of({**node.DEFAULTS, "bundle": str(made_bundle)})
    watch = node.Watch(node.diagnoser_of({**node.DEFAULTS, "bundle": str(made_bundle)}), repair=repair)
    assert watch.restore(np.zeros(7)) is None
    assert len(watch.restore(np.full(60, 1e30))) == 60


def test_the_node_puts_exchanged_wires_back_as_the_version_that_the_bundle_runs(node, bundle, small_grasps):
    rows = bundle.layout.grid(np.arange(bundle.layout.n_cells)).copy()
    rows[0, [1, 4]] = rows[0, [4, 1]]
    wired = rows.ravel()
    healthy = bundle.parts.adapter().adapt(FaultSet((), wired.size), method="fill")
    bundle.deploy(bundle.write_version(healthy, {"source": np.argsort(wired).tolist()}).number)
    parameters = {**node.DEFAULTS, "bundle": str(bundle.path)}
    source = node.source_of(parameters)
    np.testing.assert_array_equal(source, np.argsort(wired))
    row = line_fault(bundle.layout, Line(0, "row", 1), FaultKind.SHORT)
    frames = inject(np.concatenate(small_grasps.frames[::3]).astype(float), [row], bundle.layout)
    repair = node.repair_of(parameters)
    watch = node.Watch(node.diagnoser_of(parameters), clock=lambda: 1000.0, repair=repair, source=source)
    for frame in frames[:, wired]:
        watch.take(frame)
    assert np.flatnonzero(watch.faulty).tolist() == list(row.cells)
    others = np.flatnonzero(~watch.faulty)
    np.testing.assert_array_equal(np.array(watch.restore(frames[5][wired]))[others], frames[5][others])
    assert node.source_of({**node.DEFAULTS, "layout": "2x6x5"}) is None
