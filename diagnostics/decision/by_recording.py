"""When a cell failed: verdicts by recording, and faults that show in some recordings only.

The whole log tells what is faulty at its end. Recordings in which cells hold a value although those
beside them move (:mod:`diagnostics.when`) are diagnosed as a log of their own; what that finds
besides shows in these recordings. Cells whose held values are certain are faulty in any case; what
is suspect and not proven is possible, and so is what holds a value again and again
(:mod:`diagnostics.when.held_again`). What was not tested and reads little of what the cells on both
sides read may be worn (:mod:`diagnostics.when.weak`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.result import Diagnosis, Verdict
from diagnostics.faults import Fault, FaultKind
from diagnostics.preprocessing.levels import LEAST_LOADED, MAJORITY
from diagnostics.when.recording_numbers import ranges
from diagnostics.wiring import Line

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.when import Held

_LISTED = 5  # places in a sentence
_PARTS = 4  # sets of recordings that are diagnosed, at most: a size
_HOLDS = (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK)
_COMES = (*_HOLDS, FaultKind.INTERMITTENT)
# kinds that a cell shows however the others move
_OF_ANY_MOVEMENT = (*_HOLDS, FaultKind.ALIAS, FaultKind.NOISY)

Cells = NDArray[np.intp]
Recordings = tuple[int, ...]


@dataclass(frozen=True)
class _State:
    """Recordings in which some cells are suspect."""

    recordings: Recordings
    cells: Cells


@dataclass(frozen=True)
class _Faults:
    """Faults, their cells (bool ``[D]``), and P(cell is faulty) ``[D]``."""

    faults: list[Fault]
    cells: NDArray[np.bool_]
    probability: NDArray[np.float64]

    def add(self, fault: Fault, least: float | NDArray[np.float64] = 0.0) -> None:
        """Add a fault, whose cells have at ``least`` this probability."""
        cells = list(fault.cells)
        self.faults.append(fault)
        self.cells[cells] = True
        self.probability[cells] = np.maximum(self.probability[cells], least)


def with_recordings(
    whole: Diagnosis,
    held: Held,
    lengths: Sequence[int],
    tolerance: float,
    diagnose: Callable[[Recordings], Diagnosis] | None,
) -> Diagnosis:
    """Return the diagnosis of a log with what shows in some of its recordings only; of one
    recording, the diagnosis.

    Args:
        whole: the diagnosis of the log.
        held: where cells hold a value although those beside them move, in the order of the layout.
        lengths: frames of each recording.
        tolerance: readings within +- this of a value count as that value.
        diagnose: diagnoses some recordings as a log of their own; None: they are not at hand.
    """
    if len(lengths) < 2:
        return whole
    # What an object holds, or its edge, is no held value of a cell.
    held = replace(held, suspect=held.suspect & ~whole.disturbed.mask)
    first = np.concatenate([[0], np.cumsum(lengths)]).tolist()
    # What comes and goes by recording is told better by the recordings in which it shows.
    partly = [fault for fault in whole.faults if _comes_and_goes(fault, held)]
    told = _Faults([], np.zeros(len(whole.probability), bool), whole.probability.copy())
    for fault in whole.faults:
        if fault not in partly:
            told.add(_located(fault, held, first))
    for state in _states(held)[:_PARTS]:
        if diagnose is None or told.cells[state.cells].all():
            continue
        part = diagnose(state.recordings)
        new = [fault for fault in part.faults if _is_new(fault, told)]
        # of so many sets of recordings one or the other shows something by chance
        if max((fault.probability or 0.0 for fault in new), default=0.0) < _sure(len(lengths)):
            continue
        for fault in new:
            if _is_new(fault, told):
                shown = _shown_in(state.recordings, fault, first)
                told.add(shown, part.probability[list(fault.cells)])
    for fault in partly:
        if not told.cells[list(fault.cells)].all():
            told.add(_located(fault, held, first))
    certain = held.certain.any(axis=0) & ~told.cells
    for fault in _held_faults(certain, held, whole.layout, tolerance):
        assert fault.recordings is not None
        told.add(_shown_in(fault.recordings, fault, first), fault.probability or 0.0)
    return _with_states(whole, held, told, tolerance, first)


def _is_new(fault: Fault, told: _Faults) -> bool:
    """Return whether no cell of a fault was told, or not all of a wire."""
    at = told.cells[list(fault.cells)]
    return not at.all() and (fault.line is not None or not at.any())


def _sure(recordings: int) -> float:
    """Return the P(faulty) that remains 1/2 among all sets of successive recordings."""
    sets = recordings * (recordings + 1) / 2
    return sets / (sets + 1)


def _with_states(
    whole: Diagnosis, held: Held, told: _Faults, tolerance: float, first: Sequence[int]
) -> Diagnosis:
    """Return the diagnosis with these faults, with what is possible beside them, and with the
    verdicts in each recording."""
    last = len(first) - 2
    suspect = held.suspect.any(axis=0)
    again = held.again & ~(suspect | whole.disturbed.mask | told.cells)
    doubted = suspect | again.any(axis=0)
    little = np.isfinite(held.share) & ~(whole.tested | whole.disturbed.mask | doubted | told.cells)
    unproven = _held_faults(suspect & ~told.cells, held, whole.layout, tolerance)
    result = replace(
        whole,
        faults=tuple(told.faults),
        probability=told.probability,
        tested=(whole.tested & ~doubted) | told.cells,
        possible=(
            *whole.possible,
            *(
                _told(replace(fault, reason=f"perhaps {fault.reason}: press on it to tell"), last)
                for fault in unproven
            ),
            *_again_possible(again, whole.layout),
            *_weak_possible(little, held.share, whole.layout),
        ),
    )
    alive = held.moved & ~held.suspect & ~again & (whole.tested | result.fault_set.mask)
    return replace(result, states=_verdicts(result, alive, first))


def _states(held: Held) -> list[_State]:
    """Return the sets of recordings in which cells are suspect; sets that hardly differ are one."""
    states: list[_State] = []
    for recordings, cells in held.states():
        for k, other in enumerate(states):
            either = set(recordings) | set(other.recordings)
            differ = set(recordings) ^ set(other.recordings)
            if len(differ) <= LEAST_LOADED * len(either):
                states[k] = _State(tuple(sorted(either)), np.append(other.cells, cells))
                break
        else:
            states.append(_State(recordings, cells))
    return states


def _comes_and_goes(fault: Fault, held: Held) -> bool:
    """Return whether most cells of an intermittent fault are suspect in some recordings."""
    suspect = held.suspect[:, list(fault.cells)].any(axis=0)
    return fault.kind is FaultKind.INTERMITTENT and bool(suspect.mean() > MAJORITY)


def _located(fault: Fault, held: Held, first: Sequence[int]) -> Fault:
    """Return a fault of the whole log with its recordings, where its cells are suspect in some that
    are not the last ones."""
    of_cells = held.suspect[:, list(fault.cells)]
    each = of_cells.sum(axis=1) >= max(1, of_cells.any(axis=0).sum() / 2)
    recordings = np.flatnonzero(each)
    lasts = len(recordings) == 0 or len(recordings) == len(each) - recordings[0]
    if lasts or fault.kind not in _COMES:
        return fault
    return _shown_in(tuple(recordings.tolist()), fault, first)


def _shown_in(recordings: Recordings, fault: Fault, first: Sequence[int]) -> Fault:
    """Return a fault that shows in some recordings."""
    shown = replace(fault, recordings=recordings, onset=first[recordings[0]])
    return _told(shown, len(first) - 2)


def _told(fault: Fault, last: int) -> Fault:
    """Return a fault whose sentence names its recordings; ``last``: number of the last of all."""
    recordings = fault.recordings
    if recordings is None or len(recordings) > last:
        return replace(fault, recordings=None, onset=None)
    gone = "" if recordings[-1] == last else "; it works again after them"
    where = "recording" if len(recordings) == 1 else "recordings"
    text = f"{fault.reason} (in {where} {ranges(recordings)}{gone})"
    return replace(fault, reason=text)


def _held_faults(
    certain: NDArray[np.bool_], held: Held, layout: SensorLayout, tolerance: float
) -> list[Fault]:
    """Return a fault for each certain cell (bool ``[D]``), and one for each line of them."""
    left = certain.copy()
    faults = []
    for line in layout.lines:
        cells = layout.cells_on(line)
        one_set = len(cells) > 1 and left[cells].all()
        if one_set and (held.suspect[:, cells] == held.suspect[:, cells[:1]]).all():
            faults.append(_held_fault(cells, line, held, layout, tolerance))
            left[cells] = False
    for cell in np.flatnonzero(left).tolist():
        faults.append(_held_fault(np.array([cell]), None, held, layout, tolerance))
    return faults


def _held_fault(
    cells: Cells, line: Line | None, held: Held, layout: SensorLayout, tolerance: float
) -> Fault:
    """Return the fault of cells that hold a value in some recordings."""
    value = float(np.median(held.value[cells]))
    kind = FaultKind.STUCK
    if value <= 2 * tolerance:
        kind = FaultKind.OPEN
    elif value >= layout.full_scale - 2 * tolerance:
        kind = FaultKind.SHORT
    where = layout.place(int(cells[0])) if line is None else str(line)
    recordings = tuple(np.flatnonzero(held.suspect[:, cells[0]]).tolist())
    return Fault(
        kind,
        tuple(cells.tolist()),
        line=line,
        value=value,
        probability=float(held.probability[cells].min()),
        reason=f"{where} {kind.verb()} at {value:.4g} {layout.unit}, while the cells beside move",
        evidence=len(recordings),
        recordings=recordings,
    )


def _again_possible(again: NDArray[np.bool_], layout: SensorLayout) -> list[Fault]:
    """Return a possible fault for each set of recordings in which cells hold a value again and
    again (bool ``[n, D]``)."""
    cells_of: dict[Recordings, list[int]] = {}
    for cell in np.flatnonzero(again.any(axis=0)).tolist():
        shown = tuple(np.flatnonzero(again[:, cell]).tolist())
        cells_of.setdefault(shown, []).append(cell)
    faults = []
    for shown, cells in cells_of.items():
        places = _listed([layout.place(cell) for cell in cells])
        hold = "holds" if len(cells) == 1 else "hold"
        reason = (
            f"{places} {hold} the same value away from rest all through recordings"
            f" {ranges(shown)}, while cells beside move: dead there, or something lies on them; not"
            " tested"
        )
        faults.append(
            Fault(
                FaultKind.STUCK,
                tuple(cells),
                probability=MAJORITY,
                reason=reason,
                evidence=len(shown),
                recordings=shown,
            )
        )
    return faults


def _weak_possible(
    little: NDArray[np.bool_], share: NDArray[np.float64], layout: SensorLayout
) -> list[Fault]:
    """Return a possible fault for the cells of each pad (bool ``[D]``) that read a ``share``
    (``[D]``) of what the cells on both sides read."""
    faults = []
    for pad in np.unique(layout.pad_of[little]):
        cells = np.flatnonzero(little & (layout.pad_of == pad)).tolist()
        places = _listed([f"{layout.place(cell)} ({share[cell]:.2f})" for cell in cells])
        reads = "reads" if len(cells) == 1 else "read"
        reason = (
            f"{places} {reads} this share of what the cells on both sides read, in"
            " nearly every contact: perhaps worn; not tested, as no reference tells what is usual"
        )
        faults.append(
            Fault(
                FaultKind.WEAK,
                cells,
                value=float(np.median(share[cells])),
                probability=MAJORITY,
                reason=reason,
            )
        )
    return faults


def _listed(places: Sequence[str]) -> str:
    """Return the first places, and how many more there are."""
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return f"{'; '.join(places[:_LISTED])}{more}"


def _verdicts(
    diagnosis: Diagnosis, alive: NDArray[np.bool_], first: Sequence[int]
) -> NDArray[np.uint8]:
    """Return the verdict of each cell in each recording, ``[n, D]``.

    A cell is ALIVE where it moved, is not suspect, and the whole log has tested it.
    """
    code = np.where(alive, Verdict.ALIVE, Verdict.UNTESTED).astype(np.uint8)
    number = np.arange(len(code))
    ends = np.array(first[1:])
    for fault in diagnosis.faults:
        shows = ends > (fault.onset or 0)
        if fault.recordings is not None:
            shows = np.isin(number, fault.recordings)
        code[np.ix_(shows, np.array(fault.cells))] = Verdict.FAULTY
    return code


def of_any_movement(found: Diagnosis, suspect: NDArray[np.bool_]) -> Diagnosis:
    """Return what is ``found`` of recordings of which it is not known how healthy cells move: told
    is what holds a value (``suspect``: bool ``[n, D]``), or is noisy; the others are untested."""
    holds = np.asarray(suspect.any(axis=0))
    told = []
    unknown = np.zeros(len(holds), bool)
    for fault in found.faults:
        if fault.kind in _OF_ANY_MOVEMENT or holds[list(fault.cells)].any():
            told.append(fault)
        else:
            unknown[list(fault.cells)] = True
    doubted = np.minimum(found.probability, MAJORITY)
    return replace(
        found,
        faults=tuple(told),
        probability=np.where(unknown, doubted, found.probability),
        tested=found.tested & ~unknown,
    )
