"""Odd standard streams and too little memory: one line, and the exit code of what was done."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.pointer import Pointer
from adaptfault.cli import main
from adaptfault.cli.streams import one_line
from adaptfault.data.shortage import is_shortage

ROOT = Path(__file__).parents[2]
_CODE = """
import sys
sys.path[:0] = [{root!r}, {examples!r}]
import power_cut
from adaptfault.cli import main
with power_cut.small_versions():
    sys.exit(main(sys.argv[1:]))
"""
_WITHOUT_TORCH = """
import sys
sys.path[:0] = [{root!r}]
from adaptfault.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def robot(linear_bundle, tmp_path):
    """A bundle, and a log for which a version is deployed; its name is none of ASCII."""
    import shutil

    import power_cut

    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    np.save(tmp_path / "handschuh-ü.npy", np.stack(power_cut.broken_log()))
    return tmp_path


def run(folder: Path, *words: str, then: str = "", code: str = _CODE, **environment: str):
    """Run a command in a shell, whose end may be ``then``."""
    pytest.importorskip("torch")
    code = code.format(root=str(ROOT), examples=str(ROOT / "examples"))
    (folder / "command.py").write_text(code)
    line = f"'{sys.executable}' command.py {' '.join(words)} {then}"
    return subprocess.run(
        ["bash", "-c", line],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )


ODD = {
    "an encoding without the characters": ("", {"PYTHONIOENCODING": "ascii"}, 0),
    "closed": (">&-", {}, 0),
    "both closed": (">&- 2>&-", {}, 0),
    "all closed": ("<&- >&- 2>&-", {}, 0),
    "full": ("> /dev/full", {}, 1),
    "read by nobody, as stderr": ("2>&1 | true; exit ${PIPESTATUS[0]}", {}, 0),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "full" else pytest.mark.slow) for name in ODD],
)
def test_whatever_stdout_is_a_run_deploys_and_its_code_says_so(robot, name):
    then, environment, told = ODD[name]
    done = run(robot, "maintain robot.bundle handschuh-*.npy --quiet", then=then, **environment)
    assert Pointer.read(robot / "robot.bundle").active == 2, done.stderr
    assert done.returncode in (1, 2)
    assert "Traceback" not in done.stderr
    assert len(lines(done.stderr)) == told, done.stderr


def lines(err: str) -> list[str]:
    """Return the lines of stderr, but for the one about the export that the test leaves out."""
    return [line for line in err.splitlines() if "left out here" not in line]


def test_a_pipe_that_nobody_reads_any_more_is_quiet(robot):
    said = "history robot.bundle --json"
    done = run(robot, said, then="| true; exit ${PIPESTATUS[0]}", code=_WITHOUT_TORCH)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("what", "error", "told"),
    [
        ("write_report", OSError(28, os.strerror(28)), "[Errno 28] No space left on device"),
        ("write_report", MemoryError(), "not enough memory"),
        ("text", MemoryError(), "not enough memory"),
    ],
)
def test_what_fails_after_a_run_leaves_it_done_and_is_one_line(robot, capsys, what, error, told):
    import power_cut

    log = str(next(robot.glob("*.npy")))
    words = ["maintain", str(robot / "robot.bundle"), log, "--quiet"]
    with power_cut.small_versions(), pytest.MonkeyPatch.context() as patch:

        def full(*_, **__):
            raise error

        places = {
            "write_report": "adaptfault.robot.technician_report.write_report",
            "text": "adaptfault.robot.maintenance_report.MaintenanceReport.text",
        }
        patch.setattr(places[what], full)
        code = main([*words, "--report", str(robot / "report.html")])
    assert code in (1, 2)
    assert Pointer.read(robot / "robot.bundle").active == 2
    out, err = capsys.readouterr()
    assert lines(err) == [f"adaptfault maintain: error: {told}"]
    assert ("version 2" in out) == (what != "text")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 9 GiB"),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("std::bad_alloc"),
        RuntimeError("can't start new thread"),
        ImportError("libx.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
    ],
)
def test_too_little_memory_is_one_line_whichever_library_says_so(monkeypatch, capsys, error):
    assert is_shortage(error)
    assert one_line(error).startswith("not enough memory")
    caused = ValueError("outer")
    caused.__cause__ = error
    assert is_shortage(caused)

    def out_of_memory(*_, **__):
        raise error

    monkeypatch.setattr("adaptfault.cli.simulate.Simulate.stated_layout", out_of_memory)
    assert main(["simulate", "--out", "x.npz"]) == 3
    told = capsys.readouterr().err
    assert told.startswith("adaptfault simulate: error: not enough memory")
    assert told.count("\n") == 1


def test_other_errors_are_no_shortage():
    assert not is_shortage(RuntimeError("shape mismatch"))
    assert not is_shortage(OSError(28, "No space left on device"))
    assert not is_shortage(None)


def test_an_error_is_one_line_of_bounded_length():
    assert one_line(ValueError("a\n b\x1b[2J")) == "a b\\x1b[2J"
    assert len(one_line(ValueError("x" * 100_000))) < 3000


def test_what_nests_too_deep_is_one_line(monkeypatch, capsys):
    def deep(*_, **__):
        raise RecursionError("maximum recursion depth exceeded")

    monkeypatch.setattr("adaptfault.cli.simulate.Simulate.stated_layout", deep)
    assert main(["simulate", "--out", "x.npz"]) == 3
    assert capsys.readouterr().err.count("\n") == 1


def test_a_bundle_whose_journal_has_an_unreadable_checksum_is_maintained(robot, caplog):
    import power_cut

    path = robot / "robot.bundle"
    words = ["maintain", str(path), str(next(robot.glob("*.npy"))), "--quiet"]
    with power_cut.small_versions():
        main(words)
        (path / "journal.sha256").unlink()
        (path / "journal.sha256").mkdir()
        assert main(words) in (1, 2)
    assert [run["what"] for run in Bundle.open(path).journal.runs()] == ["deployed"]
    (path / "journal.sha256").rmdir()
    (path / "journal.sha256").write_bytes(b"\xff\xfe")
    assert "it is readable" in Bundle.open(path).problems()[0]
    assert Bundle.open(path).problems() == []


def test_a_command_that_opens_a_bundle_as_reference_needs_no_torch():
    code = "import sys, adaptfault.cli.trained_model; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_streams_that_were_replaced_stay_as_they_are(monkeypatch):
    told = io.StringIO()
    monkeypatch.setattr(sys, "stdout", told)
    main([])
    assert "COMMAND" in told.getvalue()
