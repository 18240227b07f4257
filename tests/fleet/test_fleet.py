import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import without_export

import adaptfault.fleet.run as running
import adaptfault.fleet.work as working
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.lock import Busy, locked
from adaptfault.cli import main
from adaptfault.data.json_lines import Lines
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.fleet.listing import Fleet, Robot
from adaptfault.fleet.outcome import Cause, Outcome
from adaptfault.fleet.run import maintain_fleet
from adaptfault.fleet.summary import FleetReport
from adaptfault.fleet.work import maintain_robot
from diagnostics import SensorLayout, inject

LAYOUT = SensorLayout(2, 6, 5)


@pytest.fixture(scope="module")
def farm(made_bundle, later_grasps, broken_row, tmp_path_factory) -> Path:
    """For dry runs: robot a is healthy, b has a short row, c a damaged bundle, d no usable
    recording."""
    home = tmp_path_factory.mktemp("farm")
    for name in "abcd":
        shutil.copytree(made_bundle, home / "robots" / name / "robot.bundle")
        (home / "robots" / name / "recordings").mkdir()
    rows = tuple(inject(r, [broken_row], LAYOUT).astype(np.float32) for r in later_grasps)
    healthy = tuple(r.astype(np.float32) for r in later_grasps)
    for name, frames in {"a": healthy, "b": rows, "c": healthy}.items():
        save_npz(home / "robots" / name / "recordings" / "log.npz", Recordings(frames, LAYOUT))
    (home / "robots" / "d" / "recordings" / "log.csv").write_text("no,numbers\n")
    for copy in (home / "robots" / "c" / "robot.bundle").glob("bundle*.json"):
        copy.write_text("{}")
    return home


@pytest.fixture(scope="module")
def fleet(farm) -> Fleet:
    (farm / "fleet.toml").write_text(
        'bundles = "robots/*/robot.bundle"\nrecordings = "{bundle_dir}/recordings"\n'
    )
    return Fleet.read(farm / "fleet.toml")


@contextmanager
def in_this_process() -> Iterator[None]:
    """Work on robots here; workers in processes of their own have tests that are slow, and those of
    fleet_workers."""
    with pytest.MonkeyPatch.context() as patch, without_export():
        patch.setattr(running, "engine", lambda task, **where: nullcontext(partial(map, task.work)))
        yield


@pytest.fixture
def here() -> Iterator[None]:
    with in_this_process():
        yield


@pytest.fixture(scope="module")
def sequential(fleet, tmp_path_factory) -> FleetReport:
    with in_this_process():
        return maintain_fleet(
            fleet, tmp_path_factory.mktemp("run"), jobs=1, dry_run=True, progress=False
        )


def told(report: FleetReport) -> dict:
    """The report without what no two runs share."""
    told = report.to_dict()
    del told["began"], told["ended"], told["seconds"]
    for outcome in told["outcomes"]:
        del outcome["seconds"]
    return told


def test_each_robot_ends_as_it_should_and_one_bad_robot_stops_no_other(sequential):
    a, b, c, d = sequential.outcomes
    assert [o.robot.name for o in sequential.outcomes] == list("abcd")
    assert (a.decision, a.exit_code, a.faulty, a.cells) == ("unchanged", 0, 0, 60)
    assert (b.decision, b.faulty) == ("deployed", 5)
    assert b.exit_code in (1, 2)
    assert b.causes == (Cause("short", "pad 1, row 2", "row", 5),)
    assert (c.decision, d.decision) == ("error", "error")
    assert "bundle.json" in c.reason
    assert "log.csv" in d.reason
    assert not any("\n" in o.reason for o in sequential.outcomes)
    assert sequential.counts == {
        "ok": 1,
        "degraded": b.exit_code == 1,
        "technician": b.exit_code == 2,
        "unknown": 2,
    }
    assert sequential.errors == (c, d)


@pytest.mark.slow
def test_two_workers_report_what_one_does(fleet, sequential, tmp_path):
    parallel = maintain_fleet(fleet, tmp_path, jobs=2, dry_run=True, progress=False)
    assert told(parallel) == told(sequential)


def test_a_robot_that_is_being_maintained_is_waited_for(fleet, tmp_path, monkeypatch):
    robot = replace(fleet.robots[0], bundle=str(tmp_path / "robot.bundle"))
    shutil.copytree(fleet.robots[0].bundle, robot.bundle)
    held = Bundle.open(robot.bundle).maintenance()
    held.__enter__()
    timer = threading.Timer(0.3, held.__exit__, (None, None, None))
    timer.start()
    assert maintain_robot(robot).decision == "unchanged"
    timer.join()
    with Bundle.open(robot.bundle).maintenance():
        monkeypatch.setattr(working, "_PATIENCE", 0)
        outcome = maintain_robot(robot)
    assert outcome.decision == "error"
    assert "being maintained by another process" in outcome.reason


@pytest.mark.slow
def test_two_workers_of_a_dask_cluster_report_what_one_process_does(fleet, sequential, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        report = maintain_fleet(
            fleet, tmp_path, dask=cluster.scheduler_address, dry_run=True, progress=False
        )
    assert told(report) == told(sequential)


@pytest.mark.usefixtures("here")
def test_a_fleet_is_maintained_through_the_command_line(
    made_bundle, later_grasps, tmp_path, capsys
):
    shutil.copytree(made_bundle, tmp_path / "r.bundle")
    save_npz(
        tmp_path / "log.npz", Recordings(tuple(r.astype(np.float32) for r in later_grasps), LAYOUT)
    )
    listed = (
        '[[robots]]\nname = "r"\nbundle = "r.bundle"\nrecordings = "*.npz"\ncommissioned ='
        " 2020-01-01\n"
    )
    (tmp_path / "f.toml").write_text(listed)
    arguments = [
        "fleet",
        "maintain",
        str(tmp_path / "f.toml"),
        "--jobs",
        "1",
        "--limit",
        "600",
        "--quiet",
    ]
    assert main(arguments) == 0
    assert capsys.readouterr().out.startswith(
        "ADAPTFAULT FLEET OK - 1 robot: 1 ok | ok=1;;;0;1 degraded=0"
    )
    assert len(Bundle.open(tmp_path / "r.bundle").journal.runs()) == 1
    # the run ended: this is a new one, with nothing new to see
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "adaptfault.fleet/1"
    assert "used before" in document["outcomes"][0]["reason"]
    assert document["ages"][0]["robots"] == 1
    assert json.loads((tmp_path / "f.fleet" / "report.json").read_text()) == document
    assert "need" in (tmp_path / "f.fleet" / "report.html").read_text()
    (tmp_path / "f.toml").write_text("")
    assert main(arguments) == 3
    assert "it lists no robot" in capsys.readouterr().err


# A killed run. These fake the workers: what is asked is who is worked on.


def robots(n: int) -> Fleet:
    return Fleet(tuple(Robot(f"r{i}", f"/r{i}/robot.bundle", (f"/r{i}/log",)) for i in range(n)))


@pytest.fixture
def worked(monkeypatch) -> list[str]:
    """Names of the robots that were worked on, in order."""
    names: list[str] = []

    def work(robots: list[Robot]) -> Iterator[Outcome]:
        for robot in robots:
            names.append(robot.name)
            yield outcome(robot)

    monkeypatch.setattr(running, "engine", lambda task, **where: nullcontext(work))
    return names


def outcome(robot: Robot, **changed: object) -> Outcome:
    return replace(
        Outcome(robot, "unchanged", 0, "no faulty cell", 1, 60, 0, "2 x 6 x 5"), **changed
    )


def half(folder: Path, fleet: Fleet) -> list[str]:
    """Maintain, then leave of the ledger what a kill half-way would have left: two robots and a
    part of the third."""
    maintain_fleet(fleet, folder, jobs=1, progress=False)
    ledger = folder / running.LEDGER
    lines = ledger.read_bytes().splitlines(keepends=True)
    ledger.write_bytes(b"".join(lines[:3]) + lines[3][:40])
    return [json.loads(line)["outcome"]["robot"]["name"] for line in lines[1:3]]


def test_a_killed_run_goes_on_and_does_nothing_twice(worked, tmp_path):
    fleet = robots(5)
    done = half(tmp_path, fleet)
    worked.clear()
    report = maintain_fleet(fleet, tmp_path, jobs=1, progress=False)
    assert sorted(worked + done) == ["r0", "r1", "r2", "r3", "r4"]
    assert [o.robot.name for o in report.outcomes] == ["r0", "r1", "r2", "r3", "r4"]


def test_a_run_that_ended_starts_anew(worked, tmp_path):
    maintain_fleet(robots(3), tmp_path, jobs=1, progress=False)
    maintain_fleet(robots(3), tmp_path, jobs=1, progress=False)
    assert sorted(worked) == ["r0", "r0", "r1", "r1", "r2", "r2"]


def test_a_killed_run_with_other_options_or_of_long_ago_starts_anew(worked, tmp_path):
    fleet = robots(4)
    half(tmp_path, fleet)
    worked.clear()
    maintain_fleet(fleet, tmp_path, jobs=1, dry_run=True, progress=False)
    assert len(worked) == 4
    half(tmp_path, fleet)
    ledger = Lines(tmp_path / running.LEDGER)
    head, *entries = ledger.read()
    ledger.begin(head)
    for entry in entries:
        ledger.add({**entry, "time": "2020-01-01T00:00:00+00:00"})
    worked.clear()
    maintain_fleet(fleet, tmp_path, jobs=1, progress=False)
    assert len(worked) == 4


def test_a_robot_that_moved_since_the_kill_is_done_again(worked, tmp_path):
    fleet = robots(4)
    done = half(tmp_path, fleet)
    worked.clear()
    moved = [replace(r, bundle="/elsewhere") if r.name == done[0] else r for r in fleet.robots]
    report = maintain_fleet(Fleet(tuple(moved)), tmp_path, jobs=1, progress=False)
    assert sorted(worked) == sorted({"r0", "r1", "r2", "r3"} - {done[1]})
    assert [o.robot for o in report.outcomes] == moved


def test_two_processes_do_not_maintain_the_same_fleet(worked, tmp_path):
    with locked(tmp_path / "run.lock", patience=0), pytest.raises(Busy, match="another process"):
        maintain_fleet(robots(1), tmp_path, jobs=1)


def test_workers_that_make_no_sense_are_refused(tmp_path):
    for options in ({"jobs": 0}, {"jobs": 2, "dask": "tcp://127.0.0.1:1"}):
        with pytest.raises(ValueError, match="expected at least 1"):
            maintain_fleet(robots(1), tmp_path, **options)
    for limit in (0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="expected seconds, more than 0"):
            maintain_fleet(robots(1), tmp_path, limit=limit)


# The report.

ROW = Cause("short", "pad 1, row 2", "row", 5)
COLUMN = Cause("open", "pad 0, column 1", "column", 6)
CELL = Cause("stuck", None, None, 1)


def report(*outcomes: Outcome) -> FleetReport:
    return FleetReport(outcomes, "2026-01-01T00:00:00+00:00", "2026-01-01T00:10:00+00:00")


@pytest.mark.parametrize(
    ("codes", "worst"), [([0, 0], 0), ([0, 1], 1), ([0, 1, 3], 3), ([3, 2, 0], 2)]
)
def test_the_exit_code_is_the_worst_and_a_technician_weighs_more_than_the_unknown(codes, worst):
    a, *_ = robots(1).robots
    assert report(*(outcome(a, exit_code=code) for code in codes)).exit_code == worst


def test_the_robot_with_the_least_accuracy_left_comes_first():
    r = robots(4).robots
    left = report(
        outcome(r[0], exit_code=2, faulty=9, accuracy=0.8, fault_free_accuracy=0.9),
        outcome(r[1], exit_code=2, faulty=5, accuracy=0.4, fault_free_accuracy=0.9),
        outcome(r[2], exit_code=1, faulty=9, accuracy=0.3, fault_free_accuracy=0.9),
        outcome(r[3], exit_code=2, faulty=60, decision="refused", reason="no healthy cell is left"),
    )
    assert [o.robot.name for o in left.technician] == ["r3", "r1", "r0"]
    assert "r1: 44% of the accuracy is left; 5 of 60 cells are faulty" in str(left)
    assert "r3: no healthy cell is left" in str(left)


def test_wires_are_counted_over_robots_of_the_same_skin():
    r = robots(4).robots
    counted = report(
        outcome(r[0], causes=(ROW, COLUMN, CELL, CELL)),
        outcome(r[1], causes=(ROW,)),
        outcome(r[2], causes=(ROW,), shape="1 x 9 x 9"),
        outcome(r[3]),
    )
    assert [(w.wire, w.kind, w.shape, w.robots, w.cells) for w in counted.wires] == [
        ("pad 1, row 2", "short", "2 x 6 x 5", 2, 10),
        ("pad 0, column 1", "open", "2 x 6 x 5", 1, 6),
        ("pad 1, row 2", "short", "1 x 9 x 9", 1, 5),
        ("single cells", "stuck", "2 x 6 x 5", 1, 2),
    ]
    assert counted.wires[0].share == pytest.approx(2 / 3)
    assert counted.families == {"row": 3, "single cells": 2, "column": 1}


def test_faults_are_told_by_whole_years_in_service():
    days = ("2025-12-31", "2023-06-01", "2023-02-01", None)
    r = [
        replace(robot, commissioned=day) for robot, day in zip(robots(4).robots, days, strict=True)
    ]
    ages = report(
        outcome(r[0]),
        outcome(r[1], faulty=11, causes=(ROW, COLUMN)),
        outcome(r[2], faulty=5, causes=(ROW,)),
        outcome(r[3], faulty=5, causes=(ROW,)),
    ).ages
    assert [(g.years, g.robots, g.degraded, g.wires, g.cells) for g in ages] == [
        (0, 1, 0, 0, 0),
        (2, 2, 2, 1.5, 8),
    ]
    assert (ages[0].worst, ages[1].worst) == (None, "pad 1, row 2 (2)")


def test_the_page_shows_what_robots_are_called_as_text(tmp_path):
    (robot,) = robots(1).robots
    page = report(
        outcome(replace(robot, name="<b>"), exit_code=2, faulty=5, causes=(ROW,))
    ).write_page(tmp_path / "page.html")
    assert "<td>&lt;b&gt;</td>" in page.read_text()
    assert "pad 1, row 2 short" in page.read_text()


def test_an_outcome_survives_the_way_through_json():
    (robot,) = robots(1).robots
    full = outcome(
        replace(robot, tags=("hall 3",)), causes=(ROW, CELL), notes=("left out",), accuracy=0.5
    )
    assert Outcome.from_dict(json.loads(json.dumps(full.to_dict()))) == full


# The list.


def listed(folder: Path, text: str) -> Fleet:
    (folder / "fleet.toml").write_text(text)
    return Fleet.read(folder / "fleet.toml")


def test_robots_are_listed_one_by_one_with_paths_relative_to_the_file(tmp_path):
    fleet = listed(
        tmp_path,
        '[[robots]]\nname = "a"\nbundle = "a/x.bundle"\nrecordings = ["a/*.npz", "/data/a"]\ntags ='
        ' ["hall"]\ncommissioned = 2025-03-01\n[[robots]]\nname = "b"\nbundle ='
        ' "../b.bundle"\nrecordings = "b"\n',
    )
    a, b = fleet.robots
    home = tmp_path.resolve()
    assert a == Robot(
        "a", f"{home}/a/x.bundle", (f"{home}/a/*.npz", "/data/a"), ("hall",), "2025-03-01"
    )
    assert (b.bundle, b.recordings) == (f"{home.parent}/b.bundle", (f"{home}/b",))


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("robots/*/robot.bundle", ["r1", "r2"]),
        ("*/*/robot.bundle", ["robots/r1", "robots/r2"]),
        ("robots/**/*.bundle", ["r1/robot", "r2/robot"]),
    ],
)
def test_a_pattern_names_robots_after_its_stars(tmp_path, pattern, names):
    home = tmp_path / "with [a] star*"
    for name in ("r1", "r2"):
        (home / "robots" / name / "robot.bundle").mkdir(parents=True)
        (home / "robots" / name / "recordings").mkdir()
    fleet = listed(home, f'bundles = "{pattern}"\nrecordings = "{{bundle_dir}}/recordings"\n')
    assert [r.name for r in fleet.robots] == names
    assert [r.bundle for r in fleet.robots] == [
        f"{home}/robots/{name}/robot.bundle" for name in ("r1", "r2")
    ]
    assert [r.paths() for r in fleet.robots] == [
        [f"{home}/robots/{name}/recordings"] for name in ("r1", "r2")
    ]


def test_a_pattern_of_recordings_is_looked_up_when_it_is_needed(tmp_path):
    robot = Robot("a", "a", (f"{tmp_path}/*.npz",))
    with pytest.raises(FileNotFoundError, match="no recording matches"):
        robot.paths()
    (tmp_path / "2.npz").touch()
    (tmp_path / "1.npz").touch()
    assert robot.paths() == [f"{tmp_path}/1.npz", f"{tmp_path}/2.npz"]


A = '[[robots]]\nname = "a"\nbundle = "a"\nrecordings = "a"\n'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("robots = [", "not a TOML file"),
        ("", "it lists no robot"),
        ("robots = 3", "`robots` is not an array of tables"),
        ('[[robots]]\nbundle = "a"', "robot 1: `name` is missing"),
        ('[[robots]]\nname = "a"\nrecordings = "a"', r"robot 1 \('a'\): `bundle` is missing"),
        ('[[robots]]\nname = "a"\nbundle = "a"', r"robot 1 \('a'\): `recordings` is missing"),
        (A + "bundel = 3", "unknown key bundel; expected bundle"),
        (A + 'commissioned = "2025"', "expected a date as 2025-03-01, without quotes"),
        (A + "tags = [3]", "`tags` is .3.; expected text"),
        (A + A, "2 robots have the name 'a'"),
        (A + A.replace('name = "a"', 'name = "b"'), "2 robots have the bundle"),
        ('bundles = "x/*.bundle"', "`bundles` needs `recordings`"),
        ('bundles = "x/*.bundle"\nrecordings = "r"', "no bundle matches"),
        ('bundles = "*.toml"\nrecordings = "{folder}"', "expected only {bundle_dir} and {name}"),
        ('recordings = "r"\n' + A, "need `bundles`"),
    ],
)
def test_a_list_that_is_wrong_says_where(tmp_path, text, reason):
    with pytest.raises(ValueError, match=reason) as error:
        listed(tmp_path, text)
    assert "fleet.toml" in str(error.value)


def test_the_page_names_the_robots_that_need_somebody_worst_first(tmp_path):
    def named(name, **facts):
        return outcome(Robot(name, f"/{name}.bundle", ("/log",)), **facts)

    fleet = report(
        named("fine"),
        named("unknown", exit_code=3),
        named("half", exit_code=2, faulty=5, accuracy=0.4, fault_free_accuracy=0.8),
        named("blind", exit_code=2, faulty=60, accuracy=0.1, fault_free_accuracy=0.8),
        named("weak", exit_code=1, faulty=5, accuracy=0.9, fault_free_accuracy=0.8),
    )
    assert [o.robot.name for o in fleet.needy] == ["blind", "half", "unknown"]
    text = fleet.write_page(tmp_path / "page.html").read_text()
    assert "3 of 5 robots need somebody: blind, half, unknown</h1>" in text
    assert text.index("<td>blind") < text.index("<td>half") < text.index("<td>unknown")
    assert [o.robot.name for o in fleet.weak] == ["weak"]
    assert "weak base models, better repaired than healthy:\n  weak" in str(fleet)
    assert (
        "No robot needs anybody</h1>"
        in report(named("fine")).write_page(tmp_path / "page.html").read_text()
    )
