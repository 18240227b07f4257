"""Inspection of a log: everything that is told of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

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

    What all cells share is explained first: it is taken out where it can be, and where that leaves
    fewer faults. Then the wiring and replaced pads are undone, and then cells are judged.

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
    healthy: list[NDArray[np.float64]] = []
    if reference is not None:
        usable = RecordingBlocks(measured(checked_recordings(reference, layout), layout))
        healthy = [within_range(frames, layout)[0] for frames in usable]
    if shared.explains_all:
        diagnosis = shared.diagnosis()
        alone = ChangedReadings(None, None, log, diagnosis)
        return Inspection(alone, tuple(of_diagnosis(diagnosis)))
    disturbances = _disturbances(given, log, healthy, layout)
    if any(one.name == "silent_array" for one in disturbances):
        findings = [_finding(one) for one in disturbances]
        return Inspection(ChangedReadings(None, None, log, _untold(log, layout)), tuple(findings))
    common = None
    amplified = 1.0
    if diagnoser.reference_ is None:
        fitted = diagnoser.for_log(log, classes=classes, progress=progress)
        readings = ChangedReadings(None, None, log, fitted.diagnose(log, classes=classes))
    else:
        told = shared.crosstalk is not None
        told |= any(one.name in _OF_ALL_CELLS for one in disturbances)
        # Crosstalk of lines is what the cells of a pad share, too.
        compared = healthy if shared.crosstalk is None else []
        readings, common = _judged(log, compared, diagnoser, disturbed=told)
        others = _without_groups(log, readings.diagnosis)
        if others is not None:  # what a bus does is no disturbance of all
            disturbances = _disturbances(given, others, healthy, layout)
        converter = None
        if diagnoser.load_ is None and shared.crosstalk is None:
            converter = find_converter_change(log, healthy, layout, disturbances)
        if converter is not None:
            seen = converter.of(healthy)
            behind = SelfDiagnosis(**diagnoser.get_params()).fit(seen, progress=progress)
            again = _judged(log, seen, behind, disturbed=told)
            if len(again[0].diagnosis.fault_set) <= len(readings.diagnosis.fault_set):
                (readings, common), diagnoser, healthy = again, behind, seen
                amplified = converter.gain
    if common is not None:
        disturbances.append(common.disturbance)
    change = None
    if max(amplified, 1 / amplified) >= GAIN:
        change = amplification(amplified, len(log))
    elif shared.crosstalk is None:
        change = _change(_with_offset(readings, common, log), healthy, diagnoser, disturbances)
    if change is not None:  # measures it
        disturbances = [one for one in disturbances if one.name != "offset"]
    readings = replace(readings, diagnosis=shared.told(readings.diagnosis))
    findings = [
        *_of_readings(readings),
        *(_finding(one) for one in disturbances),
        *_of_change(change),
        *of_diagnosis(readings.diagnosis),
    ]
    if classes is not None:
        findings += [
            finding_of("coincides", text) for text in coinciding(readings.diagnosis, classes)
        ]
    return Inspection(readings, tuple(findings), change, common)


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
