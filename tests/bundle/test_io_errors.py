"""Errors of single calls on files, of the journal and of locks: a robot goes on. The engine is
examples/disk/."""

import builtins
import errno
import io
import os
import shutil
import sqlite3
import threading
from contextlib import closing, contextmanager
from pathlib import Path

import io_errors
import numpy as np
import power_cut
import pytest

import adaptfault as af
from adaptfault.acquisition import Session
from adaptfault.acquisition.ordering import Frame
from adaptfault.bundle import journal as journal_module
from adaptfault.bundle import lock, reload, running
from adaptfault.bundle.checksummed_json import Damaged, reading
from adaptfault.bundle.journal import Entry
from adaptfault.bundle.lock import Busy, locked
from adaptfault.bundle.pointer import Pointer
from adaptfault.cli import main
from adaptfault.prediction import predictor
from adaptfault.prediction.inference import Inference
from diagnostics import FaultSet

WINDOW = np.zeros((1, 10, power_cut.LAYOUT.n_cells), np.float32)


@pytest.fixture
def carried(linear_bundle, tmp_path):
    """The folder of a bundle of a linear layer, to be changed."""
    return Path(shutil.copytree(linear_bundle, tmp_path / power_cut.NAME))


def deploy(path: Path, *cells: int) -> None:
    """Deploy a version that does without these cells."""
    bundle = af.Bundle.open(path)
    adaptation = bundle.parts.adapter().adapt(
        FaultSet(cells, bundle.layout.n_cells), method="fill", progress=False
    )
    bundle.deploy(bundle.write_version(adaptation, {}).number)


@contextmanager
def failing(file: Path, number: int):
    """Let every attempt to open a file for reading fail with an error, as on a worn SD card."""
    real = open

    def opened(path, mode="r", *args, **options):
        if not isinstance(path, int) and Path(path) == file and "r" in mode:
            raise OSError(number, os.strerror(number), str(path))
        return real(path, mode, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builtins, "open", opened)
        patch.setattr(io, "open", opened)
        yield


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_a_file_that_cannot_be_read_is_damaged_and_its_copy_or_an_earlier_version_serves(
    carried, number
):
    deploy(carried, 3)
    log = power_cut.broken_log()
    files = [
        *carried.glob("*.json"),
        *(carried / "parts" / "reference").iterdir(),
        *(carried / "versions" / "0002").iterdir(),
    ]
    assert len(files) == 9
    for file in files:
        with failing(file, number):
            started = af.Predictor.load(carried)
            assert started.version == (1 if "0002" in file.parts else 2), file
            assert started.predict(WINDOW).shape == (1,)
            assert started._monitor._diagnoser.reference_ is not None, file
            bundle = af.Bundle.open(carried)
            problems = bundle.problems(repair=False)
            assert len(problems) == 1, file
            assert f"{file} cannot be read: {os.strerror(number)}" in problems[0]
            if number == errno.EIO:
                assert af.maintain(bundle, log, dry_run=True).fault_set == set(
                    power_cut.ROW.cells
                ), file


def test_a_file_without_a_copy_that_cannot_be_read_is_one_line_of_error(carried, capsys, tmp_path):
    log = tmp_path / "log.npy"
    np.save(log, np.stack(power_cut.broken_log()))
    file = next((carried / "parts" / "adapter").glob("*.safetensors"))
    with failing(file, errno.EIO):
        assert main(["maintain", str(carried), str(log), "--quiet"]) == 3
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .endswith(f"{file} cannot be read: Input/output error")
    )
    assert main(["maintain", str(carried), str(log), "--quiet"]) in (1, 2)


@contextmanager
def held_by_another(path: Path):
    """Hold a lock as a process that was stopped."""
    release = threading.Event()
    taken = threading.Event()

    def hold():
        with locked(path, patience=0):
            taken.set()
            release.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    taken.wait()
    yield
    release.set()
    thread.join()


@pytest.fixture
def impatient(monkeypatch):
    """Nobody waits for a lock in these tests."""
    monkeypatch.setattr(
        lock,
        "_wait_for",
        lambda descriptor, path, patience, wait=lock._wait_for: wait(descriptor, path, 0),
    )


@pytest.mark.parametrize("name", ["state.lock", "journal.lock", "maintenance.lock"])
def test_a_lock_that_a_stopped_process_holds_stops_no_prediction_and_no_dry_run(
    carried, impatient, name, caplog
):
    deploy(carried, 3)
    before = Pointer.read(carried)
    with held_by_another(carried / name):
        started = af.Predictor.load(carried)
        assert (started.version, len(started.predict(WINDOW))) == (2, 1)
        assert started.confirm() == (name != "state.lock")
        report = af.maintain(af.Bundle.open(carried), power_cut.broken_log(), dry_run=True)
        assert report.fault_set == set(power_cut.ROW.cells)
        if name == "state.lock":
            assert Pointer.read(carried) == before
            assert "this start is not counted" in caplog.text
            with pytest.raises(Busy, match=r"state\.lock is locked"):
                af.Bundle.open(carried).rollback()
    assert af.Predictor.load(carried).confirm()
    bundle = af.Bundle.open(carried)
    assert bundle.problems() == []
    assert "journal.pending.json" not in os.listdir(carried)
    assert [run["what"] for run in bundle.journal.runs()] == ["confirmed"]


def test_who_waits_for_a_lock_waits_for_two_seconds_at_most(monkeypatch, tmp_path):
    passed = [0.0]
    clock = type(
        "Clock",
        (),
        {"monotonic": lambda: passed[0], "sleep": lambda s: passed.__setitem__(0, passed[0] + s)},
    )
    monkeypatch.setattr(lock, "time", clock)
    with held_by_another(tmp_path / "a.lock"):
        with pytest.raises(Busy, match=r"a\.lock is locked"), locked(tmp_path / "a.lock"):
            pass
        assert passed[0] == pytest.approx(lock.PATIENCE, abs=0.05)
        with locked(tmp_path / "a.lock", needed=False):
            pass


def test_a_confirmation_while_another_program_holds_the_journal_counts_and_its_entry_waits(
    carried, monkeypatch
):
    monkeypatch.setattr(running, "_IN_LOOP", 0.0)
    deploy(carried, 3)
    bundle = af.Bundle.open(carried)
    # so that there is a journal
    bundle.journal.add(Entry("2026-01-01T00:00:00+00:00", "unchanged", {}))
    with closing(sqlite3.connect(carried / "journal.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert af.Predictor.load(carried).confirm()
        assert not Pointer.read(carried).probation
    assert [run["what"] for run in bundle.journal.runs()] == ["unchanged"]
    bundle.problems()
    assert [run["what"] for run in bundle.journal.runs()] == ["unchanged", "confirmed"]


def test_a_maintenance_run_while_another_program_holds_the_journal_ends_with_3_and_loses_nothing(
    carried, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(journal_module.Journal._connect.__wrapped__, "__defaults__", (0.0,))
    log = tmp_path / "log.npy"
    np.save(log, np.stack(power_cut.broken_log()))
    assert main(["maintain", str(carried), str(log), "--quiet"]) in (1, 2)
    (carried / "journal.sha256").unlink()
    with closing(sqlite3.connect(carried / "journal.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert main(["maintain", str(carried), str(log), "--quiet"]) == 3
    assert "journal.sqlite is held by another program" in capsys.readouterr().err
    assert not (carried / "journal.damaged.sqlite").exists()
    report = af.maintain(af.Bundle.open(carried), power_cut.broken_log())
    assert report.reason == "all recordings were used before"


def test_an_error_of_the_journal_is_no_end_of_a_session(carried, monkeypatch):
    deploy(carried, 3)
    watcher = af.Predictor.load(carried)

    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("adaptfault.bundle.checksummed_json.atomic_write", full)
    monkeypatch.setattr("adaptfault.acquisition.session.CONFIRMED_AFTER", 1)
    session = Session("hand", watcher)
    frames = np.concatenate(power_cut.broken_log())[:30]
    events = [
        event
        for i, f in enumerate(frames)
        for event in session.take(Frame("hand", i / 10, f), i / 10)
    ]
    assert [event.kind for event in events if event.kind in ("trouble", "confirmed")] == ["trouble"]
    monkeypatch.undo()
    assert watcher.confirm()


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), MemoryError("out of memory")]
)
def test_a_version_that_could_not_be_loaded_for_a_while_is_loaded_later(
    carried, monkeypatch, error, caplog
):
    monkeypatch.setattr(predictor, "_POLL", 0.0)
    monkeypatch.setattr(reload, "_RETRY", 0.0)
    real = Inference.load
    left = [2]

    def load(folder):
        if folder.name == "0002" and left[0]:
            left[0] -= 1
            raise error
        return real(folder)

    running = af.Predictor.load(carried)
    monkeypatch.setattr(Inference, "load", load)
    deploy(carried, 3)
    for _ in range(1000):
        running.predict(WINDOW)
        if running._reload.thread is not None:
            running._reload.thread.join()
        if running.version == 2:
            break
    assert running.version == 2
    assert caplog.text.count("version 2 could not be loaded") == 1


def test_a_start_that_fails_for_lack_of_files_does_not_count_against_the_version(
    carried, monkeypatch
):
    deploy(carried, 3)
    real = Inference.load
    left = [2]

    def load(folder):
        if left[0]:
            left[0] -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return real(folder)

    monkeypatch.setattr(Inference, "load", load)
    assert af.Predictor.load(carried).version == 2
    assert Pointer.read(carried).starts == 1


def test_recordings_whose_names_are_no_utf8_or_hold_escapes_are_journalled_and_printed_harmlessly(
    carried, tmp_path, capsys
):
    folder = tmp_path / "today"
    folder.mkdir()
    names = [os.fsdecode(b"caf\xe9.npy"), "\x1b[31mred.npy", "two\nlines.npy"]
    frames = power_cut.broken_log()
    for i, frame in enumerate(frames):
        np.save(folder / (names[i] if i < len(names) else f"{i}.npy"), frame)
    (folder / "\x1b]0;title.csv").write_text("no,recording\n")
    assert main(["maintain", str(carried), str(folder)]) in (1, 2)
    bundle = af.Bundle.open(carried)
    assert [run["what"] for run in bundle.journal.runs()] == ["deployed"]
    assert set(bundle.journal.runs()[0]["used"]) > {"caf\\udce9.npy", "\\x1b[31mred.npy"}
    assert af.maintain(bundle, frames, names=names).reason == "all recordings were used before"
    assert main(["history", str(carried)]) == 0
    assert main(["maintain", str(carried), str(tmp_path / "\x1b[2J.npy")]) == 3
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
    assert "\\x1b[2J.npy" in err


def test_an_error_that_passes_is_no_damage(tmp_path):
    with pytest.raises(OSError, match="Too many"), reading(tmp_path):
        raise OSError(errno.EMFILE, "Too many open files")
    with pytest.raises(Damaged, match="cannot be read"), reading(tmp_path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))


def tried(arguments: list[str], folder: Path) -> tuple[int, int]:
    """Return how many calls and failures there were; skips where there is no compiler."""
    try:
        done = io_errors.start_with_library(arguments, folder, capture_output=True)
    except OSError as error:
        pytest.skip(str(error))
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    words = done.stdout.splitlines()[-1].split()
    return int(words[0]), int(words[2])


def test_after_a_failed_call_on_any_file_a_robot_goes_on(tmp_path, linear_bundle):
    calls, failures = tried(["--sample", "1", "--bundle", str(linear_bundle)], tmp_path)
    assert calls > 1000
    assert failures == 7


@pytest.mark.slow
def test_after_every_failed_call_on_any_file_a_robot_goes_on(tmp_path):
    _, failures = tried(["--all"], tmp_path)
    assert failures > 5000
