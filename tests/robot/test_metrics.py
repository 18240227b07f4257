"""--metrics of maintain, fleet maintain and listen: files that Prometheus's own parser reads."""

import json
import os
import socket
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import Station, format_packet
from adaptfault.acquisition.ordering import Frame
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Cause, Outcome
from adaptfault.fleet.summary import FleetReport
from adaptfault.robot.metrics import (
    HELP,
    FaultCount,
    PadCells,
    RobotMetrics,
    cells_by_pad,
    fault_counts,
    text_of,
    write_metrics,
)
from diagnostics import Diagnosis, Fault, Line, SensorLayout, inject

parser = pytest.importorskip("prometheus_client.parser")

SMALL = SensorLayout(2, 2, 3, present=np.arange(12) != 5)
ROW = Fault("open", (6, 7, 8), line=Line(1, "row", 0))


def read(text: str) -> dict[tuple, float]:
    """Samples by name and values of labels; each metric has its help and its type."""
    families = list(parser.text_string_to_metric_families(text))
    assert all(f.documentation == HELP[f.name] and f.type == "gauge" for f in families)
    samples = [sample for family in families for sample in family.samples]
    found = {(s.name.removeprefix("adaptfault_"), *s.labels.values()): s.value for s in samples}
    assert len(found) == len(samples)  # no two samples have one name
    return found


@pytest.fixture
def today(later_grasps, broken_row, tmp_path) -> Path:
    """Recordings with a broken row."""
    layout = SensorLayout(2, 6, 5)
    frames = tuple(inject(r, [broken_row], layout).astype(np.float32) for r in later_grasps)
    save_npz(tmp_path / "today.npz", Recordings(frames, layout))
    return tmp_path / "today.npz"


def test_cells_are_counted_by_pad_and_state():
    tested = ~np.isin(np.arange(12), [1, 10])
    diagnosis = Diagnosis(SMALL, (ROW,), np.zeros(12), tested, 10, 1)
    assert cells_by_pad(SMALL, [ROW, Fault("short", (1,))], diagnosis) == (
        PadCells(1, 4, 0),
        PadCells(3, 2, 1),
    )
    assert cells_by_pad(SMALL, [ROW]) == (PadCells(0), PadCells(3))


def test_single_cells_of_one_kind_are_one_sample():
    faults = [Fault("short", (1,)), ROW, Fault("short", (2,)), Fault("stuck", (3,))]
    assert fault_counts(faults) == (
        FaultCount("short", "", 2),
        FaultCount("open", "pad 1, row 0", 3),
        FaultCount("stuck", "", 1),
    )


def test_labels_with_any_character_come_back():
    name = 'hall "3"\\north\nrobot {7}, ü'
    found = read(text_of([RobotMetrics(name, 12.5, 1, faults=fault_counts([ROW]))]))
    assert found == {
        ("last_run_timestamp_seconds", name): 12.5,
        ("exit_code", name): 1,
        ("fault_info", name, "open", "pad 1, row 0", "3"): 1,
    }


def test_what_is_not_known_is_not_written():
    found = read(text_of([RobotMetrics("a", 1.0, 0, (PadCells(2), PadCells(0, 5, 1)), 0.5)]))
    assert found == {
        ("cells", "a", "0", "faulty"): 2,
        ("cells", "a", "1", "alive"): 5,
        ("cells", "a", "1", "faulty"): 0,
        ("cells", "a", "1", "untested"): 1,
        ("coverage_ratio", "a"): 0.5,
        ("last_run_timestamp_seconds", "a"): 1.0,
        ("exit_code", "a"): 0,
    }


def test_a_time_keeps_its_milliseconds():
    found = read(text_of([RobotMetrics("a", 1_764_316_800.123)]))
    assert found == {("last_run_timestamp_seconds", "a"): 1_764_316_800.123}


def test_metrics_are_replaced_in_one_step_and_readable_by_others(tmp_path):
    for time in (1.0, 2.0):
        write_metrics(tmp_path / "m.prom", [RobotMetrics("a", time)])
    assert [path.name for path in tmp_path.iterdir()] == ["m.prom"]
    assert read((tmp_path / "m.prom").read_text()) == {("last_run_timestamp_seconds", "a"): 2.0}
    if os.name == "posix":
        assert (tmp_path / "m.prom").stat().st_mode & 0o777 == 0o644


def test_maintain_tells_what_its_report_tells(bundle, today, tmp_path, capsys, broken_row):
    out = tmp_path / "m.prom"
    command = ["maintain", str(bundle.path), str(today), "--metrics", str(out), "--json", "--quiet"]
    code = main(command)
    told = json.loads(capsys.readouterr().out)
    found = read(out.read_text())
    name = tmp_path.name  # the bundle is called robot.bundle
    assert found["exit_code", name] == code
    assert found["accuracy_expected_ratio", name] == pytest.approx(told["accuracy"])
    states = ("alive", "faulty", "untested")
    counts = np.array([[found["cells", name, pad, state] for state in states] for pad in "01"])
    assert counts.sum(axis=1).tolist() == [30, 30]
    assert counts[:, 1].tolist() == [0, len(broken_row.cells)]
    (wire,) = [key for key in found if key[0] == "fault_info"]
    assert wire == ("fault_info", name, "short", "pad 1, row 2", "5")
    assert found["coverage_ratio", name] == pytest.approx(1 - counts[:, 2].sum() / 60)
    assert main(command) == code  # nothing new: the last accuracy, and no coverage
    again = read(out.read_text())
    assert again["accuracy_expected_ratio", name] == found["accuracy_expected_ratio", name]
    assert {key for key in found if key not in again} == {
        ("coverage_ratio", name),
        *(("cells", name, pad, state) for pad in "01" for state in ("alive", "untested")),
    }


def test_a_maintenance_that_fails_is_unknown(bundle, tmp_path, capsys):
    out = tmp_path / "m.prom"
    (tmp_path / "bad.csv").write_text("no,numbers\n")
    command = ["maintain", str(bundle.path), str(tmp_path / "bad.csv"), "--metrics", str(out)]
    assert main(command) == 3
    found = read(out.read_text())
    assert {name for name, *_ in found} == {"last_run_timestamp_seconds", "exit_code"}
    assert found["exit_code", tmp_path.name] == 3


def test_a_fleet_is_one_file(tmp_path):
    cells = Cause("short", None, None, 1)
    row = Cause("open", "pad 1, row 0", "row", 3)
    a = Outcome(
        Robot("a", "a.bundle", ("a",)),
        "deployed",
        1,
        "",
        accuracy=0.9,
        causes=(cells, row, cells),
        pads=(PadCells(2, 4, 0), PadCells(3, 2, 1)),
        coverage=0.75,
    )
    b = Outcome.error(Robot("b", "b.bundle", ("b",)), "damaged")
    began, ended = "1970-01-01T00:00:00+00:00", "1970-01-01T00:01:00+00:00"
    found = read(text_of(FleetReport((a, b), began, ended).metrics()))
    assert found["fault_info", "a", "short", "", "2"] == 1
    assert found["fault_info", "a", "open", "pad 1, row 0", "3"] == 1
    assert found["cells", "a", "1", "untested"] == 1
    assert (found["coverage_ratio", "a"], found["accuracy_expected_ratio", "a"]) == (0.75, 0.9)
    assert [found["exit_code", name] for name in "ab"] == [1, 3]
    assert [found["last_run_timestamp_seconds", name] for name in "ab"] == [60, 60]
    assert Outcome.from_dict(json.loads(json.dumps(a.to_dict()))) == a
    before = {k: v for k, v in a.to_dict().items() if k not in ("pads", "coverage")}
    assert Outcome.from_dict(before).pads == ()  # a ledger without them


def test_fleet_maintain_writes_the_file(monkeypatch, tmp_path, capsys):
    (tmp_path / "f.toml").write_text(
        '[[robots]]\nname = "a"\nbundle = "a.bundle"\nrecordings = "today"\n'
    )
    now = "2026-01-01T00:00:00+00:00"
    outcome = Outcome(Robot("a", "a.bundle", ("today",)), "unchanged", 0, "")
    monkeypatch.setattr(
        "adaptfault.fleet.run.maintain_fleet",
        lambda *fleet, **options: FleetReport((outcome,), now, now),
    )
    out = tmp_path / "m.prom"
    (tmp_path / "run").mkdir()
    command = ["fleet", "maintain", str(tmp_path / "f.toml"), "--out", str(tmp_path / "run")]
    assert main([*command, "--metrics", str(out)]) == 0
    assert read(out.read_text())["exit_code", "a"] == 0


def test_a_station_writes_when_faults_change(tmp_path, monkeypatch):
    """Its devices are the robots."""
    out = tmp_path / "m.prom"
    station = Station(SMALL, metrics=out, quiet=True, on_event=lambda event: None)
    frame = Frame("glove", 0.0, np.zeros(SMALL.n_cells))
    for news, known in [((), ()), ((ROW,), (ROW,)), ((), (ROW,))]:
        monkeypatch.setattr("diagnostics.Monitor.update", lambda *given, told=news: told)
        monkeypatch.setattr("diagnostics.Monitor.faults", property(lambda _, now=known: now))
        station._take(frame)
        assert out.exists() == bool(news)
        if news:
            found = read(out.read_text())
            assert found["cells", "glove", "1", "faulty"] == 3
            assert found["fault_info", "glove", "open", "pad 1, row 0", "3"] == 1
            assert ("exit_code", "glove") not in found
            out.unlink()


def test_listen_writes_at_its_end(tmp_path, once_bound, capsys):
    out = tmp_path / "m.prom"
    packets = [format_packet("a", i / 10, np.zeros(6)) for i in range(3)]

    def send(port: int) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            for data in packets:
                line.sendto(data, ("127.0.0.1", port))

    sending = once_bound(send)
    options = ["--shape", "1x2x3", "--port", "0", "--frames", "3", "--seconds", "60", "--quiet"]
    assert main(["listen", *options, "--metrics", str(out)]) == 0
    sending.join()
    assert read(out.read_text())["cells", "a", "0", "faulty"] == 0


def test_a_file_that_cannot_be_written_does_not_end_a_station(tmp_path):
    events = []
    station = Station(SMALL, metrics=tmp_path / "nowhere" / "m.prom", on_event=events.append)
    station._write_metrics()
    (event,) = events
    assert event.kind == "trouble"
    assert event.text.startswith("metrics are not written: ")


@pytest.mark.parametrize("name", ["m.txt", ""])
@pytest.mark.parametrize("command", ["maintain a b", "fleet maintain a", "listen --port 0"])
def test_a_name_that_no_collector_reads_is_refused(command, name, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([*command.split(), "--metrics", name])
    assert exit_.value.code == 3
    assert "expected a name that ends in .prom" in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_named(capsys):
    assert main(["listen", "--port", "0", "--metrics", "nowhere/m.prom"]) == 3
    assert "the folder nowhere is not there" in capsys.readouterr().err
