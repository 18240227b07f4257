"""The search for changed readings: exchanged wires and replaced pads of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.inspection.changed_readings import ChangedReadings, Frames
from diagnostics import Diagnosis, FaultKind, FaultSet, SelfDiagnosis, SensorLayout
from diagnostics.preprocessing.levels import EXPECTED, LEAST_LOADED, MAJORITY
from diagnostics.sensor.another_sensor import AnotherSensor, find_another_sensor
from diagnostics.sensor.disturbance import rest_of
from diagnostics.sensor.recalibration import Recalibration, find_recalibration
from diagnostics.sensor.rewiring import Rewiring
from diagnostics.sensor.sensor_change import SensorChange, find_change
from diagnostics.sensor.swapped_in_part import newest_contradict

_OF_ANY_SENSOR = (
    FaultKind.OPEN,
    FaultKind.SHORT,
    FaultKind.STUCK,
    FaultKind.ALIAS,
    FaultKind.COPY,
)

_OF_GAIN = (FaultKind.WEAK, FaultKind.DRIFT, FaultKind.INTERMITTENT)

FEWEST = 12
"""Recordings of a log, in whose halves a change is found again."""


def find_changed_readings(
    diagnoser: SelfDiagnosis,
    frames: Frames,
    healthy: Sequence[NDArray[Any]],
    *,
    disturbed: bool = False,
    comparable: bool = True,
) -> ChangedReadings:
    """Return what changed between cells and readings, and the diagnosis with it undone.

    Args:
        diagnoser: fitted, or not: then nothing is found.
        frames: recordings ``[T, D]``, as the running version undoes them.
        healthy: those of the reference, with which pads are compared.
        disturbed: a disturbance of the array may explain what differs: then no pad counts as
            replaced, and wires as exchanged only where fewer cells are faulty once they are put
            back.
        comparable: readings are neither cut off nor rounded otherwise than the reference: they tell
            one sensor from another.
    """
    exchanged = _put_back(diagnoser, frames)
    unexplained = False  # wires look exchanged, and that does not explain the log
    if exchanged is not None and comparable:
        still = _another(diagnoser, exchanged, healthy)
        if still is not None and (still.is_whole or exchanged.in_part is not None):
            exchanged = None
            unexplained = True
    as_found = ChangedReadings(None, None, frames, diagnoser.diagnose(frames))
    if exchanged is not None and disturbed:
        explains = exchanged.diagnosis.n_lost < as_found.diagnosis.n_lost
        exchanged = exchanged if explains else None
    another = None
    if exchanged is None and comparable:
        suspect = unexplained or _of_this_sensor(as_found.diagnosis)
        another = _another(diagnoser, as_found, healthy, suspect=suspect)
        if another is None:
            own = _as_own_reference(diagnoser, as_found, healthy)
            if own is not None:
                return own
    if another is not None and not another.is_whole:
        left = another.left_out(frames)
        return ChangedReadings(None, None, left, _left(diagnoser.diagnose(left)), another=another)
    if disturbed and exchanged is None:
        return as_found if another is None else _as_another(as_found, another)
    replaced = _with_new_gains(diagnoser, as_found, healthy, exchanged, another)
    if replaced is not None:
        return as_found if disturbed else replaced
    if another is not None:
        return _as_another(as_found, another)
    return exchanged or as_found


def _as_another(as_found: ChangedReadings, another: AnotherSensor) -> ChangedReadings:
    """Return a log of another sensor."""
    diagnosis = _of_any_sensor(as_found.diagnosis, another.pads, another.unlike)
    return replace(as_found, diagnosis=diagnosis, another=another)


def _as_own_reference(
    diagnoser: SelfDiagnosis, as_found: ChangedReadings, healthy: Sequence[NDArray[Any]]
) -> ChangedReadings | None:
    """Return a log of another sensor of which the reference calls so many cells faulty that the
    others do not tell it: it is its own reference. None where most of these are faulty then, too,
    or the log is of the same sensor."""
    layout = diagnoser.layout
    explained = _explained(as_found.diagnosis)[layout.is_cell]
    if not as_found.diagnosis.fault_set or explained.mean() <= MAJORITY / 2:
        return None
    another = _another(diagnoser, as_found, healthy, with_faulty=True)
    if another is None or not another.is_whole:
        return None
    own = SelfDiagnosis(layout).diagnose(as_found.frames)
    diagnosis = _on_pads(as_found.diagnosis, own, another.pads)
    if diagnosis.n_lost > as_found.diagnosis.n_lost / 2:
        return None
    return replace(as_found, diagnosis=diagnosis, another=another)


def _on_pads(diagnosis: Diagnosis, own: Diagnosis, pads: Sequence[int]) -> Diagnosis:
    """Return a diagnosis with what another one tells of some pads."""
    on = np.isin(diagnosis.layout.pad_of, pads)
    if on.all():
        return replace(own, names=diagnosis.names)

    def both(ours: Sequence[Any], theirs: Sequence[Any]) -> tuple[Any, ...]:
        kept = [one for one in ours if not on[[*one.cells]].any()]
        return (*kept, *(one for one in theirs if on[[*one.cells]].all()))

    return replace(
        diagnosis,
        faults=both(diagnosis.faults, own.faults),
        possible=both(diagnosis.possible, own.possible),
        static_loads=both(diagnosis.static_loads, own.static_loads),
        tested=np.where(on, own.tested, diagnosis.tested),
        probability=np.where(on, own.probability, diagnosis.probability),
        states=None,
    )


def _explained(diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """Return the cells, bool ``[D]``, that faults or objects explain: another sensor is told by
    those that are left."""
    return _faulty(diagnosis) | diagnosis.disturbed.mask


def _another(
    diagnoser: SelfDiagnosis,
    as_found: ChangedReadings,
    healthy: Sequence[NDArray[Any]],
    *,
    with_faulty: bool = False,
    suspect: bool = False,
) -> AnotherSensor | None:
    """Return which recordings come from another sensor than the reference; None: none, or nothing
    tells.

    Args:
        diagnoser, as_found, healthy: of the log and the reference.
        with_faulty: also by cells that are faulty as the reference has it, which may be healthy
            ones of another sensor.
        suspect: cells or wires are found faulty that another sensor would explain.
    """
    load = diagnoser.load_
    both_ways = diagnoser.layout.axes > 1 or (load is not None and load.direction == "middle")
    if diagnoser.reference_ is None or (both_ways and not suspect):
        return None
    diagnosis = as_found.diagnosis
    frames = diagnoser.without_gain(as_found.frames) or as_found.frames
    excluded = _explained(diagnosis)
    if with_faulty:
        excluded = np.ptp(np.concatenate(frames), axis=0) == 0
    loads = as_loads(diagnoser, list(frames))
    reference = as_loads(diagnoser, healthy)
    asked = reference, diagnoser.reference_, diagnoser.layout, excluded
    found = find_another_sensor(loads, *asked, suspect=suspect, both_ways=both_ways)
    if found is None:
        return None
    # what all cells of a pad read more is an offset of it
    same_rest = _without_offsets(loads, reference, diagnoser.layout)
    again = find_another_sensor(same_rest, *asked, suspect=suspect, both_ways=both_ways)
    return None if again is None else found


def _without_offsets(
    loads: Sequence[NDArray[Any]], reference: Sequence[NDArray[Any]], layout: SensorLayout
) -> list[NDArray[Any]]:
    """Return loads ``[T, D]`` without the offset of each pad, by which most of its cells rest
    higher than in the reference, all alike: those of another sensor differ."""
    higher = rest_of(loads, layout) - rest_of(reference, layout)
    offset = np.zeros(layout.n_cells)
    for pad in range(layout.pads):
        on = layout.pad_of == pad
        known = higher[on & np.isfinite(higher)]
        if not len(known):
            continue
        low, middle, high = np.quantile(known, [LEAST_LOADED, 0.5, 1 - LEAST_LOADED]).tolist()
        if high - low < MAJORITY * abs(middle):
            offset[on] = middle
    return [frames - offset for frames in loads]


def _of_this_sensor(diagnosis: Diagnosis) -> bool:
    """Return whether a fault is told by how much cells of this sensor should read. One cell that
    moves by itself is rather a fault than another sensor, and so are those that come late."""
    if any(fault.kind in _OF_GAIN for fault in diagnosis.faults):
        return True
    others = (*_OF_ANY_SENSOR, FaultKind.LATE)
    return sum(len(fault.cells) for fault in diagnosis.faults if fault.kind not in others) > 1


def _left(diagnosis: Diagnosis) -> Diagnosis:
    """Return the diagnosis of a log of which recordings are left out: these are not lost."""
    transport = tuple(one for one in diagnosis.transport if one.kind != "lost")
    return replace(diagnosis, transport=transport)


def _of_any_sensor(
    diagnosis: Diagnosis, pads: Sequence[int], unlike: Sequence[int] = ()
) -> Diagnosis:
    """Return a diagnosis of pads that are not those of the reference: it tells which of their cells
    hold a value or repeat another, not how much they should read, but of those that are
    ``unlike`` any of them."""
    on = np.isin(diagnosis.layout.pad_of, pads) & ~np.isin(
        np.arange(diagnosis.layout.n_cells), unlike
    )
    holds = [fault for fault in diagnosis.faults if fault.kind in _OF_ANY_SENSOR]
    faults = [fault for fault in diagnosis.faults if fault in holds or not on[[*fault.cells]].all()]
    untold = diagnosis.fault_set.mask.copy()
    untold[[cell for fault in faults for cell in fault.cells]] = False
    return replace(
        diagnosis,
        faults=tuple(faults),
        tested=diagnosis.tested & ~untold,
        probability=np.where(untold, EXPECTED, diagnosis.probability),
    )


def _with_new_gains(
    diagnoser: SelfDiagnosis,
    as_found: ChangedReadings,
    healthy: Sequence[NDArray[Any]],
    exchanged: ChangedReadings | None,
    another: AnotherSensor | None,
) -> ChangedReadings | None:
    """Return a log with replaced pads undone; None where none is, or where exchanged wires explain
    the log better. Cells of ``another`` sensor are judged as those of a replaced pad."""
    rival = None if exchanged is None else exchanged.frames
    recalibration = _recalibration(diagnoser, as_found, healthy, rival)
    if recalibration is None:
        return None
    full_scale = diagnoser.layout.full_scale
    undone = [recalibration.undo(recording, full_scale) for recording in as_found.frames]
    diagnosis = _of_any_sensor(diagnoser.diagnose(undone), recalibration.pads)
    if another is not None:
        others = set(another.pads) - set(recalibration.pads)
        diagnosis = _of_any_sensor(diagnosis, sorted(others), another.unlike)
    return ChangedReadings(None, recalibration, undone, diagnosis, as_found)


def doubt(readings: ChangedReadings, diagnoser: SelfDiagnosis) -> str | None:
    """Return why the change is no reason for a new version, in one sentence; None where it is.

    It must be found again, alike, in the older half of the log, in the newer half, and in the
    newest recordings: one part of a log does not decide about all that follows.

    Args:
        readings: of a log.
        diagnoser: fitted; with it the change was found.
    """
    if readings.recalibration is not None and not readings.recalibration.throughout:
        return "not each half of the recordings shows it by itself; record more"
    if readings.rewiring is None:
        return None
    n = len(readings.frames)
    if n < FEWEST:
        return f"{n} recordings do not prove it, record at least {FEWEST}"
    came = np.argsort(readings.rewiring.source)
    frames = [recording[:, came] for recording in readings.frames]
    halves = {"older": frames[: n // 2], "newer": frames[n // 2 :]}
    for name, half in halves.items():
        if not _found_again(diagnoser, half, readings.rewiring):
            return f"the {name} half of the recordings does not show it by itself, record more"
    assert diagnoser.reference_ is not None  # a rewiring was found with it
    loads = as_loads(diagnoser, frames)
    if newest_contradict(readings.rewiring, loads, diagnoser.reference_, diagnoser.layout):
        return "the newest recordings contradict it"
    return None


def _found_again(diagnoser: SelfDiagnosis, frames: Frames, rewiring: Rewiring) -> bool:
    """Return whether recordings show the same exchange of wires by themselves."""
    again = diagnoser.rewiring(frames)
    return again is not None and np.array_equal(again.source, rewiring.source)


def _put_back(diagnoser: SelfDiagnosis, frames: Frames) -> ChangedReadings | None:
    """Return a log with exchanged wires put back, in the recordings in which they are; None where
    none are, or only with a gain of the whole array: a pad that reads more is like another pad."""
    usual = diagnoser.without_gain(frames)
    in_part = diagnoser.swapped_in_part(frames)
    if in_part is not None and usual is not None:
        again = diagnoser.swapped_in_part(usual)
        if again is None or not np.array_equal(again.source, in_part.source):
            in_part = None
    if in_part is not None:
        put_back = in_part.undo(frames)
        return ChangedReadings(None, None, put_back, diagnoser.diagnose(put_back), in_part=in_part)
    rewiring = diagnoser.rewiring(frames)
    if rewiring is None:
        return None
    if usual is not None and not _found_again(diagnoser, list(usual), rewiring):
        return None
    put_back = [rewiring.undo(recording) for recording in frames]
    return ChangedReadings(rewiring, None, put_back, diagnoser.diagnose(put_back))


def find_sensor_change(
    diagnoser: SelfDiagnosis, readings: ChangedReadings, healthy: Sequence[NDArray[Any]]
) -> SensorChange | None:
    """Return how a pad, or all cells together, differ from the healthy recordings; None where they
    do not.

    Faulty cells, those of possible wires, and those that a static load may reach do not count.

    Args:
        diagnoser: fitted.
        readings: of the log.
        healthy: recordings ``[T, D]`` of the reference.
    """
    diagnosis = readings.diagnosis
    possible = tuple({cell for wire in diagnosis.possible for cell in wire.cells})
    excluded = (
        diagnosis.fault_set | diagnosis.disturbed | FaultSet(possible, diagnoser.layout.n_cells)
    )
    loads = as_loads(diagnoser, readings.frames)
    return find_change(loads, as_loads(diagnoser, healthy), diagnoser.layout, excluded)


def as_loads(diagnoser: SelfDiagnosis, recordings: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return recordings ``[T, D]`` as loads, where readings fall with the load or rest in the
    middle."""
    load = diagnoser.load_
    return list(recordings) if load is None else [load.loads(recording) for recording in recordings]


def _recalibration(
    diagnoser: SelfDiagnosis,
    as_found: ChangedReadings,
    healthy: Sequence[NDArray[Any]],
    rival: Frames | None,
) -> Recalibration | None:
    """Return how replaced pads read; None where none is replaced, or ``rival``, the log with wires
    put back, is more likely."""
    diagnosis = as_found.diagnosis
    if diagnoser.load_ is not None or diagnoser.reference_ is None or not healthy:
        return None
    held = diagnosis.statically_loaded.mask
    return find_recalibration(
        as_found.frames,
        healthy,
        diagnoser.reference_,
        diagnoser.layout,
        _faulty(diagnosis),
        held,
        rival=rival,
    )


def _faulty(diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """Return the faulty cells that tell nothing of a new pad, bool ``[D]``: many cells of one have
    other gains and offsets."""
    layout = diagnosis.layout
    faulty = diagnosis.fault_set.mask.copy()
    otherwise = np.zeros(layout.n_cells, bool)
    for fault in diagnosis.faults:
        otherwise[list(fault.cells)] = fault.kind in (FaultKind.DRIFT, FaultKind.WEAK)
    for pad in range(layout.pads):
        on = layout.is_cell & (layout.pad_of == pad)
        if (on & otherwise).sum() > LEAST_LOADED * on.sum():
            faulty[on & otherwise] = False
    return faulty
