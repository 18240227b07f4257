"""Severity: who has to act. One rule for each thing that is told; the worst decides, and the
reasons are a list.

A severity is the exit code of every command: 0 nothing to do; 1 watch: faults that are handled, or
a warning; 2 a person is needed; 3 unknown, because the input or the usage is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

from diagnostics import Diagnosis, FaultSet

Name = Literal[
    "fault",
    "wire",
    "rewired",
    "transposed",
    "replaced_pad",
    "gain",
    "offset",
    "ramp",
    "hum",
    "noise",
    "quantised",
    "saturated",
    "crosstalk",
    "normalised",
    "sentinel",
    "silent_array",
    "frozen",
    "static_load",
    "untested",
    "lost_frames",
    "one_signal",
    "corrupt_frame",
    "common_spike",
    "repeated_frames",
    "swapped_in_part",
    "another_sensor",
    "coincides",
    "unread",
    "missing",
    "time_gaps",
    "clock_disorder",
    "jitter",
    "begins_in_contact",
    "tared_in_contact",
    "held_value",
]
NAMES: tuple[str, ...] = get_args(Name)
"""Names of findings; they never change, because programs ask for them."""

UNKNOWN = 3

STATUS = ("OK", "WARNING", "CRITICAL", "UNKNOWN")
"""The word of monitoring plugins for each severity."""

UNREADABLE: tuple[Name, ...] = ("normalised", "silent_array")
"""Findings with which no reading means anything."""

TECHNICIAN_BELOW = 0.9
"""Share of the fault-free accuracy below which a person is needed."""

UNTESTED = 0.05
"""Test coverage below which recordings test nothing."""

_OF_FINDING: Mapping[Name, int] = {
    "rewired": 2,
    "swapped_in_part": 2,
    "another_sensor": 2,
    "one_signal": 2,
    "normalised": 2,
    "silent_array": 2,
    "lost_frames": 0,
    "begins_in_contact": 0,
    "repeated_frames": 0,
}


class Told(Protocol):
    """Something with a severity."""

    @property
    def severity(self) -> int:
        """0 to 3."""


@dataclass(frozen=True)
class Reason:
    """One reason for a severity.

    Attributes:
        severity: 0 nothing to do, 1 watch, 2 a person is needed, 3 unknown.
        text: one sentence.
    """

    severity: int
    text: str


def worst(reasons: Iterable[Told]) -> int:
    """Return the highest severity; 0 without any reason."""
    return max((reason.severity for reason in reasons), default=0)


def of_finding(name: Name) -> int:
    """Return the severity of a finding that is no fault: 1, unless the readings cannot be used
    without a person."""
    return _OF_FINDING.get(name, 1)


def of_faults(diagnosis: Diagnosis) -> int:
    """Return the severity of the faults of a log: 0 without any; 2 for a wire, or a tenth of the
    cells; else 1."""
    return diagnosis.exit_code if diagnosis.faults else 0


def of_known(faulty: FaultSet, unhandled: FaultSet) -> int:
    """Return the severity of known faults: 0 without any; 2 where the running version uses some of
    them; else 1."""
    if unhandled:
        return 2
    return 1 if faulty else 0


def of_accuracy(accuracy: float | None, fault_free: float | None, chance: float = 0.0) -> int:
    """Return the severity of what the running version reaches with the faults: 2 where that is too
    little, else 0.

    Args:
        accuracy: under the known faults; None: never measured, which is no finding.
        fault_free: without any fault; None: never measured.
        chance: accuracy that guessing may reach.
    """
    if accuracy is None:
        return 0
    if accuracy < chance:
        return 2
    return 2 if fault_free is not None and accuracy < TECHNICIAN_BELOW * fault_free else 0


def of_change(before: float, after: float) -> int:
    """Return the severity of a changed pad or sensor, from the accuracy without and with the
    change: 1 or 2."""
    return 2 if after < TECHNICIAN_BELOW * before else 1


def untested(diagnosis: Diagnosis) -> str | None:
    """Return that a log tests too few of the cells, or what may be faulty all through it, in one
    sentence; None where it tests enough."""
    share = diagnosis.coverage.test_coverage
    if share < UNTESTED:
        return f"only {share:.0%} of the cells were tested, so faults may be hidden"
    throughout = [fault.cells for fault in diagnosis.possible if fault.recordings is None]
    cells = {cell for some in throughout for cell in some}
    if not cells:
        return None
    which = "1 cell" if len(cells) == 1 else f"{len(cells)} cells"
    return f"{which} may be faulty all through the log, which alone cannot tell"
