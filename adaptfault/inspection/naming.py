"""What a data set calls its pads, recordings and frames, in the sentences that tell of it.

The diagnosis counts pads and recordings from 0, and frames through all recordings. Whoever looks at
a data set knows features or topics, names of episodes, and frames within them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import TypeVar

from adaptfault.data.printable import printable
from adaptfault.data.recordings import Opened, Recordings
from adaptfault.data.recordings.formats.datasets.features import common_features
from adaptfault.inspection.result import Finding, Inspection
from diagnostics import Diagnosis, Fault, SensorLayout
from diagnostics.decision.static_load import StaticLoad
from diagnostics.preprocessing.transport import TransportFault

_PAD = re.compile(r"\bpad (\d+)\b")
_NUMBERS = r"\d+(?: to \d+)?(?:, \d+(?: to \d+)?)*"
# names hold such words themselves: "log.npz, recording 7", "7.csv"
_RECORDINGS = re.compile(rf"(?<!, )\brecording(s?) ({_NUMBERS})(?! (?:frame|reading))\b(?!\.\w)")
_NUMBERED = re.compile(r"(?P<word>[^\W\d_]+) (?P<number>\d+)")
_DIVIDED = re.compile(r"[./]")

OfFrames = TypeVar("OfFrames", StaticLoad, TransportFault)


@dataclass(frozen=True)
class Naming:
    """Names of a data set.

    Attributes:
        pads: name of each pad; empty: they have none.
        recordings: name of each.
        lengths: frames of each.
    """

    pads: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()

    @classmethod
    def of(cls, log: Opened | Recordings) -> Naming:
        """Return the names that a data set states: pads are called after the features, arrays or
        topics that hold them, without what these have in common."""
        if isinstance(log, Recordings):
            return cls((), log.names, tuple(map(len, log.frames)))
        features = common_features([one.arrays for one in log.origins])
        pads = _apart(features) if len(features) == log.layout.pads else ()
        names = log.names
        if len(set(names)) < len(names):  # of several data sets
            sources = [one.facts.path.name for one in log.origins]
            names = tuple(map("/".join, zip(sources, names, strict=True)))
        return cls(pads, names, tuple(log.lengths))

    def place(self, frame: int) -> tuple[str, int] | None:
        """Return the recording that holds a frame of all, and its number there; None: none does."""
        for name, length, end in zip(
            self.recordings, self.lengths, accumulate(self.lengths), strict=True
        ):
            if frame < end:
                return name, frame - (end - length)
        return None

    def pads_of(self, cells: Sequence[int], layout: SensorLayout) -> list[str]:
        """Return the names of the pads that hold cells, each once; numbers where they have none."""
        numbers = sorted({int(layout.pad_of[cell]) for cell in cells})
        return [self.pads[pad] if self.pads else str(pad) for pad in numbers]

    def text(self, sentence: str) -> str:
        """Return a sentence with pads and recordings called by their names."""
        named = _RECORDINGS.sub(self._recording, sentence)
        return _PAD.sub(self._pad, named) if self.pads else named

    def told(self, sentence: str, frame: int | None) -> str:
        """Return a sentence by their names that tells of a ``frame`` of all recordings; None: of no
        frame."""
        named = self.text(sentence)
        place = None if frame is None else self.place(frame)
        if place is None or len(self.recordings) < 2:
            return named
        recording, number = place
        pattern = rf"\bframe {frame}\b(?! of)(?P<on> on)?(?: \([\d.]+ s\))?"
        return re.sub(
            pattern,
            lambda found: f"frame {number} of {recording}{found['on'] or ''}",
            named,
            count=1,
        )

    def of_inspection(self, inspection: Inspection) -> Inspection:
        """Return an inspection whose sentences use the names, and whose diagnosis has those of the
        recordings."""
        diagnosis = inspection.diagnosis
        if diagnosis.n_recordings != len(self.recordings):
            return inspection
        named = self._of_diagnosis(diagnosis)
        told = dict(zip(_reasons(diagnosis), _reasons(named), strict=True))
        findings = tuple(self._finding(one, told) for one in inspection.findings)
        readings = replace(inspection.readings, diagnosis=named)
        return replace(inspection, readings=readings, findings=findings)

    def _of_diagnosis(self, diagnosis: Diagnosis) -> Diagnosis:
        return replace(
            diagnosis,
            names=self.recordings,
            faults=tuple(map(self._fault, diagnosis.faults)),
            possible=tuple(map(self._fault, diagnosis.possible)),
            static_loads=tuple(self._at_onset(load) for load in diagnosis.static_loads),
            transport=tuple(self._at_onset(one) for one in diagnosis.transport),
        )

    def _finding(self, finding: Finding, told: dict[str, str]) -> Finding:
        reason = told.get(finding.reason)
        if reason is None:
            reason = self.text(finding.reason)
        fault = None if finding.fault is None else self._fault(finding.fault)
        return replace(finding, reason=reason, fault=fault)

    def _fault(self, fault: Fault) -> Fault:
        alternatives = tuple(map(self.text, fault.alternatives))
        reason = self.told(fault.reason, fault.onset)
        return replace(fault, reason=reason, alternatives=alternatives)

    def _at_onset(self, one: OfFrames) -> OfFrames:
        return replace(one, reason=self.told(one.reason, one.onset))

    def _pad(self, found: re.Match[str]) -> str:
        pad = int(found[1])
        return self.pads[pad] if pad < len(self.pads) else found[0]

    def _recording(self, found: re.Match[str]) -> str:
        numbers = [int(number) for number in re.findall(r"\d+", found[2])]
        if not self.recordings or max(numbers) >= len(self.recordings):
            return found[0]
        numbered = [_NUMBERED.fullmatch(name) for name in self.recordings]
        words = {one["word"] for one in numbered if one is not None}
        if None in numbered or len(words) > 1:
            return f"recording{found[1]} " + self._renamed(found[2], self.recordings)
        names = [one["number"] for one in numbered if one is not None]
        return f"{words.pop()}{found[1]} " + self._renamed(found[2], names)

    @staticmethod
    def _renamed(numbers: str, names: Sequence[str]) -> str:
        return re.sub(r"\d+", lambda number: names[int(number[0])], numbers)


def classes_of(log: Opened | Recordings) -> list[str] | None:
    """Return the name of the class of each recording; None where they have none."""
    if log.labels is None:
        return None
    return [log.class_names[label] if log.class_names else str(label) for label in log.labels]


def _reasons(diagnosis: Diagnosis) -> list[str]:
    """Return the sentences of a diagnosis that are findings."""
    faults = [one.reason for one in diagnosis.faults]
    loads = [one.reason for one in diagnosis.static_loads]
    return [*faults, *loads, *(one.reason for one in diagnosis.transport)]


def _apart(features: Sequence[str]) -> tuple[str, ...]:
    """Return the parts of names that tell them apart: left and right of
    ``observation.tactile.left`` and ``observation.tactile.right``, of one name its last part; whole
    names where that leaves a bare number, or nothing."""
    parts = [_DIVIDED.split(name.strip("/")) for name in features]
    while len(features) > 1 and all(len(one) > 1 for one in parts):
        if len({one[0] for one in parts}) == 1:
            parts = [one[1:] for one in parts]
        elif len({one[-1] for one in parts}) == 1:
            parts = [one[:-1] for one in parts]
        else:
            break
    if len(features) == 1:
        parts = [parts[0][-1:]]
    short = [".".join(one) for one in parts]
    if not all(name and not name.isdigit() for name in short):
        short = list(features)
    return tuple(" ".join(printable(name).split()) for name in short)
