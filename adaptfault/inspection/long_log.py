"""Inspection of a log that does not fit into memory: part by part, with one diagnosis of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from numpy.typing import ArrayLike, NDArray

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.inspection import inspect
from adaptfault.inspection.result import OF_CELLS, Finding, Inspection, of_diagnosis
from diagnostics import Diagnosis, SelfDiagnosis
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.threads import one_thread
from diagnostics.when import Spans

_OF_PARTS = ("one_signal", "corrupt_frame", "common_spike", "repeated_frames", "crosstalk")
"""Names of the findings that the diagnosis of the whole log no longer sees."""


def inspect_parts(
    parts: Iterator[list[NDArray[Any]]],
    diagnoser: SelfDiagnosis,
    *,
    reference: ArrayLike | Sequence[ArrayLike] | None = None,
    lengths: Sequence[int] | None = None,
    classes: ArrayLike | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Inspection:
    """Return everything that a log tells about a sensor, as
    :func:`adaptfault.inspection.inspection.inspect`.

    One part is inspected as a whole. Of several, each is inspected for itself: wires and pads are
    put back. The cells are judged from all of them together, and from the range of each in each
    recording. In a cold start the first part alone may be the reference of all. The result holds no
    readings.

    Args:
        parts: at least one list of recordings ``[T, D]``, in time order.
        diagnoser, reference, progress: as for ``inspect``.
        lengths: frames of each recording in all parts, of which long ones are cut; None: none is.
        classes: as for ``inspect``, of one part; of several they are not used.

    Raises:
        ValueError: recordings that do not fit the layout, or hold no frame.
    """
    first = next(parts)
    second = next(parts, None)
    if second is None:
        return inspect(first, diagnoser, reference=reference, classes=classes, progress=progress)
    fitted = diagnoser
    if diagnoser.reference_ is None:
        fitted = diagnoser.for_log(first, progress=progress)
    tolerance = fitted.tolerance(RecordingBlocks(first))
    stream = fitted.stream()
    inspected = []
    spans = []
    pieces: list[int] = []
    for part in chain([first, second], parts):
        one = inspect(part, fitted, reference=reference)
        crosstalk = fitted.crosstalk(one.readings.frames)
        if crosstalk is not None:
            stream.crosstalk = crosstalk.joined(stream.crosstalk)
        with one_thread():
            for frames in one.readings.frames:
                stream.begin_recording()
                stream.extend(frames)
        spans.append(fitted.spans(RecordingBlocks(_as_judged(one, part))))
        pieces += map(len, part)
        inspected.append(_without_frames(one))
    if not stream.received.any():  # all cells show one signal, or none has a reading
        return inspected[0]
    whole = pieces if lengths is None else list(lengths)
    of_each = Spans.joined(spans).whole(pieces, whole)
    diagnosis = fitted.evaluate_recordings(stream, of_each, whole, tolerance)
    return _together(inspected, diagnosis)


def _as_judged(inspection: Inspection, part: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return the recordings of a part as they are judged; as they came where some are left out."""
    frames: list[NDArray[Any]] = inspection.readings.frames
    return frames if len(frames) == len(part) else part


def _without_frames(inspection: Inspection) -> Inspection:
    return replace(
        inspection,
        readings=replace(inspection.readings, frames=[], as_found=None),
    )


def _together(inspected: list[Inspection], diagnosis: Diagnosis) -> Inspection:
    """Return one inspection: what is told of the whole sensor in any part, and the diagnosis of
    all."""
    changed = next((one for one in inspected if one.readings.reason), inspected[0])
    readings = ChangedReadings(changed.rewiring, changed.recalibration, [], diagnosis)
    change = next((one.change for one in inspected if one.change is not None), None)
    told: dict[str, Finding] = {}
    for one in inspected:
        for finding in one.findings:
            if finding.name not in OF_CELLS or finding.name in _OF_PARTS:
                told.setdefault(finding.name, finding)
    return Inspection(readings, (*told.values(), *of_diagnosis(diagnosis)), change)
