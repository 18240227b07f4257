"""Writes what Rerun shows, into an RRD file or to viewers.

- ``/tactile/<pad>/readings``: a depth image a frame, from 0 to full scale
- ``/tactile/<pad>/restored``: the same, with faulty and missing cells restored, where something
  restores them
- ``/tactile/<pad>/readings/missing``: what covers the positions without a reading, as viewers paint
  NaN in any colour
- ``/tactile/<pad>/states``: a segmentation image, numbered as in
  :class:`~adaptfault.viewers.timed_log.State`
- ``/tactile/faults``: a text log, a line a fault at its onset
- ``/tactile/recordings``: a text log, a line a recording

The time lines are ``time`` (seconds) and ``recording`` (numbers from 0).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.viewers.timed_log import COLOURS, ROOT, Piece, TimedLog
from diagnostics import Fault, SensorLayout

_MISSING = [(0, "", (0, 0, 0, 0)), (1, "no reading", (240, 240, 240, 255))]


def write_rrd(path: str | PathLike[str], log: TimedLog) -> None:
    """Write a log; the memory that it takes does not grow with the log.

    Raises:
        InputError: the package rerun-sdk is not installed.
        OSError: the file cannot be written.
    """
    check_rerun(path)
    import rerun

    faults = sorted(log.diagnosis.faults, key=lambda fault: fault.onset or 0)
    places = [log.place(fault.onset or 0) for fault in faults]
    with atomic_file(path) as name:
        stream = rerun.RecordingStream("adaptfault")
        array = RerunArray(stream, log.layout)
        stream.save(name, blueprint([array]))
        try:
            array.begin()
            array.states(log.states)
            array.faults(faults, places)
            array.texts("recordings", log.names, list(enumerate(log.starts.tolist())))
            for piece in log:
                array.write(piece)
        finally:
            stream.disconnect()


def check_rerun(path: str | PathLike[str]) -> None:
    """Raise InputError where the package rerun-sdk is not installed; ``path``: of the file to
    write."""
    what = (
        "RRD files are written with rerun-sdk; install it: pip install 'adaptfault-viewers[view]'"
    )
    imported("rerun", path, what)


class RerunArray:
    """The entities of one array.

    Args:
        stream: a ``rerun.RecordingStream``.
        layout: of the array.
        root: what the names of its entities begin with.
        restored: whether its pieces hold restored frames.
        clock: times are seconds since 1970; False: since the beginning.
    """

    def __init__(
        self,
        stream: Any,
        layout: SensorLayout,
        root: str = ROOT,
        *,
        restored: bool = False,
        clock: bool = False,
    ) -> None:
        self.layout = layout
        self.root = root
        self.shown = ("readings", "restored") if restored else ("readings",)
        self._stream = stream
        self._missing: dict[str, NDArray[np.bool_]] = {}  # as written last
        self._time = "timestamp" if clock else "duration"

    def begin(self) -> None:
        """Write what holds at all times: sizes, colours and names of the images."""
        import rerun

        classes = [
            rerun.AnnotationInfo(id=int(state), label=str(state), color=colour)
            for state, colour in COLOURS.items()
        ]
        self._stream.log(self.root, rerun.AnnotationContext(classes), static=True)
        pads, rows, cols = self.layout.shape
        kind = rerun.ChannelDatatype.F32
        about = rerun.DepthImage.from_fields(
            format=rerun.components.ImageFormat(width=cols, height=rows, channel_datatype=kind),
            meter=1.0,
            depth_range=[0.0, self.layout.full_scale],
            colormap=rerun.components.Colormap.Viridis,
        )
        for pad in range(pads):
            for what in self.shown:
                path = f"{self.root}/{pad}/{what}"
                self._stream.log(path, about, static=True)
                self._stream.log(f"{path}/missing", rerun.AnnotationContext(_MISSING), static=True)

    def states(self, states: NDArray[np.uint8], place: tuple[int, float] | None = None) -> None:
        """Write states ``[pads, rows, cols]`` from a recording and time on; None: at all times."""
        import rerun

        if place is not None:
            self._at(*place)
        for pad, image in enumerate(states):
            shown = rerun.SegmentationImage(np.ascontiguousarray(image))
            self._stream.log(f"{self.root}/{pad}/states", shown, static=place is None)

    def faults(self, faults: Sequence[Fault], places: Sequence[tuple[int, float]]) -> None:
        """Write a line a fault, each at its recording and time; that of a wire is an error."""
        texts = [fault.reason or fault.describe(self.layout) for fault in faults]
        levels = ["WARN" if fault.line is None else "ERROR" for fault in faults]
        self.texts("faults", texts, places, levels)

    def texts(
        self,
        what: str,
        texts: Sequence[str],
        places: Sequence[tuple[int, float]],
        levels: Sequence[str] | None = None,
    ) -> None:
        """Write lines of text, each at its recording and time."""
        import rerun

        if not texts:
            return
        levels = levels or ["INFO"] * len(texts)
        columns = rerun.TextLog.columns(text=list(texts), level=list(levels))
        recordings, times = zip(*places, strict=True)
        indexes = self._times(recordings, times)
        self._stream.send_columns(f"{self.root}/{what}", indexes=indexes, columns=columns)

    def write(self, piece: Piece) -> None:
        """Write frames."""
        import rerun

        indexes = self._times([piece.recording] * len(piece.times), piece.times.tolist())
        for what in self.shown:
            frames = piece.readings if what == "readings" else piece.restored
            assert frames is not None  # as stated
            for pad in range(self.layout.pads):
                images = [frame.tobytes() for frame in frames[:, pad]]
                columns = rerun.DepthImage.columns(buffer=images)
                path = f"{self.root}/{pad}/{what}"
                self._stream.send_columns(path, indexes=indexes, columns=columns)
                self._cover(f"{path}/missing", np.isnan(frames[:, pad]), piece)

    def _cover(self, path: str, missing: NDArray[np.bool_], piece: Piece) -> None:
        """Write which positions have no reading, bool ``[t, rows, cols]``, where that changes."""
        import rerun

        before = self._missing.get(path, np.zeros_like(missing[0]))
        for frame in np.flatnonzero(_changes(missing, before)).tolist():
            self._at(piece.recording, float(piece.times[frame]))
            image = rerun.SegmentationImage(missing[frame].astype(np.uint8), opacity=1.0)
            self._stream.log(path, image)
        self._missing[path] = missing[-1]

    def _at(self, recording: int, time: float) -> None:
        """Set the time of what is written next."""
        self._stream.set_time("recording", sequence=recording)
        self._stream.set_time("time", **{self._time: time})

    def _times(self, recordings: Iterable[int], times: Iterable[float]) -> list[Any]:
        import rerun

        return [
            rerun.TimeColumn("time", **{self._time: list(times)}),
            rerun.TimeColumn("recording", sequence=list(recordings)),
        ]


def _changes(missing: NDArray[np.bool_], before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return in which frames other positions are missing than in the frame before."""
    earlier = np.concatenate([before[None], missing[:-1]])
    changes: NDArray[np.bool_] = (missing != earlier).any(axis=(1, 2))
    return changes


def blueprint(arrays: Sequence[RerunArray]) -> Any:
    """Return what Rerun shows at first: readings above states, one column a pad, and the faults."""
    import rerun.blueprint as show

    columns = []
    for array in arrays:
        named = array.root.removeprefix(ROOT).removeprefix("/")
        device = f"{named}, " if named else ""
        for pad in range(array.layout.pads):
            views = [
                show.Spatial2DView(
                    origin=f"{array.root}/{pad}/{what}", name=f"{device}pad {pad}, {what}"
                )
                for what in (*array.shown, "states")
            ]
            columns.append(show.Vertical(*views))
    texts = show.TextLogView(origin=ROOT, name="faults and recordings")
    shown = show.Vertical(show.Horizontal(*columns), texts, row_shares=[3, 1])
    return show.Blueprint(shown, show.SelectionPanel(state="collapsed"))
