"""Summarises recordings before anything is fitted: shape, range, step, rest level, classes, silent
cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.documents import members
from diagnostics import SensorLayout
from diagnostics.preprocessing.array_likes import is_array
from diagnostics.preprocessing.tolerance import least_step
from diagnostics.shown import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from adaptfault.data.recordings import Opened, Recordings

SCHEMA = "adaptfault.info/1"

_SAMPLE = 4000  # frames that the rest level and the step are taken from
_LISTED = 8  # cells or classes that the text lists


@shown
@dataclass(frozen=True, eq=False)
class Summary:
    """The content of recordings.

    Attributes:
        layout: the array.
        lengths: int ``[n]``, frames of each recording.
        mean, lowest, highest: float ``[D]``, of the finite readings of each cell; NaN where it has
        none.
        rest: float ``[D]``, the reading that a cell has in the 10 % of frames in which it is least
            loaded (their median).
        step: the least difference between two readings that are not equal; None where no cell
            changes.
        missing: int ``[D]``, missing readings.
        classes: recordings of each class; empty without labels.
        inferred: see :class:`~adaptfault.data.recordings.load.Loaded`.
        seconds: how long the recordings took, by their times; None: by the rate.
    """

    layout: SensorLayout
    lengths: NDArray[np.int64]
    mean: NDArray[np.float64]
    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]
    rest: NDArray[np.float64]
    step: float | None
    missing: NDArray[np.int64]
    classes: dict[str, int] = field(default_factory=dict)
    inferred: tuple[str, ...] = ()
    seconds: float | None = None

    @property
    def duration(self) -> float:
        """Seconds that the recordings took."""
        if self.seconds is not None:
            return self.seconds
        return float(self.lengths.sum() / self.layout.rate)

    @property
    def silent(self) -> NDArray[np.intp]:
        """Present cells whose reading never changes: not loaded, or faulty."""
        with np.errstate(invalid="ignore"):
            constant = ~(self.highest > self.lowest)
        return np.flatnonzero(constant & self.layout.is_cell)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict of the schema "adaptfault.info/1"."""
        present = self.layout.is_cell
        return {
            "schema": SCHEMA,
            **members(self, "layout", "step", "silent", "classes", "inferred"),
            "recordings": len(self.lengths),
            "frames": int(self.lengths.sum()),
            "seconds": self.duration,
            "lengths": {"least": int(self.lengths.min()), "most": int(self.lengths.max())},
            "lowest": _least(self.lowest[present]),
            "highest": _most(self.highest[present]),
            "rest": _median(self.rest[present]),
            "missing": int(self.missing[present].sum()),
        }

    def __str__(self) -> str:
        layout = self.layout
        present = layout.is_cell
        least = int(self.lengths.min())
        most = int(self.lengths.max())
        missing = int(self.missing[present].sum())
        each = " each" * (len(self.lengths) > 1)
        frames = (
            f"{least} frame{'s' * (least != 1)}{each}"
            if least == most
            else f"{least} to {most} frames each"
        )
        rows = {
            "recordings": f"{len(self.lengths)} of {frames}, {self.duration:.0f} s in all",
            "array": str(layout),
            "readings": self._readings(),
            "rest level": f"{_number(_median(self.rest[present]))} (median over the cells)",
            "missing": "1 reading" if missing == 1 else f"{missing} readings",
            "silent": self._silent(),
            "classes": self._classes(),
        }
        lines = [f"{name:12s} {text}" for name, text in rows.items()]
        return "\n".join([*lines, *(f"{'inferred':12s} {text}" for text in self.inferred)])

    def _readings(self) -> str:
        present = self.layout.is_cell
        low = _least(self.lowest[present])
        high = _most(self.highest[present])
        if low is None or high is None:
            return "none"
        step = "" if self.step is None else f", least step {self.step:.3g}"
        share = high / self.layout.full_scale
        return f"{low:.4g} to {high:.4g} {self.layout.unit} ({share:.0%} of the full scale){step}"

    def _silent(self) -> str:
        silent = self.silent
        if not silent.size:
            return "no cell: every cell changes"
        places = [self.layout.place(int(c)) for c in silent[:_LISTED]]
        more = [f"and {silent.size - _LISTED} more"] if silent.size > _LISTED else []
        change = "changes" if silent.size == 1 else "change"
        text = (
            f"{silent.size} of {int(self.layout.present.sum())} cells never {change} (not loaded,"
            " or faulty)"
        )
        return f"{text}: {'; '.join([*places, *more])}"

    def _classes(self) -> str:
        if not self.classes:
            return "no labels"
        listed = [f"{name} {count}" for name, count in list(self.classes.items())[:_LISTED]]
        more = [f"and {len(self.classes) - _LISTED} more"] if len(self.classes) > _LISTED else []
        return f"{len(self.classes)}: {', '.join([*listed, *more])}"

    def plot(self) -> Figure:
        """Draw the mean and the peak of each cell, one map a pad; a cross marks a silent cell."""
        from diagnostics.decision.plot import draw_row, pads_figure

        layout = self.layout
        figure, axes = pads_figure(layout, n_rows=2)
        maps = {"mean, ": self.mean, "peak, ": self.highest}
        for (title, values), row in zip(maps.items(), axes, strict=True):
            top = _most(values[layout.is_cell]) or layout.full_scale
            draw_row(row, values, layout, title, self.silent, top=top, label=layout.unit)
        if self.silent.size:
            figure.supxlabel("x: the reading of the cell never changes", fontsize=8)
        return figure


def summarise(
    recordings: Iterable[NDArray[Any]],
    layout: SensorLayout,
    *,
    lengths: Sequence[int] | None = None,
    classes: dict[str, int] | None = None,
    inferred: tuple[str, ...] = (),
    seconds: float | None = None,
) -> Summary:
    """Summarise recordings, or pieces of them, in one pass and constant memory.

    Args:
        recordings: arrays ``[T, D]`` in the layout's unit; NaN = missing.
        layout: the array.
        lengths: frames of each recording, where pieces are given; None: those of the arrays.
        classes, inferred, seconds: stored in the summary.

    Raises:
        ValueError: no recording, or one that does not fit the layout.
    """
    width = layout.n_cells
    total = np.zeros(width)
    finite = np.zeros(width, np.int64)
    seen_frames = []
    lowest = np.full(width, np.inf)
    highest = np.full(width, -np.inf)
    sample: list[NDArray[np.float64]] = []
    # or read one by one
    given = layout.recordings(recordings) if is_array(recordings) else recordings
    for i, recording in enumerate(given):
        frames = layout.check_recording(recording, f"recording {i}")
        known = np.isfinite(frames)
        seen_frames.append(len(frames))
        total += np.sum(frames, axis=0, where=known)
        finite += known.sum(axis=0)
        lowest = np.minimum(lowest, np.min(frames, axis=0, initial=np.inf, where=known))
        highest = np.maximum(highest, np.max(frames, axis=0, initial=-np.inf, where=known))
        if sum(map(len, sample)) < _SAMPLE:
            sample.append(frames[: _SAMPLE // 10])
    if not seen_frames:
        raise ValueError("no recording to summarise")
    seen = finite > 0
    return Summary(
        layout=layout,
        lengths=np.array(seen_frames if lengths is None else lengths, dtype=np.int64),
        mean=np.where(seen, total / np.maximum(finite, 1), np.nan),
        lowest=np.where(seen, lowest, np.nan),
        highest=np.where(seen, highest, np.nan),
        rest=_rest(np.concatenate(sample)),
        step=_step(np.concatenate(sample)[:, layout.is_cell]),
        missing=np.int64(sum(seen_frames)) - finite,
        classes=dict(classes or {}),
        inferred=inferred,
        seconds=seconds,
    )


def summary_of(log: Opened | Recordings, inferred: Sequence[str] = ()) -> Summary:
    """Return what recordings hold, ``inferred`` facts of the array included."""
    from adaptfault.data.recordings import Recordings

    classes = {}
    if log.labels is not None:
        counts = Counter(log.labels.tolist())
        classes = {name: counts[i] for i, name in enumerate(log.class_names)}
    if isinstance(log, Recordings):
        return summarise(log.frames, log.layout, classes=classes, inferred=tuple(inferred))
    return summarise(
        log.pieces(),
        log.layout,
        lengths=log.lengths,
        classes=classes,
        inferred=tuple(inferred),
        seconds=log.seconds,
    )


def _rest(frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 5 % quantile of each cell, which is the median of its lowest 10 %."""
    kept = np.where(np.isfinite(frames), frames, np.inf)
    ordered = np.sort(kept, axis=0)
    rank = (0.05 * np.maximum(np.isfinite(frames).sum(axis=0) - 1, 0)).astype(int)
    rest = np.take_along_axis(ordered, rank[None], axis=0)[0]
    return np.where(np.isfinite(rest), rest, np.nan)


def _step(frames: NDArray[np.float64]) -> float | None:
    """Return the least difference between two distinct readings, above the rounding of float32."""
    values = frames[np.isfinite(frames)].astype(np.float32).astype(np.float64)
    return least_step(values, np.abs(values).max(initial=0.0)) or None


def _least(values: NDArray[np.float64]) -> float | None:
    return float(np.nanmin(values)) if np.isfinite(values).any() else None


def _most(values: NDArray[np.float64]) -> float | None:
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def _median(values: NDArray[np.float64]) -> float | None:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else None


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"
