"""Does the diagnosis depend on its constants? python benchmarks/constants.py [RECORDINGS [LOGS]]

Halves and doubles every number in a module of ``diagnostics``, one at a time, and measures
precision and recall with 16 % of the cells dead. The diagnosis is fitted anew where fitting uses
the number; which functions run is recorded to tell that. ``--out`` keeps what is measured: a second
run continues from there. ``--only conditional_test.P_MIN`` picks constants. Without RECORDINGS: the
real hand in ``../shared/data``.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType, ModuleType
from typing import TypeVar

import numpy as np
from arrays import DATA, HAND
from joblib import Parallel, delayed, parallel_config
from rows import Bench

import diagnostics
from adaptfault.data.json_lines import Lines
from adaptfault.data.recordings import Recordings, load
from diagnostics import SelfDiagnosis

Result = TypeVar("Result")
PRECISION = 0.995
RECALL = 0.98
SLACK = 0.01
SHARE = 0.16
NOT_DIAGNOSING = ("circuit", "injection", "plot")  # public tools and the injector
COUNTS = ("FEATURES", "N_FEATURES", "_KINDS")  # of what there is: nobody chose them


@dataclass(frozen=True)
class Constant:
    """A number of a module, and what it is changed to."""

    module: str
    name: str
    value: float
    changed: float

    def __str__(self) -> str:
        return f"{self.title} {self.value:g} -> {self.changed:g}"

    @property
    def title(self) -> str:
        """Module and name."""
        return f"{self.module.rpartition('.')[2]}.{self.name}"

    @property
    def places(self) -> list[tuple[str, str]]:
        """Module and name wherever it is known: what has a public name is imported by others."""
        if self.name.startswith("_"):
            return [(self.module, self.name)]
        return [(module.__name__, self.name) for module in modules() if self.name in vars(module)]

    def set(self, value: float) -> None:
        """Change it, everywhere."""
        for module, name in self.places:
            setattr(importlib.import_module(module), name, value)


@dataclass(frozen=True)
class Measured:
    """The first row with a constant changed; ``error``: it could not be measured."""

    constant: str
    precision: float
    recall: float
    error: str = ""

    def verdict(self) -> str:
        """Say whether the first row still holds, nearly does, or not."""
        if self.error:
            return "FAILS"
        if self.precision >= PRECISION and self.recall >= RECALL:
            return "holds"
        return (
            "near"
            if self.precision >= PRECISION - SLACK and self.recall >= RECALL - SLACK
            else "BREAKS"
        )


def modules() -> list[ModuleType]:
    """Return those of `diagnostics` that find faults."""
    names = [
        info.name
        for info in pkgutil.walk_packages(diagnostics.__path__, "diagnostics.")
        if not info.ispkg
    ]
    return [
        importlib.import_module(name)
        for name in names
        if name.rpartition(".")[2] not in NOT_DIAGNOSING
    ]


def constants() -> Iterator[Constant]:
    """Yield all of them, halved and doubled."""
    for module in modules():
        source = inspect.getsource(module)
        for name, value in sorted(vars(module).items()):
            number = isinstance(value, int | float | np.floating) and not isinstance(value, bool)
            own = re.search(rf"^(_?[A-Z0-9_]+, )*{name}(, [A-Z0-9_]+)* = ", source, re.MULTILINE)
            if number and own and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name) and name not in COUNTS:
                for changed in (value // 2 if isinstance(value, int) else value / 2, 2 * value):
                    if changed not in (0, value):
                        yield Constant(module.__name__, name, value, changed)


def mentioned(work: Callable[[], Result]) -> tuple[Result, set[tuple[str, str]]]:
    """Do work; return its result, and module and name of what the functions of `diagnostics` that
    ran mention."""
    found: set[tuple[str, str]] = set()
    codes = set()

    def look(frame: FrameType, event: str, arg: object) -> None:
        if event == "call" and frame.f_code not in codes:
            codes.add(frame.f_code)
            module = frame.f_globals.get("__name__", "")
            if module.startswith("diagnostics."):
                found.update((module, name) for name in frame.f_code.co_names)

    sys.setprofile(look)
    try:
        result = work()
    finally:
        sys.setprofile(None)
    return result, found


def first_row(bench: Bench) -> tuple[float, float]:
    """Return precision and recall with 16 % of the cells dead."""
    tally = bench.case(SHARE)
    return tally.true / max(tally.true + tally.false, 1), tally.hit / max(tally.testable, 1)


def changed_row(
    constant: Constant, recordings: Recordings, split: int, count: int, fitted: SelfDiagnosis | None
) -> Measured:
    """Measure the first row with a constant changed, of what was fitted already, or fitted anew."""
    bench = Bench(recordings, split, count)
    constant.set(constant.changed)
    try:
        if fitted is not None:
            bench.fitted = fitted
        return Measured(str(constant), *first_row(bench))
    except Exception as error:  # a constant that must not be changed: to be told, too
        return Measured(str(constant), 0.0, 0.0, f"{type(error).__name__}: {error}")
    finally:
        constant.set(constant.value)


def show(row: Measured) -> None:
    told = row.error or f"precision {row.precision:.4f}, recall {row.recall:.4f}"
    print(f"{row.verdict():8s}{row.constant:45s}{told}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Does the diagnosis hang on its constants?")
    parser.add_argument(
        "recordings", nargs="?", help="fault-free recordings; without: simulated grasps"
    )
    parser.add_argument(
        "logs", nargs="?", type=int, default=20, help="logs for each constant (default 20)"
    )
    parser.add_argument("--split", type=int, default=0, help="seed of the halves (default 0)")
    parser.add_argument(
        "--out",
        type=Path,
        help="JSON lines of what is measured; what it holds is not measured again",
    )
    parser.add_argument("--jobs", type=int, default=-1, help="processes (default: one a core)")
    parser.add_argument("--only", nargs="+", metavar="MODULE.NAME", help="constants")
    options = parser.parse_args()
    recordings = load(options.recordings or DATA / HAND).recordings
    job = recordings, options.split, options.logs
    bench = Bench(*job)
    fitted, met_fitting = mentioned(lambda: bench.fitted)
    usual, met_judging = mentioned(lambda: first_row(bench))
    show(Measured("as they are", *usual))
    every = [c for c in constants() if not options.only or c.title in options.only]
    met = met_fitting | met_judging
    used = [c for c in every if not met.isdisjoint(c.places)]
    print(f"{len(every)} changes, {len(used)} of constants that this array meets")
    kept = Lines(options.out) if options.out else None
    rows = [Measured(**document) for document in kept.read()] if kept else []
    for row in rows:
        show(row)
    done = {row.constant for row in rows}
    left = [c for c in used if str(c) not in done]
    with parallel_config(backend="loky", inner_max_num_threads=1):
        for row in Parallel(n_jobs=options.jobs, return_as="generator_unordered")(
            delayed(changed_row)(c, *job, fitted if met_fitting.isdisjoint(c.places) else None)
            for c in left
        ):
            show(row)
            if kept:
                kept.add(asdict(row))
            rows.append(row)
    verdicts = [row.verdict() for row in rows]
    print(", ".join(f"{verdicts.count(v)} {v}" for v in ("holds", "near", "BREAKS", "FAILS")))


if __name__ == "__main__":
    main()
