"""Runs a method on the logs of a bench and keeps what it says, one file a submission."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from adaptfault.bench.folder import Bench, Json, read_json
from adaptfault.bench.methods import DIAGNOSER, REPAIRER, copies, find_method, of_each_cell
from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import scale

SUBMISSION = "adaptfault.submission/1"


def run(folder: Path, method: str, out: Path, *, repairs: bool = False) -> int:
    """Run a method, and return on how many logs it failed.

    What is finished is kept in ``out`` after each log; the same command goes on there, and tries
    again where the method failed.

    Args:
        folder: the bench.
        method: ``module:Name``.
        out: the submission.
        repairs: the method is a repairer.

    Raises:
        ValueError: a changed bench, a name that is no method, or ``out`` is another submission.
        ImportError: the module is missing.
    """
    bench = Bench(folder)
    bench.check()
    build = find_method(method, REPAIRER if repairs else DIAGNOSER)
    what = "repairs" if repairs else "logs"
    tasks = bench.manifest[what]
    about = {"schema": SUBMISSION, "bench": bench.identity, "method": method, "what": what}
    submission: Json = about | {"fit_seconds": {}, "results": {}}
    if out.exists():
        submission = read_json(out, SUBMISSION, "remove it and run again")
        for key, expected in about.items():
            if submission.get(key) != expected:
                raise ValueError(
                    f"{out}: is of {key} {submission.get(key)}, expected {expected}; name another"
                    " file with --out"
                )
    results = submission["results"]
    submission["versions"] = None
    todo = [name for name in tasks if "error" in results.get(name, {"error": ""})]
    answer = Repairs if repairs else Diagnoses
    for given in dict.fromkeys(tasks[name]["healthy"] for name in todo):
        work = answer(method, build, bench.recordings(given))
        of_it = [name for name in todo if tasks[name]["healthy"] == given]
        for name in tqdm(of_it, desc=tasks[of_it[0]]["sensor"], disable=None):
            try:
                results[name] = work.answer(bench.recordings(tasks[name]["file"]), tasks[name])
            except MethodError as error:
                results[name] = {"error": str(error)}
                print(f"{name}: {error}; mend it and run again", file=sys.stderr)
            submission["fit_seconds"][given] = round(work.fit_seconds, 3)
            if submission["versions"] is None:  # the method has imported what it needs
                submission["versions"] = versions()
            atomic_write(out, json.dumps(submission).encode())
    return sum("error" in result for result in results.values())


class MethodError(Exception):
    """A method raised an error, or returned something else than expected."""


class Diagnoses:
    """One diagnoser on the logs of one sensor."""

    def __init__(self, name: str, build: Callable[[], Any], healthy: Recordings) -> None:
        self.name = name
        self.layout = healthy.layout
        self.fit_seconds = 0.0
        self.failed = ""
        try:
            self.method, self.fit_seconds = timed(f"{name}: fit", lambda: self.fit(build, healthy))
        except MethodError as error:
            self.failed = str(error)

    def fit(self, build: Callable[[], Any], healthy: Recordings) -> Any:
        """Return the fitted method."""
        method = build()
        method.fit(copies(healthy.frames), self.layout)
        return method

    def answer(self, log: Recordings, task: Json) -> Json:
        """Return faulty and untested cells, wires and seconds; None where it does not tell."""
        if self.failed:
            raise MethodError(self.failed)
        given = copies(log.frames)
        faulty, seconds = timed(f"{self.name}: detect", lambda: self.method.detect(given))
        answer: Json = {"faulty": self.cells(faulty, "detect"), "seconds": round(seconds, 4)}
        answer |= {"untested": None, "wires": None}
        if hasattr(self.method, "untested"):
            untested, _ = timed(f"{self.name}: untested", self.method.untested)
            answer["untested"] = self.cells(untested, "untested")
        if hasattr(self.method, "wires"):
            wires, _ = timed(
                f"{self.name}: wires",
                lambda: [[int(pad), str(kind), int(i)] for pad, kind, i in self.method.wires()],
            )
            answer["wires"] = wires
        return answer

    def cells(self, found: Any, method: str) -> list[int]:
        """Return the cells that are True."""
        try:
            return np.flatnonzero(of_each_cell(found, self.name, method, self.layout)).tolist()
        except ValueError as error:
            raise MethodError(str(error)) from None


class Repairs:
    """One repairer on the fault sets of one sensor."""

    def __init__(self, name: str, build: Callable[[], Any], healthy: Recordings) -> None:
        self.name = name
        self.build = build
        self.healthy = healthy
        self.method: Any = None
        self.fit_seconds = 0.0

    def answer(self, test: Recordings, task: Json) -> Json:
        """Return the class of each window, and the seconds of fit and prediction."""
        layout = self.healthy.layout
        faults = np.isin(np.arange(layout.n_cells), task["faults"])
        x = scale(self.healthy.frames, layout)
        labels = np.array(self.healthy.labels)

        def fit() -> None:
            self.method = self.method or self.build()
            self.method.fit(x, labels, faults, layout)

        _, fitting = timed(f"{self.name}: fit", fit)
        windows = scale(test.frames, layout)
        found, predicting = timed(f"{self.name}: predict", lambda: self.method.predict(windows))
        predicted = np.asarray(found)
        if predicted.shape != (len(test),) or predicted.dtype.kind not in "iu":
            raise MethodError(
                f"{self.name}: predict returned {predicted.dtype} of shape {predicted.shape};"
                f" expected whole numbers of shape ({len(test)},), the class of each window;"
                " correct predict"
            )
        self.fit_seconds += fitting
        return {"predicted": predicted.tolist(), "seconds": round(fitting + predicting, 4)}


def timed(what: str, call: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call returns, and its CPU seconds.

    Raises:
        MethodError: it raises an exception.
    """
    began = time.process_time()
    try:
        returned = call()
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise MethodError(f"{what} raised {text}") from error
    return returned, time.process_time() - began


def versions() -> dict[str, str]:
    """Return Python's version and those of the packages that are imported."""
    found = {"python": platform.python_version()}
    for module in sys.modules.keys() - sys.stdlib_module_names:
        package = "scikit-learn" if module == "sklearn" else module
        if "." not in module:
            with suppress(PackageNotFoundError):
                found[package] = version(package)
    return dict(sorted(found.items()))
