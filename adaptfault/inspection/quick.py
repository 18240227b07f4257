"""Quick check of a data set: what one pass over the readings tells, without a model of the cells.

The pass keeps of each recording the range of each cell and sums that tell whether it moves together
with those beside it. They are merged by putting them one behind the other, so that neither the size
of a data set nor how it is cut matters.

Found are cells and wires that hold a value in some recordings although those beside them move
(:mod:`diagnostics.when`), as the whole check finds them. No cell is called ALIVE: that a cell
answers together with those beside it (:mod:`diagnostics.when.together`) shows contact, and is
no test of what it reads. So cells in which nothing is found are UNTESTED, a finding of its own says
so, and the exit code is 1. What only the whole check tells is listed as not checked.

Not detected: cells that are dead from the first recording to the last, that move by themselves,
late, in part, or as another one does, drift and noise, and what the whole array shares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.facts.rates import Clock
from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.code import Need
from adaptfault.inspection.data_set import DataSetCheck
from adaptfault.inspection.findings import Unchecked
from adaptfault.inspection.result import Inspection, faults_and_frames, finding_of
from diagnostics import Diagnosis, SensorLayout, TransportFault
from diagnostics.decision.by_recording import with_recordings
from diagnostics.preprocessing.load import LoadDirection
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.tolerance import tolerance_of
from diagnostics.when import find_held

if TYPE_CHECKING:
    from adaptfault.inspection.quick_statistics import Statistics

_LISTED = 5
_OF_FRAMES = "times of the frames: parts that are merged do not hold them"

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

    @property
    def unchecked(self) -> tuple[Unchecked, ...]:
        """What was not checked, with what would check it."""
        diagnosis = self.inspection.diagnosis
        layout = diagnosis.layout
        left = layout.is_cell & ~diagnosis.fault_set.mask
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


def quick(statistics: Statistics) -> Quick:
    """Return what one pass over a data set tells, of which these are the statistics."""
    layout = statistics.layout
    planes = layout
    order = np.arange(layout.n_cells)
    if layout.axes > 1:
        from diagnostics.preprocessing.checked import axis_planes

        planes, order = axis_planes(layout)
    place = np.argsort(order)
    sample = RecordingBlocks([frames[:, order] for frames in statistics.sample])
    tolerance = tolerance_of(sample, planes)
    spans = statistics.spans.of_cells(order)
    load = LoadDirection.fit(sample, planes)
    if load is not None:
        spans = spans.loads(load)
    lengths = statistics.naming.lengths
    held = find_held(spans, planes, tolerance, statistics.classes)
    if load is not None:
        held = replace(held, value=load.readings(held.value, np.zeros(len(place), bool)))
    held = held.of(place)
    diagnosis = Diagnosis.untold(layout, lengths, transport=_transport(statistics))
    diagnosis = with_recordings(diagnosis, held, lengths, tolerance, None)
    together = statistics.together.of_cells(order)
    present = layout.is_cell
    answers = together.answers(spans)[place] & present
    moves = np.asarray(together.moves(spans).any(axis=0))[place] & present
    findings = faults_and_frames(diagnosis)
    left = int((present & ~diagnosis.fault_set.mask).sum())
    if left:
        text = (
            f"{left} of {int(present.sum())} cells were not tested, so faults may be hidden:"
            f" {int((answers & ~diagnosis.fault_set.mask).sum())} of them answer together with"
            " those beside them, which proves none alive; run the whole check, without --quick"
        )
        findings.append(finding_of("untested", text))
    readings = ChangedReadings(None, None, [], diagnosis)
    return Quick(Inspection(readings, tuple(findings)), answers, moves)


def quick_check(
    statistics: Statistics,
    found: Quick,
    clock: Clock | None,
    *,
    grouped: bool = False,
    source: str = "",
) -> DataSetCheck:
    """Return the health of a data set, from a quick check of it.

    Args:
        statistics: of its recordings.
        found: from them.
        clock: of its frames; None: they are merged parts, of which it is not known.
        grouped: whether anything else than classes divides the recordings.
        source: what the data set is called.
    """
    naming = statistics.naming
    begun, tared = statistics.begins.in_contact(naming.recordings, statistics.layout)
    left = found.unchecked
    if clock is None:
        clock = Clock()
        left += (Unchecked(_OF_FRAMES, ("TOUCH-147", "TOUCH-148", "TOUCH-149")),)
    given: set[Need] = set()
    if clock.jitter is not None:
        given.add("times")
    if statistics.classes is not None or grouped:
        given.add("classes")
    return DataSetCheck(
        naming.of_inspection(found.inspection),
        statistics.summary,
        clock,
        len(statistics.unread),
        begun,
        tared,
        frozenset(given),
        source,
        naming,
        "quick",
        left,
        stood_still=statistics.stands_still.told(naming.recordings),
    )


def _transport(statistics: Statistics) -> tuple[TransportFault, ...]:
    """Return that frames repeat, where they do."""
    repeated = statistics.repetitions.told
    if repeated is None:
        return ()
    text = repeated.reason(statistics.layout.rate)
    return (TransportFault("repeated_frames", 0, statistics.repetitions.repeated, text),)


def _places(cells: NDArray[np.intp], layout: SensorLayout) -> str:
    """Return where the first cells are."""
    places = [layout.place(cell) for cell in cells[:_LISTED].tolist()]
    more = f"; and {len(cells) - _LISTED} more" if len(cells) > _LISTED else ""
    return f"{'; '.join(places)}{more}"
