"""Lets every call on the files of a bundle fail: io_errors.py [--all]

A library that is loaded before the C library (examples/disk/io_errors.c, LD_PRELOAD; Linux, needs
cc) counts the calls of a save, a maintenance run, a confirmation, a rollback, a start and a
recording, SQLite's own calls among them. Then each call fails in turn, once and from then on, with
each of EIO, ENOSPC, EROFS, EMFILE and EACCES that such a call may give. The operation must succeed
or end with an error that the command line reports in one line. Afterwards the bundle must open and
predict as one of its two versions, what was acknowledged must be there, no run may be lost from the
journal, and the next maintenance run must end right. Without ``--all`` a fixed-seed sample is
tried.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import functools
import hashlib
import itertools
import logging
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from power_cut import LAYOUT, NAME, ROW, make, predictions, small_versions
from power_cut import broken_log as simulated_log

SOURCE = Path(__file__).parent / "disk" / "io_errors.c"
# environment variable: the compiled library, in the process that tries the calls
LIBRARY = "IO_ERRORS_LIBRARY"
_LONGEST = 60  # seconds; a case that takes longer hangs

_READING = {errno.EIO, errno.EACCES, errno.EMFILE}
_CHANGING = {errno.EIO, errno.EROFS, errno.EACCES}
KINDS = {
    "a": ("open for reading", _READING),
    "b": ("open for writing", {errno.EIO, errno.ENOSPC, errno.EROFS, errno.EMFILE, errno.EACCES}),
    "c": ("read", {errno.EIO}),
    "d": ("write", {errno.EIO, errno.ENOSPC}),
    "e": ("fsync", {errno.EIO, errno.ENOSPC}),
    "f": ("truncate", {errno.EIO, errno.ENOSPC}),
    "g": ("rename, remove, chmod", _CHANGING),
    "h": ("stat, access", {errno.EIO, errno.EACCES}),
    "i": ("open a folder", _READING),
    "j": ("mkdir", _CHANGING | {errno.ENOSPC}),
}
"""Name and errors of each kind of call, by the letter that the library notes."""


broken_log = functools.cache(simulated_log)


@dataclass(frozen=True)
class Failure:
    """A call that fails.

    Attributes:
        at: number of the call in its operation.
        error: errno.
        from_then_on: whether all later calls that may give the error fail, too.
    """

    at: int
    error: int
    from_then_on: bool


@dataclass(frozen=True)
class Operation:
    """What is done to a bundle.

    Attributes:
        name: for the table.
        before: folder with the state before it.
        call: does it in a folder.
        versions: numbers of the versions that may run afterwards, the one after a success last.
        probation: whether that version is on probation after a success.
        runs: what the journal holds before it.
        adds: what a success adds to the journal.
        after: decisions that the next maintenance run with the broken row may make.
        may_add: what else the check, which starts a robot once more, may add to the journal.
    """

    name: str
    before: Path
    call: Callable[[Path], Any]
    versions: tuple[int, ...]
    probation: bool
    runs: tuple[str, ...] = ()
    adds: tuple[str, ...] = ()
    after: tuple[str, ...] = ("unchanged", "deployed")
    may_add: tuple[str, ...] = ()


def library() -> Any:
    """Return the library that is loaded in this process."""
    loaded = ctypes.CDLL(os.environ[LIBRARY])
    loaded.io_errors_seen.restype = ctypes.c_char_p
    return loaded


def arm(loaded: Any, folder: Path, failure: Failure | None) -> None:
    """Count the calls below a folder from now on, and let them fail."""
    if failure is None:
        loaded.io_errors_arm(os.fsencode(folder), -1, 0, 0, 0)
        return
    kinds = sum(
        1 << (ord(letter) - ord("a"))
        for letter, (_, errors) in KINDS.items()
        if failure.error in errors
    )
    loaded.io_errors_arm(
        os.fsencode(folder), failure.at, failure.error, int(failure.from_then_on), kinds
    )


def save(folder: Path) -> None:
    """Copy the parts of a bundle into a new one, as ``Bundle.create`` does."""
    import adaptfault as af

    source = af.Bundle.open(folder / "source.bundle")
    adapter = source.parts.adapter()
    check = source.parts.check_windows()
    classes = source.class_names
    af.Bundle.create(
        folder / NAME, adapter.model, adapter, source.diagnoser(), check=check, class_names=classes
    )


def maintain(folder: Path) -> None:
    """Run maintenance with a broken row."""
    import adaptfault as af

    report = af.maintain(af.Bundle.open(folder / NAME), broken_log(9))
    assert report.decision == "deployed", report


def confirm(folder: Path) -> None:
    """Start, as a robot does, and confirm."""
    import adaptfault as af

    if not af.Predictor.load(folder / NAME).confirm():
        raise OSError("it was not confirmed")


def rollback(folder: Path) -> None:
    """Return to the earlier version."""
    import adaptfault as af

    af.Bundle.open(folder / NAME).rollback()


def start(folder: Path) -> None:
    """Start and predict."""
    import adaptfault as af

    predictor = af.Predictor.load(folder / NAME)
    predictor.predict(np.zeros((1, 10, LAYOUT.n_cells), np.float32))


def dry_run(folder: Path) -> None:
    """Run maintenance that changes nothing."""
    import adaptfault as af

    af.maintain(af.Bundle.open(folder / NAME), broken_log(9), dry_run=True)


def record(folder: Path) -> None:
    """Write a recording."""
    from adaptfault.acquisition import Recorder

    with Recorder(folder / "today", LAYOUT, "hand", interval=0.0) as recorder:
        for i, frame in enumerate(
            np.round(np.random.default_rng(0).uniform(0, 5, (60, LAYOUT.n_cells)), 3)
        ):
            recorder.write(frame, i / LAYOUT.rate)


def operations(home: Path, bundle: Path | None) -> Iterator[Operation]:
    """Make the states before each operation, of a copy of ``bundle`` if there is one; see
    :func:`small_versions`."""
    import adaptfault as af

    def state(name: str) -> Path:
        shutil.copytree(home / "now", home / name)
        return home / name

    (home / "now").mkdir()
    if bundle is None:
        make(home / "now")
    else:
        shutil.copytree(bundle, home / "now" / NAME)
    (home / "empty").mkdir()
    shutil.copytree(home / "now" / NAME, home / "empty" / "source.bundle")
    yield Operation("save", home / "empty", save, (1,), False, after=("deployed",))
    first = state("first")
    yield Operation("maintain", first, maintain, (1, 2), True, adds=("deployed",))
    maintain(home / "now")
    deployed = state("deployed")
    # A start that fails counts: after two of them the earlier version runs.
    kept = ("unchanged", "kept", "deployed")
    yield Operation("start", deployed, start, (1, 2), True, ("deployed",), (), kept, ("rollback",))
    yield Operation("dry run", deployed, dry_run, (1, 2), True, ("deployed",))
    yield Operation("confirm", deployed, confirm, (1, 2), False, ("deployed",), ("confirmed",))
    af.Bundle.open(home / "now" / NAME).confirm()
    after = ("unchanged", "kept", "deployed")
    confirmed = state("confirmed")
    runs = ("deployed", "confirmed")
    yield Operation("rollback", confirmed, rollback, (2, 1), False, runs, ("rollback",), after)
    yield Operation("record", confirmed, record, (2,), False, runs, (), after)


def attempt(
    loaded: Any, operation: Operation, failure: Failure | None, place: Path
) -> tuple[bool, str]:
    """Do an operation in ``place`` while calls fail; return whether it succeeded, and the kinds of
    its calls.

    Raises:
        AssertionError: it ended with an error that no caller expects.
    """
    done = False
    shutil.copytree(operation.before, place)
    arm(loaded, place, failure)
    try:
        operation.call(place)
        done = True
    except (OSError, MemoryError, ValueError):  # what the command line reports in one line
        pass
    except Exception as error:
        raise AssertionError(f"it ended with {type(error).__name__}: {error}") from error
    finally:
        calls = loaded.io_errors_disarm()
    return done, loaded.io_errors_seen()[:calls].decode()


def check(operation: Operation, done: bool, place: Path, expected: dict[int, Any], x: Any) -> None:
    """Raise AssertionError where a robot does not go on from this state."""
    import adaptfault as af
    from adaptfault.bundle.pointer import Pointer

    path = place / NAME
    if operation.name == "save" and not path.exists():
        assert not done, "there is no bundle"
        save(place)
    if operation.name == "record":
        check_recording(done, place)
    pointer = Pointer.read(path)
    assert pointer.active in operation.versions, f"version {pointer.active} is active"
    if done:
        assert pointer.active == operation.versions[-1], (
            f"version {pointer.active} is active, it was done"
        )
        assert pointer.probation == operation.probation, (
            f"probation is {pointer.probation}, it was done"
        )
    predictor = af.Predictor.load(path)
    assert (predictor.predict(x) == expected[predictor.version]).all(), "it predicts otherwise"
    assert predictor.version == Pointer.read(path).active, f"version {predictor.version} runs"
    bundle = af.Bundle.open(path)
    bundle.problems()
    runs = tuple(run["what"] for run in bundle.journal.runs())
    happened = operation.runs + operation.adds
    expected_runs = {happened, happened + operation.may_add} | (set() if done else {operation.runs})
    assert runs in expected_runs, f"the journal holds {runs}"
    assert not bundle.problems(), f"damage: {bundle.problems()}"
    report = af.maintain(bundle, broken_log(10))
    assert report.decision in operation.after, f"the next maintenance run: {report}"
    assert report.fault_set == set(ROW.cells), f"the next maintenance run: {report}"
    assert not bundle.problems(), f"damage after it: {bundle.problems()}"
    left = [
        path.name for path in (place / NAME / "versions").iterdir() if not path.name.isdecimal()
    ]
    assert not left, f"left behind: {left}"


def check_recording(done: bool, place: Path) -> None:
    """Raise AssertionError where a recording cannot be read up to its last whole line."""
    import adaptfault as af

    files = list((place / "today").glob("*.csv")) if (place / "today").exists() else []
    lines = sum(path.read_bytes().count(b"\n") for path in files)
    if done:
        assert lines == 60, f"{lines} of 60 frames are there"
    if lines:
        read = sum(
            len(frames) for frames in af.load(place / "today", layout=LAYOUT).recordings.frames
        )
        assert lines <= read <= lines + len(files), f"{read} of {lines} frames are read"


def in_child(call: Callable[[], Any]) -> Any:
    """Return what a call returns in a forked process; raises AssertionError where it fails or
    hangs."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        signal.alarm(_LONGEST)
        try:
            result: tuple[bool, Any] = (True, call())
        except BaseException as error:
            result = (False, f"{type(error).__name__} {error}")
        with open(writing, "wb") as file:
            pickle.dump(result, file)
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as file:
        data = file.read()
    _, status = os.waitpid(child, 0)
    assert data, f"the process ended with status {status}" + (
        " (it hangs)" if status == signal.SIGALRM else ""
    )
    right, value = pickle.loads(data)
    assert right, value
    return value


def failures(calls: str) -> list[Failure]:
    """Return each way in which each call may fail."""
    return [
        Failure(at, error, from_then_on)
        for at, letter in enumerate(calls)
        for error in sorted(KINDS[letter][1])
        for from_then_on in (False, True)
    ]


class Trial:
    """Tries failures of one operation; a state of the disk that was right once is not checked
    again.

    Args:
        operation: that is tried.
        loaded: the library.
        place: folder for each case, made and removed.
        expected: classes that each version gives.
        x: windows that it gives them to.
    """

    def __init__(
        self, operation: Operation, loaded: Any, place: Path, expected: dict[int, Any], x: Any
    ) -> None:
        self.operation = operation
        self.loaded = loaded
        self.place = place
        self.expected = expected
        self.x = x
        self._right: set[tuple[bool, bytes]] = set()
        self.calls = self._case(None)[1]

    def __call__(self, failure: Failure) -> None:
        """Try one failure; raises AssertionError where a robot does not go on."""
        self._case(failure)

    def _case(self, failure: Failure | None) -> tuple[bool, str]:
        try:
            done, calls = in_child(
                lambda: attempt(self.loaded, self.operation, failure, self.place)
            )
            assert done or failure is not None, "it failed without a failure"
            state = (done, digest(self.place))
            if state not in self._right:
                in_child(lambda: check(self.operation, done, self.place, self.expected, self.x))
                self._right.add(state)
            return done, calls
        finally:
            shutil.rmtree(self.place)


def digest(folder: Path) -> bytes:
    """Return a hash of the names and contents below a folder."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        content = path.read_bytes() if path.is_file() else b"folder"
        found.update(
            path.relative_to(folder).as_posix().encode() + b"\0" + hashlib.sha256(content).digest()
        )
    return found.digest()


@contextmanager
def same_every_time() -> Iterator[None]:
    """Stop the clocks and draw the same keys, so that states of the disk can be compared."""
    numbers = itertools.count()
    stopped = mock.Mock(perf_counter=lambda: 0.0, monotonic=lambda: 0.0)
    key = mock.Mock(side_effect=lambda: mock.Mock(hex=f"{next(numbers):032x}"))
    with ExitStack() as stack:
        for module in ("bundle.bundle", "robot.maintenance"):
            stack.enter_context(
                mock.patch(f"adaptfault.{module}.now", return_value="2026-01-01T00:00:00+00:00")
            )
        stack.enter_context(mock.patch("adaptfault.bundle.journal.uuid4", key))
        stack.enter_context(mock.patch("adaptfault.adaptation.stages.time", stopped))
        yield


def run(
    home: Path,
    *,
    sample: int | None,
    bundle: Path | None = None,
    say: Callable[[str], None] = print,
) -> tuple[int, int, list[str]]:
    """Try the failures, and return how many calls and failures there were, and what went wrong.

    Args:
        home: an empty folder.
        sample: number of failures of each operation that are tried; None: all.
        bundle: folder of one that :func:`power_cut.make` made, which saves time; None: make it.
        say: receives one line for each operation.
    """
    import torch

    import adaptfault as af

    torch.set_num_threads(1)  # a forked process has no other threads
    loaded = library()
    all_calls = 0
    tried = 0
    wrong = []
    with small_versions(), same_every_time():
        for seed in (9, 10):
            broken_log(seed)  # simulated once, before the process forks
        every = list(operations(home, bundle))
        x, expected = predictions(af.Bundle.open(home / "now" / NAME))
        for operation in every:
            trial = Trial(operation, loaded, home / "case", expected, x)
            chosen = failures(trial.calls)
            if sample is not None:
                chosen = random.Random(0).sample(chosen, min(sample, len(chosen)))
            failed = 0
            for failure in chosen:
                try:
                    trial(failure)
                except AssertionError as error:
                    failed += 1
                    what = errno.errorcode[failure.error]
                    if failure.from_then_on:
                        what += " from then on"
                    kind = KINDS[trial.calls[failure.at]][0]
                    wrong.append(f"{operation.name}, call {failure.at} ({kind}), {what}: {error}")
            all_calls += len(trial.calls)
            tried += len(chosen)
            kinds = ", ".join(
                f"{n} {KINDS[letter][0]}" for letter, n in sorted(Counter(trial.calls).items())
            )
            say(
                f"{operation.name}: {len(trial.calls)} calls ({kinds}), {len(chosen)} failures,"
                f" {failed} wrong"
            )
    return all_calls, tried, wrong


def build(folder: Path) -> Path:
    """Compile the library; raises OSError where there is no compiler, or another system."""
    if not sys.platform.startswith("linux"):
        raise OSError("the library is for Linux")
    path = folder / "io_errors.so"
    command = [
        os.environ.get("CC", "cc"),
        "-shared",
        "-fPIC",
        "-O1",
        "-o",
        str(path),
        str(SOURCE),
        "-ldl",
        "-lpthread",
    ]
    subprocess.run(command, check=True)
    return path


def start_with_library(
    arguments: list[str], folder: Path, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run this script in a process with the library loaded."""
    path = str(build(folder))
    environment = {**os.environ, "LD_PRELOAD": path, LIBRARY: path, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), *arguments]
    return subprocess.run(command, env=environment, check=False, text=True, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--all", action="store_true", help="every failure, not a sample")
    parser.add_argument(
        "--sample",
        type=int,
        default=12,
        metavar="N",
        help="failures of each operation (default 12)",
    )
    parser.add_argument(
        "--bundle", type=Path, metavar="FOLDER", help="that power_cut.make made (default: make one)"
    )
    args = parser.parse_args()
    if LIBRARY not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            raise SystemExit(start_with_library(sys.argv[1:], Path(folder)).returncode)
    logging.disable()
    with tempfile.TemporaryDirectory() as home:
        calls, tried, wrong = run(
            Path(home),
            sample=None if args.all else args.sample,
            bundle=args.bundle,
            say=lambda text: print(text, flush=True),
        )
    print("\n".join(wrong[:40]))
    print(f"{calls} calls, {tried} failures, {len(wrong)} wrong")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
