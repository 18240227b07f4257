"""Metrics of robots as a text file that Prometheus reads, through node_exporter's textfile
collector.

By hand, where there is prometheus_client: its registry and collector are as long as the function
that writes the text, whose format its parser checks in the tests.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from adaptfault.data.atomic import atomic_write
from diagnostics import Diagnosis, Fault, FaultSet, SensorLayout, Verdict

if TYPE_CHECKING:  # a station writes metrics without a bundle
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance_report import MaintenanceReport

HELP: Mapping[str, str] = {
    "adaptfault_cells": "Number of cells of a pad by state: alive, faulty or untested.",
    "adaptfault_coverage_ratio": "Share of the cells that the last recordings tested.",
    "adaptfault_accuracy_expected_ratio": "Accuracy of the running version with the known faults.",
    "adaptfault_fault_info": "A known fault: its kind, its line, and the number of its cells.",
    "adaptfault_last_run_timestamp_seconds": "End of the last run, in seconds since 1970.",
    "adaptfault_exit_code": "Exit code of the last run: 0 fine, 1 watch, 2 technician, 3 unknown.",
}
"""Every metric; all are gauges."""

Sample = tuple[dict[str, str], float]


@dataclass(frozen=True)
class PadCells:
    """Number of cells of a pad by state.

    Attributes:
        faulty: known faulty cells.
        alive, untested: the others; None where nothing was diagnosed.
    """

    faulty: int
    alive: int | None = None
    untested: int | None = None


@dataclass(frozen=True)
class FaultCount:
    """Faults of one kind on one line.

    Attributes:
        kind: of the fault, as "short".
        line: the wire, as "pad 1, row 2"; empty for all single cells.
        cells: number of cells.
    """

    kind: str
    line: str
    cells: int


@dataclass(frozen=True)
class RobotMetrics:
    """What a file of metrics tells of one robot; None and empty: not known, and not written.

    Attributes:
        robot: its name.
        time: end of the run, in seconds since 1970.
        exit_code: of the run.
        pads: cells of each pad.
        coverage: share of the cells that were tested.
        accuracy: of the running version, with the known faults.
        faults: known faults.
    """

    robot: str
    time: float
    exit_code: int | None = None
    pads: tuple[PadCells, ...] = ()
    coverage: float | None = None
    accuracy: float | None = None
    faults: tuple[FaultCount, ...] = ()

    @classmethod
    def of(cls, robot: str, time: float, bundle: Bundle, report: MaintenanceReport) -> RobotMetrics:
        """Return the metrics of a maintenance run."""
        from adaptfault.robot.sensor_state import SensorState

        accuracy = report.accuracy
        if accuracy is None and report.decision != "refused":
            accuracy = SensorState.of(bundle).accuracy
        return cls(
            robot,
            time,
            report.exit_code,
            cells_by_pad(bundle.layout, report.faults, report.diagnosis),
            None if report.diagnosis is None else report.diagnosis.coverage.test_coverage,
            accuracy,
            fault_counts(report.faults),
        )


def cells_by_pad(
    layout: SensorLayout, faults: Iterable[Fault], diagnosis: Diagnosis | None = None
) -> tuple[PadCells, ...]:
    """Return the cells of each pad by state: those of known faults, and what a diagnosis tells of
    the others."""
    faulty = FaultSet.of([c for fault in faults for c in fault.cells], layout.n_cells)
    present = layout.present.reshape(layout.pads, -1)
    bad = faulty.mask.reshape(layout.pads, -1) & present
    if diagnosis is None:
        return tuple(PadCells(int(pad.sum())) for pad in bad)
    alive = (diagnosis.verdicts == Verdict.ALIVE).reshape(layout.pads, -1) & present & ~bad
    untested = present & ~bad & ~alive
    counts = np.stack([bad, alive, untested]).sum(axis=2).T.tolist()
    return tuple(PadCells(*pad) for pad in counts)


def fault_counts(faults: Iterable[Fault]) -> tuple[FaultCount, ...]:
    """Return faults by kind and line; single cells of one kind are counted together."""
    return summed(
        (str(fault.kind), "" if fault.line is None else str(fault.line), len(fault.cells))
        for fault in faults
    )


def summed(faults: Iterable[tuple[str, str, int]]) -> tuple[FaultCount, ...]:
    """Return the sum of the cells of each kind and line, as no two samples may have one name."""
    cells: Counter[tuple[str, str]] = Counter()
    for kind, line, number in faults:
        cells[kind, line] += number
    return tuple(FaultCount(kind, line, number) for (kind, line), number in cells.items())


def write_metrics(path: str | PathLike[str], robots: Sequence[RobotMetrics]) -> None:
    """Write metrics in one step, so that nobody reads a part of them.

    Raises:
        OSError: the file cannot be written.
    """
    atomic_write(path, text_of(robots).encode())


def text_of(robots: Sequence[RobotMetrics]) -> str:
    """Return metrics in Prometheus's text format."""
    lines = []
    for name, samples in _samples(robots).items():
        if samples:
            lines += [f"# HELP {name} {HELP[name]}", f"# TYPE {name} gauge"]
        for labels, value in samples:
            told = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
            lines.append(f"{name}{{{told}}} {value:.15g}")
    return "".join(f"{line}\n" for line in lines)


def _samples(robots: Sequence[RobotMetrics]) -> dict[str, list[Sample]]:
    """Return the samples of each metric, in the order of ``HELP``."""
    found: dict[str, list[Sample]] = {name: [] for name in HELP}
    for one in robots:
        robot = {"robot": one.robot}
        found["adaptfault_cells"] += _of_cells(one)
        found["adaptfault_fault_info"] += [
            ({**robot, "kind": f.kind, "line": f.line, "cells": str(f.cells)}, 1)
            for f in one.faults
        ]
        single = {
            "adaptfault_coverage_ratio": one.coverage,
            "adaptfault_accuracy_expected_ratio": one.accuracy,
            "adaptfault_last_run_timestamp_seconds": one.time,
            "adaptfault_exit_code": one.exit_code,
        }
        for name, value in single.items():
            if value is not None:
                found[name].append((robot, value))
    return found


def _of_cells(one: RobotMetrics) -> Iterator[Sample]:
    for number, pad in enumerate(one.pads):
        states = {"alive": pad.alive, "faulty": pad.faulty, "untested": pad.untested}
        for state, count in states.items():
            if count is not None:
                yield {"robot": one.robot, "pad": str(number), "state": state}, count


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
