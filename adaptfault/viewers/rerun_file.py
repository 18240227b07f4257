"""Writes an RRD file for Rerun.

- ``/tactile/<pad>/readings``: a depth image a frame, from 0 to full scale
- ``/tactile/<pad>/states``: a segmentation image, numbered as in
  :class:`~adaptfault.viewers.timed_log.State`
- ``/tactile/faults``: a text log, a line a fault at its onset
- ``/tactile/recordings``: a text log, a line a recording

The time lines are ``time`` (seconds) and ``recording`` (numbers from 0).
"""

from __future__ import annotations

from os import PathLike
from types import ModuleType
from typing import Any

import numpy as np

from adaptfault.data.atomic import atomic_file
from adaptfault.data.recordings.errors import InputError
from adaptfault.viewers.timed_log import COLOURS, TimedLog

ROOT = "/tactile"


def write_rrd(path: str | PathLike[str], log: TimedLog) -> None:
    """Write a log; the memory that it takes does not grow with the log.

    Raises:
        InputError: the package rerun-sdk is not installed.
        OSError: the file cannot be written.
    """
    try:
        import rerun
    except ImportError:
        what = "RRD files are written with rerun-sdk; install it: pip install 'adaptfault[view]'"
        raise InputError.at(path, what) from None
    with atomic_file(path) as name:
        stream = rerun.RecordingStream("adaptfault")
        stream.save(name, _blueprint(log))
        try:
            _write_states(rerun, stream, log)
            _write_texts(rerun, stream, log)
            _write_readings(rerun, stream, log)
        finally:
            stream.disconnect()


def _write_states(rerun: ModuleType, stream: Any, log: TimedLog) -> None:
    classes = [
        rerun.AnnotationInfo(id=int(state), label=str(state), color=colour)
        for state, colour in COLOURS.items()
    ]
    stream.log(ROOT, rerun.AnnotationContext(classes), static=True)
    for pad, states in enumerate(log.states):
        image = rerun.SegmentationImage(np.ascontiguousarray(states))
        stream.log(f"{ROOT}/{pad}/states", image, static=True)


def _write_texts(rerun: ModuleType, stream: Any, log: TimedLog) -> None:
    faults = sorted(log.diagnosis.faults, key=lambda fault: fault.onset or 0)
    if faults:
        places = [log.place(fault.onset or 0) for fault in faults]
        texts = [fault.reason or fault.describe(log.layout) for fault in faults]
        levels = ["WARN" if fault.line is None else "ERROR" for fault in faults]
        columns = rerun.TextLog.columns(text=texts, level=levels)
        stream.send_columns(
            f"{ROOT}/faults", indexes=_times(rerun, *zip(*places, strict=True)), columns=columns
        )
    columns = rerun.TextLog.columns(text=list(log.names), level=["INFO"] * len(log.names))
    indexes = _times(rerun, range(len(log.names)), log.starts.tolist())
    stream.send_columns(f"{ROOT}/recordings", indexes=indexes, columns=columns)


def _write_readings(rerun: ModuleType, stream: Any, log: TimedLog) -> None:
    pads, rows, cols = log.layout.shape
    paths = [f"{ROOT}/{pad}/readings" for pad in range(pads)]
    kind = rerun.ChannelDatatype.F32
    shape = rerun.components.ImageFormat(width=cols, height=rows, channel_datatype=kind)
    about = rerun.DepthImage.from_fields(
        format=shape,
        meter=1.0,
        depth_range=[0.0, log.layout.full_scale],
        colormap=rerun.components.Colormap.Viridis,
    )
    for path in paths:
        stream.log(path, about, static=True)
    for piece in log:
        numbers = [piece.recording] * len(piece.times)
        indexes = _times(rerun, numbers, piece.times.tolist())
        for pad, path in enumerate(paths):
            images = [frame.tobytes() for frame in piece.readings[:, pad]]
            columns = rerun.DepthImage.columns(buffer=images)
            stream.send_columns(path, indexes=indexes, columns=columns)


def _times(rerun: ModuleType, recordings: Any, times: Any) -> list[Any]:
    return [
        rerun.TimeColumn("time", duration=list(times)),
        rerun.TimeColumn("recording", sequence=list(recordings)),
    ]


def _blueprint(log: TimedLog) -> Any:
    """Return what Rerun shows at first: readings above states, one column a pad, and the faults."""
    import rerun.blueprint as show

    pads = [
        show.Vertical(
            show.Spatial2DView(origin=f"{ROOT}/{pad}/readings", name=f"pad {pad}, readings"),
            show.Spatial2DView(origin=f"{ROOT}/{pad}/states", name=f"pad {pad}, states"),
        )
        for pad in range(log.layout.pads)
    ]
    texts = show.TextLogView(origin=ROOT, name="faults and recordings")
    return show.Blueprint(show.Vertical(show.Horizontal(*pads), texts, row_shares=[3, 1]))
