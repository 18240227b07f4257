"""Quick check of a data set: what one pass over the readings tells, without a model of the cells.

The pass keeps of each recording the range of each cell and sums that tell whether it moves together
with those beside it. They are merged by putting them one behind the other, so that neither the size
of a data set nor how it is cut matters.

Found are cells and wires that hold a value in some recordings although those beside them move
(:mod:`diagnostics.when`), as the whole check finds them. No cell is called ALIVE: that a cell
answers together with those beside it (:mod:`diagnostics.when.together`) is a witness of contact,
no test of what it reads. What only the whole check tells is listed as not checked.

Not detected: cells that are dead from the first recording to the last, that move by themselves,
late, in part, or as another one does, drift and noise, and what the whole array shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.findings import Unchecked
from adaptfault.inspection.result import Inspection, faults_and_frames, finding_of
from adaptfault.inspection.severity import UNTESTED
from diagnostics import Diagnosis, SensorLayout, TransportFault
from diagnostics.decision.by_recording import with_recordings
from diagnostics.preprocessing.load import LoadDirection
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.tolerance import tolerance_of
from diagnostics.sensor.repeated_frames import find_repeated_frames
from diagnostics.when import Spans, find_held
from diagnostics.when.together import Together

if TYPE_CHECKING:
    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.naming import Naming

_LISTED = 5

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Quick:
    """What one pass over a data set tells.

    Attributes:
        inspection: the findings; no cell is tested but those that are faulty.
        answers: bool ``[D]``, cells that answer together with those beside them.
        moves: bool ``[D]``, cells that move.
    """

    inspection: Inspection
    answers: Bools
    moves: Bools

    def named(self, naming: Naming) -> Quick:
        """Return the same with pads and recordings called by their names."""
        return replace(self, inspection=naming.of_inspection(self.inspection))

    @property
    def unchecked(self) -> tuple[Unchecked, ...]:
        """What was not checked, with what would check it."""
        diagnosis = self.inspection.diagnosis
        layout = diagnosis.layout
        left = layout.present.ravel() & ~diagnosis.fault_set.mask
        found = [
            Unchecked(
                f"{int((left & self.answers).sum())} cells answer together with those beside them;"
                " whether they read what touches them was not tested: cells that move by"
                " themselves, late, in part or as others do, that drift or are noisy, and what the"
                " whole array shares, the whole check finds, without --quick",
                ("TOUCH-190",),
            )
        ]
        for which, what in (
            (self.moves & ~self.answers, "move, not together with those beside them"),
            (~self.moves, "never move"),
        ):
            cells = np.flatnonzero(left & which)
            if len(cells):
                text = f"{len(cells)} cells {what} ({_places(cells, layout)})"
                found.append(Unchecked(text, ("TOUCH-190",)))
        return tuple(found)


def quick(log: Opened | Recordings, classes: Sequence[str] | None = None) -> Quick:
    """Return what one pass over a data set tells.

    Args:
        log: the data set.
        classes: the class of each recording; None: unknown.
    """
    layout = log.layout
    pass_ = _Pass(layout)
    for part in _parts(log):
        pass_.add(part)
    lengths = _lengths(log)
    spans = pass_.spans(lengths)
    held = find_held(spans, pass_.planes, pass_.tolerance, classes).of(pass_.place)
    nothing = Diagnosis(
        layout=layout,
        faults=(),
        probability=np.zeros(layout.n_cells),
        tested=np.zeros(layout.n_cells, bool),
        n_frames=sum(lengths),
        n_recordings=len(lengths),
        transport=pass_.repeated,
    )
    diagnosis = with_recordings(nothing, held, lengths, pass_.tolerance, None)
    together = pass_.together(lengths)
    answers = together.answers(spans)[pass_.place]
    moves = np.asarray(together.moves(spans).any(axis=0))[pass_.place]
    findings = faults_and_frames(diagnosis)
    present = layout.present.ravel()
    known = (answers | diagnosis.fault_set.mask) & present
    if known.sum() < UNTESTED * present.sum():
        text = (
            f"only {known.sum()} of {present.sum()} cells answer together with those beside them,"
            " so faults may be hidden: run the whole check, without --quick"
        )
        findings.append(finding_of("untested", text))
    readings = ChangedReadings(None, None, [], diagnosis)
    return Quick(Inspection(readings, tuple(findings)), answers & present, moves & present)


class _Pass:
    """One pass over a data set, part by part; the first part tells the direction of load, the step
    of the converter, and whether frames repeat."""

    def __init__(self, layout: SensorLayout) -> None:
        self.layout = layout
        self.planes = layout
        order = np.arange(layout.n_cells)
        if layout.axes > 1:
            from diagnostics.diagnosis import axis_planes  # slow to import, and rarely needed

            self.planes, order = axis_planes(layout)
        self.order = order
        self.place = np.argsort(order)
        self.tolerance = 0.0
        self.repeated: tuple[TransportFault, ...] = ()
        self._load: LoadDirection | None = None
        self._pieces: list[int] = []
        self._spans: list[Spans] = []
        self._together: list[Together] = []

    def add(self, part: list[NDArray[Any]]) -> None:
        """Take in recordings ``[T, D]``, or pieces of them."""
        if not self._pieces:
            self._begin(part)
        valid = RecordingBlocks(part).valid(self.layout.full_scale, self.layout.present.ravel())
        given = [np.asarray(frames, np.float64)[:, self.order] for frames in valid.given]
        if self._load is not None:
            given = [self._load.loads(frames) for frames in given]
        self._pieces += map(len, given)
        self._spans.append(Spans.of(RecordingBlocks(given)))
        self._together.append(Together.of(given, self.planes))

    def _begin(self, part: list[NDArray[Any]]) -> None:
        log = RecordingBlocks(part)
        self.tolerance = tolerance_of(log, self.layout)
        self._load = LoadDirection.fit(log, self.planes)
        repeated = find_repeated_frames(part, self.layout)
        if repeated is not None:
            text = repeated.reason(self.layout.rate)
            self.repeated = (TransportFault("repeated_frames", 0, 1, text),)

    def spans(self, lengths: Sequence[int]) -> Spans:
        """Return the ranges of whole recordings of these lengths."""
        return Spans.joined(self._spans).whole(self._pieces, lengths)

    def together(self, lengths: Sequence[int]) -> Together:
        """Return the sums of whole recordings of these lengths."""
        return Together.joined(self._together).whole(self._pieces, lengths)


def _parts(log: Opened | Recordings) -> Any:
    """Return the recordings in parts that fit into memory."""
    frames = getattr(log, "frames", None)
    return [list(frames)] if frames is not None else log.parts()  # type: ignore[union-attr]


def _lengths(log: Opened | Recordings) -> list[int]:
    frames = getattr(log, "frames", None)
    return list(map(len, frames)) if frames is not None else list(log.lengths)  # type: ignore[union-attr]


def _places(cells: NDArray[np.intp], layout: SensorLayout) -> str:
    """Return where the first cells are."""
    places = [layout.place(cell) for cell in cells[:_LISTED].tolist()]
    more = f"; and {len(cells) - _LISTED} more" if len(cells) > _LISTED else ""
    return f"{'; '.join(places)}{more}"
