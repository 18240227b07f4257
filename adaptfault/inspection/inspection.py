"""Inspection of a log: everything that is told of it.

What all cells share is explained first: it is taken out where it can be, and where that leaves
fewer faults. Then the wiring and replaced pads are undone, and then cells are judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.coincidence import coinciding
from adaptfault.inspection.converter_range import within_range
from adaptfault.inspection.find_changes import find_changed_readings, find_sensor_change
from adaptfault.inspection.result import Finding, Inspection, finding_of, of_diagnosis
from diagnostics import Diagnosis, FaultSet, SelfDiagnosis, SensorLayout
from diagnostics.diagnosis import checked_recordings
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.sensor.common_mode import CommonMode, find_common_mode
from diagnostics.sensor.converter_change import find_converter_change
from diagnostics.sensor.disturbance import Disturbance, find_disturbances, find_sentinel
from diagnostics.sensor.gain import GAIN
from diagnostics.sensor.sensor_change import SensorChange, amplification
from diagnostics.sensor.shared import measured

_OF_ALL_CELLS = ("quantised", "saturated", "normalised")

_EXPLAIN_A_CHANGE = ("normalised", "ramp", "hum", "crosstalk")


def inspect(
    recordings: ArrayLike | Sequence[ArrayLike],
    diagnoser: SelfDiagnosis,
    *,
    reference: ArrayLike | Sequence[ArrayLike] | None = None,
    classes: ArrayLike | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Inspection:
    """Return everything that a log tells about a sensor.

    Args:
        recordings: the log, ``[T, D]`` or a list of them, in the layout's unit, in time order.
        diagnoser: fitted on healthy recordings of the same array; one that is not fitted is a cold
            start, for which see :meth:`diagnostics.SelfDiagnosis.for_log`.
        reference: these recordings. None: nothing is compared with them.
        classes: the class of each recording of the log, ``[n]``, with which a fault may coincide;
            None: unknown.
        progress: receives the share of the fit that is done, where a cold start fits to the log, or
            where the converter changed and the reference is learned as it would read it.

    Raises:
        ValueError: recordings that do not fit the layout, or hold no frame.
    """
    layout = diagnoser.layout
    shared = diagnoser.shared(recordings)
    given = list(RecordingBlocks(shared.recordings))
    log = [within_range(frames, layout)[0] for frames in given]
    healthy = [] if reference is None else _usable(reference, layout)
    if shared.explains_all:
        diagnosis = shared.diagnosis()
        alone = ChangedReadings(None, None, log, diagnosis)
        return Inspection(alone, tuple(of_diagnosis(diagnosis)))
    disturbances = _disturbances(given, log, healthy, layout)
    if any(one.name == "silent_array" for one in disturbances):
        findings = [_finding(one) for one in disturbances]
        return Inspection(ChangedReadings(None, None, log, _untold(log, layout)), tuple(findings))
    crosstalk = shared.crosstalk is not None
    if diagnoser.reference_ is None:
        fitted = diagnoser.for_log(log, classes=classes, progress=progress)
        alone = ChangedReadings(None, None, log, fitted.diagnose(log, classes=classes))
        told = _Told(alone, None, disturbances)
        if not crosstalk:
            told.change = _change(alone, healthy, diagnoser, disturbances)
    else:
        told = _compared(given, log, healthy, diagnoser, disturbances, crosstalk, progress)
    if told.common is not None:
        told.disturbances.append(told.common.disturbance)
    if told.change is not None:  # measures it
        told.disturbances = [one for one in told.disturbances if one.name != "offset"]
    readings = replace(told.readings, diagnosis=shared.told(told.readings.diagnosis))
    findings = [
        *_of_readings(readings),
        *(_finding(one) for one in told.disturbances),
        *_of_change(told.change),
        *of_diagnosis(readings.diagnosis),
    ]
    if classes is not None:
        findings += [
            finding_of("coincides", text) for text in coinciding(readings.diagnosis, classes)
        ]
    return Inspection(readings, tuple(findings), told.change, told.common)


def _usable(
    reference: ArrayLike | Sequence[ArrayLike], layout: SensorLayout
) -> list[NDArray[np.float64]]:
    """Return the recordings of a reference as :func:`inspect` compares them."""
    usable = RecordingBlocks(measured(checked_recordings(reference, layout), layout))
    return [within_range(frames, layout)[0] for frames in usable]


@dataclass
class _Told:
    """What is told of a log, but for its cells and wires.

    Attributes:
        readings: with what changed between cells and readings.
        common: the common mode that they do without.
        disturbances: of the array.
        change: of a pad or of the sensor.
    """

    readings: ChangedReadings
    common: CommonMode | None
    disturbances: list[Disturbance]
    change: SensorChange | None = None


def _compared(
    given: list[NDArray[np.float64]],
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    disturbances: list[Disturbance],
    crosstalk: bool,
    progress: Callable[[float], None],
) -> _Told:
    """Return what is told of a log beside the reference that the diagnosis is fitted to.

    Args:
        given, log, healthy, disturbances: as for :func:`_disturbances`, and what it returned.
        crosstalk: the lines of the log have it, which the cells of a pad share, too.
        progress: of a fit to the reference as a changed converter would read it.
    """
    layout = diagnoser.layout
    disturbed = crosstalk or any(one.name in _OF_ALL_CELLS for one in disturbances)
    compared = [] if crosstalk else healthy
    told = _Told(*_judged(log, compared, diagnoser, disturbed=disturbed), disturbances)
    others = _without_groups(log, told.readings.diagnosis)
    if others is not None:  # what a bus does is no disturbance of all
        told.disturbances = _disturbances(given, others, healthy, layout)
    if crosstalk:
        return told
    converter = None
    if diagnoser.load_ is None:
        converter = find_converter_change(log, healthy, layout, told.disturbances)
    if converter is not None:
        seen = converter.of(healthy)
        behind = SelfDiagnosis(**diagnoser.get_params()).fit(seen, progress=progress)
        readings, common = _judged(log, seen, behind, disturbed=disturbed)
        if len(readings.diagnosis.fault_set) <= len(told.readings.diagnosis.fault_set):
            told.readings = readings
            told.common = common
            diagnoser = behind
            healthy = seen
            if max(converter.gain, 1 / converter.gain) >= GAIN:
                told.change = amplification(converter.gain, len(log))
                return told
    shifted = [*told.disturbances]
    if told.common is not None:
        shifted.append(told.common.disturbance)
    left_in = _with_offset(told.readings, told.common, log)
    told.change = _change(left_in, healthy, diagnoser, shifted)
    return told


def _disturbances(
    given: list[NDArray[np.float64]],
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    layout: SensorLayout,
) -> list[Disturbance]:
    """Return the disturbances of a log but for a common mode; ``log`` is ``given`` within the
    converter's range."""
    sentinel = find_sentinel(given, layout)
    found = [] if sentinel is None else [sentinel]
    if any(np.isfinite(frames[:, layout.present.ravel()]).any() for frames in log):
        return found + find_disturbances(log, healthy, layout)
    return [
        *found,
        Disturbance("silent_array", 0.0, "no cell has a reading in the range of the converter"),
    ]


def _without_groups(
    log: list[NDArray[np.float64]], diagnosis: Diagnosis
) -> list[NDArray[np.float64]] | None:
    """Return a log without the readings of wires that are faulty as a whole; None without any, and
    where no other cell is left."""
    cells = [cell for fault in diagnosis.faults if fault.line is not None for cell in fault.cells]
    faulty = FaultSet(tuple(cells), diagnosis.layout.n_cells).mask
    left = diagnosis.layout.present.ravel() & ~faulty
    if not cells or not left.any():
        return None
    return [np.where(faulty, np.nan, frames) for frames in log]


def _judged(
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    *,
    disturbed: bool,
) -> tuple[ChangedReadings, CommonMode | None]:
    """Return the diagnosis of a log, and the common mode that it does without; None: the log as it
    is.

    A common mode is one explanation beside the faults that it explains away. ``disturbed``: other
    disturbances are known.
    """
    common = find_common_mode(log, healthy, diagnoser.layout) if healthy else None
    if common is not None:  # where all cells read more, so does what they share
        usual = diagnoser.without_gain(log)
        if usual is not None and find_common_mode(list(usual), healthy, diagnoser.layout) is None:
            common = None
    as_it_is = find_changed_readings(
        diagnoser,
        log,
        healthy,
        disturbed=disturbed or common is not None,
        comparable=not disturbed,
    )
    if common is None:
        return as_it_is, None
    undone = common.undo(log, diagnoser.layout)
    without = find_changed_readings(
        diagnoser, undone, healthy, disturbed=True, comparable=not disturbed
    )
    explanations = len(without.diagnosis.faults) + 1
    if explanations > len(as_it_is.diagnosis.faults) and _is_group(as_it_is.diagnosis):
        return as_it_is, None
    if without.diagnosis.n_lost > as_it_is.diagnosis.n_lost:
        return as_it_is, None
    return without, common


def _is_group(diagnosis: Diagnosis) -> bool:
    """Return whether a bus or a converter is among the faults: its cells share what they read, as
    those of a common mode."""
    kinds = {fault.line.kind for fault in diagnosis.faults if fault.line is not None}
    return not kinds.isdisjoint(("converter", "bus", "group", "position"))


def _with_offset(
    readings: ChangedReadings, common: CommonMode | None, log: list[NDArray[np.float64]]
) -> ChangedReadings:
    """Return the readings with a constant shift left in: it is a change of the sensor."""
    if common is None or common.disturbance.name != "offset" or readings.reason:
        return readings
    return replace(readings, frames=log)


def _change(
    readings: ChangedReadings,
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    disturbances: list[Disturbance],
) -> SensorChange | None:
    """Return what changed of a pad or of the sensor, unless a disturbance explains it."""
    if not healthy or any(one.name in _EXPLAIN_A_CHANGE for one in disturbances):
        return None
    return find_sensor_change(diagnoser, readings, healthy)


def _of_readings(readings: ChangedReadings) -> list[Finding]:
    """Return exchanged wires, or replaced pads."""
    if readings.another is not None:
        return [finding_of("another_sensor", readings.another.reason)]
    if readings.in_part is not None:
        return [finding_of("swapped_in_part", readings.in_part.reason)]
    if readings.rewiring is not None:
        return [finding_of("rewired", readings.reason)]
    if readings.recalibration is not None:
        return [finding_of("replaced_pad", readings.reason)]
    return []


def _of_change(change: SensorChange | None) -> list[Finding]:
    """Return a change of gain, or else of offset."""
    if change is None:
        return []
    return [finding_of("gain" if change.gain != 1.0 else "offset", change.reason)]


def _finding(disturbance: Disturbance) -> Finding:
    return finding_of(disturbance.name, disturbance.reason)


def _untold(log: list[NDArray[np.float64]], layout: SensorLayout) -> Diagnosis:
    """Return a diagnosis that judges no cell."""
    return Diagnosis(
        layout=layout,
        faults=(),
        probability=np.zeros(layout.n_cells),
        tested=np.zeros(layout.n_cells, bool),
        n_frames=sum(map(len, log)),
        n_recordings=len(log),
    )
