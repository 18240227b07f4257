"""Health of a data set: what its recordings show beside the state of the cells.

Beside an inspection of the cells, told are: missing readings and cells that never change; lost
frames and jitter of the clock; recordings that begin in contact, where a driver that tares at the
start takes the contact out; and recordings whose readings go to the other side of rest, where one
did (:mod:`adaptfault.inspection.begins`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.facts.rates import Clock
from adaptfault.data.summary import Summary
from adaptfault.inspection.code import Need
from adaptfault.inspection.codes import unchecked
from adaptfault.inspection.findings import Findings, Unchecked, unchecked_for_want
from adaptfault.inspection.leave_out import LeaveOut
from adaptfault.inspection.naming import Naming
from adaptfault.inspection.result import Finding, Inspection
from adaptfault.inspection.sample_bound import SampleBound
from adaptfault.inspection.severity import Name, of_finding
from diagnostics import SensorLayout
from diagnostics.when import reads_enough

SCHEMA = "adaptfault.check/1"

Level = Literal["full", "quick"]
"""How much is tested."""

_JITTER = 0.2  # of the period: times say less about lost frames from here on
_LISTED = 5
_FILES = "recordings or files could not be read: left out"


@dataclass(frozen=True, eq=False)
class DataSetCheck:
    """The health of a data set.

    Attributes:
        inspection: of its cells.
        summary: of its readings.
        clock: of its frames.
        left_out: recordings that could not be read.
        begin_in_contact, tared_in_contact: names of such recordings.
        given: what the recordings were compared with.
        source: what the data set is called.
        naming: of its pads and recordings.
        level: "full", or "quick" (:mod:`adaptfault.inspection.quick`).
        left_to_check: what a quick check leaves to the full one.
        stood_still: that the stream stood still in some recordings, in one sentence; None: in
            none.
        sample: what the recordings tell of all, where they were drawn; None: they are all.
    """

    inspection: Inspection
    summary: Summary
    clock: Clock
    left_out: int
    begin_in_contact: tuple[str, ...]
    tared_in_contact: tuple[str, ...]
    given: frozenset[Need] = frozenset()
    source: str = ""
    naming: Naming = field(default_factory=Naming)
    level: Level = "full"
    left_to_check: tuple[Unchecked, ...] = ()
    stood_still: str | None = None
    sample: SampleBound | None = None

    @property
    def healthy_share(self) -> float:
        """Share of the cells that are not in F."""
        diagnosis = self.inspection.diagnosis
        return 1 - len(diagnosis.fault_set) / int(diagnosis.layout.present.sum())

    @cached_property
    def findings(self) -> Findings:
        """What was found, and what was not checked."""
        told = (Finding(name, of_finding(name), text) for name, text in self._remarked)
        found = (*self.inspection.findings, *told)
        unchecked = tuple(replace(one, what=self.naming.text(one.what)) for one in self._unchecked)
        return Findings(found, unchecked, self.layout, self.source, self.naming)

    @property
    def leave_out(self) -> LeaveOut:
        """Without which recordings and cells no fault that was found is left."""
        return LeaveOut.of(self.inspection.diagnosis)

    @property
    def advice(self) -> list[str]:
        """What to leave out of a training, in sentences."""
        return [self.naming.text(sentence) for sentence in self.leave_out.sentences]

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.summary.layout

    @property
    def remarks(self) -> tuple[str, ...]:
        """One sentence for each thing that whoever trains on the data should know, beside the state
        of the cells."""
        return tuple(text for _, text in self._remarked)

    @property
    def severity(self) -> int:
        """0 nothing to do, 1 there are remarks or single faults, 2 a wire or a tenth of the
        cells."""
        return self.findings.severity

    @cached_property
    def _remarked(self) -> list[tuple[Name, str]]:
        found: list[tuple[Name, str]] = []
        if self.left_out:
            found.append(("unread", f"{self.left_out} {_FILES}"))
        if share := self._missing_share():
            found.append(("missing", f"{share:.2%} of the readings are missing"))
        if self.clock.lost:
            text = f"about {self.clock.lost} frames are missing between the times"
            found.append(("time_gaps", text))
        if self.clock.falls:
            found.append(("clock_disorder", f"the clock falls back {self.clock.falls} times"))
        if self.clock.disorder:
            found.append(("clock_disorder", self.clock.disorder))
        if self.clock.jitter is not None and self.clock.jitter > _JITTER:
            text = f"the period between frames varies by {self.clock.jitter:.0%}"
            found.append(("jitter", text))
        if self.stood_still and "frozen" not in {one.name for one in self.inspection.findings}:
            found.append(("frozen", self.stood_still))
        if self.begin_in_contact:
            begun = _counted(self.begin_in_contact)
            text = f"{begun}: harmless, unless the driver tares at the start"
            found.append(("begins_in_contact", text))
        if self.tared_in_contact:
            names = _listed(self.tared_in_contact)
            text = f"readings fall below rest, as after a tare in contact: {names}"
            found.append(("tared_in_contact", text))
        return found

    @property
    def _unchecked(self) -> tuple[Unchecked, ...]:
        if self.level == "quick":
            return self.left_to_check
        found = []
        untested = self.inspection.diagnosis.coverage.untested
        little = np.zeros(len(untested), bool)
        if "reference" not in self.given:
            moved = np.nan_to_num(self.summary.highest - self.summary.lowest)
            little = ((moved > 0) & ~reads_enough(moved, self.layout))[untested]
        cells = int(self.layout.present.sum())
        for some, why in (
            (untested[~little], "no contact tested them"),
            (untested[little], "worn or hardly touched, they move less than half as far as others"),
        ):
            if len(some):
                what = f"{len(some)} of {cells} cells: {why} ({self._places(some)})"
                found.append(Unchecked(what, ("TOUCH-190",)))
        return (*found, *unchecked_for_want(unchecked(set(self.given))))

    def _places(self, cells: NDArray[np.intp]) -> str:
        """Return where the first cells are."""
        places = [self.layout.place(cell) for cell in cells[:_LISTED].tolist()]
        more = len(cells) - len(places)
        if more:
            places.append(f"and {more} more")
        return "; ".join(places)

    def _missing_share(self) -> float:
        present = self.summary.layout.is_cell
        readings = int(self.summary.lengths.sum()) * int(present.sum())
        return float(self.summary.missing[present].sum()) / max(readings, 1)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "level": self.level,
            "severity": self.severity,
            "healthy_share": self.healthy_share,
            "findings": self.findings.to_dicts(),
            "not_checked": [one.to_dict() for one in self.findings.unchecked],
            "leave_out": self.leave_out.to_dict(self.inspection.diagnosis.by_recording.names),
            "remarks": list(self.remarks),
            "clock": asdict(self.clock),
            "left_out": self.left_out,
            "begin_in_contact": list(self.begin_in_contact),
            "tared_in_contact": list(self.tared_in_contact),
            "sample": None if self.sample is None else self.sample.to_dict(),
            "summary": self.summary.to_dict(),
            "inspection": self.inspection.to_dict(),
        }

    def badge(self) -> str:
        """Return a badge as SVG: how many cells work, in green, yellow or red."""
        diagnosis = self.inspection.diagnosis
        cells = int(diagnosis.layout.present.sum())
        text = f"{cells - len(diagnosis.fault_set)} of {cells} cells"
        if not diagnosis.coverage.test_coverage:
            text = "not tested"
        colour = ("#2e7d32", "#b08800", "#c62828")[min(self.severity, 2)]
        return _BADGE.format(text=text, colour=colour)


_BADGE = """<svg xmlns="http://www.w3.org/2000/svg" width="210" height="20" role="img" \
aria-label="tactile cells: {text}">
<title>tactile cells: {text}</title>
<rect width="84" height="20" rx="3" fill="#555"/>
<rect x="81" width="129" height="20" rx="3" fill="{colour}"/>
<g fill="#fff" font-family="Verdana,sans-serif" font-size="11" text-anchor="middle">
<text x="41" y="14">tactile cells</text>
<text x="146" y="14">{text}</text>
</g>
</svg>
"""


def _counted(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} begins in contact"
    return f"{len(names)} recordings begin in contact ({_listed(names)})"


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{', '.join(names[:_LISTED])}{more}"
