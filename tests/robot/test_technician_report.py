"""The commands around a bundle: maintain, history, report, rollback; and the page that the
technician opens."""

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import power_cut
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.journal import Entry
from adaptfault.bundle.parts import Parts
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.robot.maintenance import maintain
from adaptfault.robot.technician_report import robot_name, write_report
from diagnostics import SensorLayout, inject

LAYOUT = SensorLayout(2, 6, 5)


@pytest.fixture
def log(later_grasps, broken_row, tmp_path) -> Path:
    frames = tuple(inject(r, [broken_row], LAYOUT) for r in later_grasps)
    save_npz(tmp_path / "log.npz", Recordings(frames, LAYOUT))
    return tmp_path / "log.npz"


def told(capsys, *args: object) -> tuple[int, str]:
    code = main([str(arg) for arg in args])
    return code, capsys.readouterr().out


def test_the_commands_of_a_bundles_life(bundle, log, capsys, tmp_path):
    page = tmp_path / "report.html"
    counted = ("--count-from", 1)
    code, out = told(capsys, "maintain", bundle.path, log, "--quiet", "--report", page, *counted)
    assert code in (1, 2)
    first = out.splitlines()[0]
    assert re.fullmatch(
        r"ADAPTFAULT (WARNING|CRITICAL) - deployed: .* \| faulty=5;;;0;60 accuracy=[01]\.\d+;;;0;1",
        first,
    )
    assert "pad 2, row 3 is short" in out
    assert "pad 2, row 3 is short" in page.read_text()
    assert page.read_text().count("Pads, rows and columns count from 1.") == 1
    told(capsys, "report", bundle.path, "--out", page)
    assert "pad 1, row 2 is short" in page.read_text()
    assert page.read_text().count("Pads, rows and columns count from 0.") == 1
    told(capsys, "report", bundle.path, "--out", page, *counted)
    assert "pad 2, row 3 is short" in page.read_text()

    code, out = told(capsys, "history", bundle.path)
    assert (
        out.splitlines()[0]
        == "version 2, without 5 of 60 cells runs, on probation, started 0 times"
    )
    assert "on probation" not in told(capsys, "history", bundle.path, "--confirm")[1]
    history = json.loads(told(capsys, "history", bundle.path, "--json", "--last", "1")[1])
    assert [run["what"] for run in history["runs"]] == ["confirmed"]

    code, out = told(capsys, "rollback", bundle.path)
    assert (code, out.split(",")[0]) == (0, "running: version 1")
    assert main(["rollback", str(bundle.path)]) == 3
    assert "the first" in capsys.readouterr().err


def test_maintenance_says_what_is_wrong_with_its_input_in_one_line(bundle, capsys, tmp_path):
    (tmp_path / "empty.csv").write_text("")
    for args in (
        ("maintain", tmp_path / "no.bundle", tmp_path / "empty.csv"),
        ("maintain", bundle.path, tmp_path / "nothing"),
        ("maintain", bundle.path, tmp_path / "empty.csv"),
        ("maintain", bundle.path),
        ("history", tmp_path),
        ("report", tmp_path / "no.bundle"),
    ):
        try:
            code = main([str(arg) for arg in args])
        except SystemExit as end:
            code = end.code
        assert code == 3, args
        assert "Traceback" not in capsys.readouterr().err


def test_training_refuses_to_overwrite_a_bundle(bundle, log, capsys):
    assert main(["train", str(log), "--out", str(bundle.path), "--quiet"]) == 3


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.outside: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.outside += [v for k, v in attrs if k in ("src", "href") and not v.startswith("data:")]


def test_the_page_needs_nothing_else_and_escapes_what_it_shows(repaired, capsys, tmp_path):
    bundle = repaired
    bundle.journal.add(
        Entry(
            "2026-01-01T00:00:00+00:00",
            "kept",
            {"version": 2, "reason": "<script>alert(1)</script>"},
        )
    )
    code, out = told(capsys, "report", bundle.path, "--out", tmp_path / "sub" / "page.html")
    assert (code, out) == (0, f"report: {tmp_path / 'sub' / 'page.html'}\n")
    text = (tmp_path / "sub" / "page.html").read_text()
    links = Links()
    links.feed(text)
    assert links.outside == []
    assert "<script>" not in text
    assert text.count("data:image/png") == 2  # for wide and for narrow screens
    assert "version 2" in text


def test_a_page_of_a_bundle_that_was_never_maintained(bundle, tmp_path, capsys):
    assert told(capsys, "report", bundle.path, "--out", tmp_path / "page.html")[0] == 0
    text = (tmp_path / "page.html").read_text()
    assert "No maintenance run yet" in text
    assert "No faulty cell is known" in text


@pytest.mark.slow
def test_a_bundle_of_raw_counts_reads_raw_recordings(small_grasps, later_grasps, tmp_path, capsys):
    table = tmp_path / "table.csv"
    table.write_text("cell,raw,force\n" + "".join(f"{c},0,0\n{c},4095,5\n" for c in range(60)))
    for name, frames in (("grasps", small_grasps.frames[::2]), ("log", later_grasps)):
        raw = np.stack([np.rint(np.clip(r, 0, 5) * 819) for r in frames]).astype(np.uint16)
        extra = {"labels": small_grasps.labels[::2]} if name == "grasps" else {}
        np.savez(tmp_path / f"{name}.npz", frames=raw.reshape(len(raw), -1, 2, 6, 5), **extra)
    out = tmp_path / "raw.bundle"
    options = ["--calibration", str(table), "--epochs", "1", "--quiet"]
    assert main(["train", str(tmp_path / "grasps.npz"), "--out", str(out), *options]) == 0
    capsys.readouterr()
    code, text = told(capsys, "maintain", out, tmp_path / "log.npz", "--quiet")
    assert (code, "unchanged: no faulty cell" in text) == (0, True), text


def heading(page: Path) -> str:
    return re.search(r"<h1[^>]*>(.*?)</h1>", page.read_text(), re.DOTALL)[1]


def test_the_page_begins_with_the_verdict_the_robot_and_the_date(bundle, log, capsys, tmp_path):
    page = tmp_path / "page.html"
    told(capsys, "report", bundle.path, "--out", page)
    assert heading(page) == "Nothing to do"
    code, _ = told(capsys, "maintain", bundle.path, log, "--quiet", "--report", page)
    wanted = {1: "Watch: the faults are handled", 2: "Call a technician"}[code]
    assert heading(page) == wanted
    told(capsys, "report", bundle.path, "--out", page, "--name", "arm <7>")
    text = page.read_text()
    assert heading(page) == wanted
    assert "<b>arm &lt;7&gt;</b>; 20" in text
    order = [
        text.index(part)
        for part in ("<h1", "arm &lt;7&gt;</b>", "What to check, in this order", "History")
    ]
    assert order == sorted(order)
    assert "not handled" not in text


def test_after_a_rollback_the_page_and_the_command_name_the_faults_that_are_not_handled(
    repaired, log, capsys, tmp_path
):
    page = tmp_path / "page.html"
    bundle = repaired
    said = told(capsys, "rollback", bundle.path)[1]
    assert "not handled now: pad 1, row 2 is short" in said
    assert re.match(r"running: version 1, with all \d+ cells; version 2 is not deployed", said)
    told(capsys, "report", bundle.path, "--out", page)
    assert heading(page) == "Call a technician"
    assert "1 known fault is <b>not handled</b>: version 1 runs" in page.read_text()
    code, _ = told(capsys, "maintain", bundle.path, log, "--quiet", "--report", page)
    assert (code, heading(page)) == (2, "Call a technician")
    assert "not handled</b>" in page.read_text()


def test_the_page_of_a_dry_run_shows_what_the_run_found(bundle, log, capsys, tmp_path):
    page = tmp_path / "page.html"
    told(capsys, "maintain", bundle.path, log, "--quiet", "--dry-run", "--report", page)
    assert heading(page) in ("Watch: the faults are handled", "Call a technician")
    text = page.read_text()
    assert "a dry run, nothing was changed" in text
    assert "pad 1, row 2 is short" in text


def test_a_model_that_repairs_to_more_than_the_healthy_accuracy_is_shown_as_weak(
    bundle, broken_row, tmp_path
):
    measured = {
        "accuracy": 0.8,
        "fault_free_accuracy": 0.7,
        "exit_code": 1,
        "reason": "as good",
        "version": 1,
    }
    bundle.journal.add(Entry("2026-01-01T00:00:00+00:00", "kept", measured))
    assert "Weak base model" in write_report(tmp_path / "page.html", bundle).read_text()
    bundle.journal.add(Entry("2026-01-02T00:00:00+00:00", "kept", {**measured, "accuracy": 0.69}))
    assert "Weak base model" not in write_report(tmp_path / "page.html", bundle).read_text()


def test_a_model_at_chance_that_no_repair_helps_needs_a_person(
    linear_bundle, tmp_path, monkeypatch
):
    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    bundle = Bundle.open(tmp_path / "robot.bundle")
    windows = bundle.parts.check_windows()
    # as a model that names the wrong class throughout
    wrong = replace(windows, y=(windows.y + 1) % 3)
    monkeypatch.setattr(Parts, "check_windows", lambda parts: wrong)
    log = power_cut.broken_log()
    report = maintain(bundle, log)
    assert report.exit_code == 2
    assert report.reason.startswith(
        f"the model is at chance: accuracy {report.accuracy:.3f}, where always naming"
    )
    page = tmp_path / "page.html"
    write_report(page, bundle)
    assert heading(page) == "Call a technician"
    assert "The model is at chance" in page.read_text()
    assert maintain(bundle, power_cut.broken_log(10)).exit_code == 2


@pytest.mark.parametrize(("path", "name"), [("r7/robot.bundle", "r7"), ("arm-3.bundle", "arm-3")])
def test_a_robot_is_called_as_its_bundle_or_the_folder_of_it(path, name, tmp_path):
    assert robot_name(tmp_path / path) == name
