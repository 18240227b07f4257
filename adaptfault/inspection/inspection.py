"""Inspection of a log: everything that is told of it.

Exchanged wires and replaced pads are undone. Then the diagnosis judges the cells, as
:meth:`diagnostics.SelfDiagnosis.diagnose` does. What all cells share is told beside it.
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
from diagnostics.preprocessing.checked import checked_recordings
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.sensor.common_mode import find_common_mode
from diagnostics.sensor.disturbance import Disturbance, find_disturbances, find_sentinel
from diagnostics.sensor.sensor_change import SensorChange
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
        progress: receives the share of the fit that is done, where a cold start fits to the log.

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
        untold = Diagnosis.untold(layout, list(map(len, log)))
        return Inspection(ChangedReadings(None, None, log, untold), tuple(findings))
    crosstalk = shared.crosstalk is not None
    if diagnoser.reference_ is None:
        fitted = diagnoser.for_log(log, classes=classes, progress=progress)
        alone = ChangedReadings(None, None, log, fitted.diagnose(log, classes=classes))
        told = _Told(alone, disturbances)
        if not crosstalk:
            told.change = _change(alone, healthy, diagnoser, disturbances)
    else:
        told = _compared(given, log, healthy, diagnoser, disturbances, crosstalk)
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
    return Inspection(readings, tuple(findings), told.change)


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
        disturbances: of the array.
        change: of a pad or of the sensor.
    """

    readings: ChangedReadings
    disturbances: list[Disturbance]
    change: SensorChange | None = None


def _compared(
    given: list[NDArray[np.float64]],
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    disturbances: list[Disturbance],
    crosstalk: bool,
) -> _Told:
    """Return what is told of a log beside the reference that the diagnosis is fitted to.

    Args:
        given, log, healthy, disturbances: as for :func:`_disturbances`, and what it returned.
        crosstalk: the lines of the log have it, which the cells of a pad share, too.
    """
    layout = diagnoser.layout
    of_all = crosstalk or any(one.name in _OF_ALL_CELLS for one in disturbances)
    compared = [] if crosstalk else healthy
    common = _common_mode(log, compared, diagnoser)
    disturbed = of_all or common is not None
    readings = find_changed_readings(
        diagnoser, log, compared, disturbed=disturbed, comparable=not of_all
    )
    others = _without_groups(log, readings.diagnosis)
    if others is not None:  # what a bus does is no disturbance of all
        disturbances = _disturbances(given, others, healthy, layout)
    if common is not None and not _is_group(readings.diagnosis):
        disturbances = [*disturbances, common]
    change = None if crosstalk else _change(readings, healthy, diagnoser, disturbances)
    return _Told(readings, disturbances, change)


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
    if any(np.isfinite(frames[:, layout.is_cell]).any() for frames in log):
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
    left = diagnosis.layout.is_cell & ~faulty
    if not cells or not left.any():
        return None
    return [np.where(faulty, np.nan, frames) for frames in log]


def _common_mode(
    log: list[NDArray[np.float64]], healthy: list[NDArray[np.float64]], diagnoser: SelfDiagnosis
) -> Disturbance | None:
    """Return what the cells of a pad share beyond the reference; None where a gain of all cells
    explains it."""
    common = find_common_mode(log, healthy, diagnoser.layout) if healthy else None
    usual = None if common is None else diagnoser.without_gain(log)
    if usual is not None and find_common_mode(list(usual), healthy, diagnoser.layout) is None:
        return None
    return common


def _is_group(diagnosis: Diagnosis) -> bool:
    """Return whether a bus or a converter is among the faults: its cells share what they read, as
    those of a common mode."""
    kinds = {fault.line.kind for fault in diagnosis.faults if fault.line is not None}
    return not kinds.isdisjoint(("converter", "bus", "group", "position"))


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
