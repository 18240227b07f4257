"""What one pass keeps of each recording of a data set, so that parts of it are merged by putting
them one behind the other.

Of each recording: the range of each cell, sums that tell whether it moves with those beside it
(:mod:`diagnostics.when.together`), how it begins (:mod:`adaptfault.inspection.begins`), five frames
that tell the direction of load and the step of the converter; and of all how often frames repeat.
The size depends on the number of recordings, not on that of frames.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings import Opened, Recordings
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.summary import Summary
from adaptfault.inspection.begins import Begins, Begun
from adaptfault.inspection.groupings import Groupings, joined
from adaptfault.inspection.naming import Naming, classes_of
from adaptfault.inspection.stands_still import Longest, StandsStill
from diagnostics import SensorLayout
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.sensor.repeated_frames import Repetitions
from diagnostics.when import Spans
from diagnostics.when.together import Together

SCHEMA = "adaptfault.quick/3"

_KEPT = 5  # frames of each recording, evenly spread


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of n recordings.

    Attributes:
        layout: the array.
        naming: of its pads and recordings, with the frames of each.
        classes: of each recording; None: unknown.
        spans: ranges of the readings.
        together: sums.
        begins: how they begin.
        stands_still: where one frame came many times.
        sample: float32 ``[n, 5, D]``, frames of each.
        missing: int ``[D]``, readings.
        repetitions: of frames.
        groupings: what else divides the recordings.
        unread: why recordings and files could not be read.
    """

    layout: SensorLayout
    naming: Naming
    classes: tuple[str, ...] | None
    spans: Spans
    together: Together
    begins: Begins
    stands_still: StandsStill
    sample: NDArray[np.float32]
    missing: NDArray[np.int64]
    repetitions: Repetitions
    groupings: Groupings
    unread: tuple[str, ...] = ()

    @classmethod
    def of(cls, log: Opened | Recordings, groupings: Groupings | None = None) -> Statistics:
        """Return the statistics of a data set, read once."""
        layout = log.layout
        naming = Naming.of(log)
        present = layout.is_cell
        spans = []
        together = []
        pieces = []
        repetitions = []
        begun: list[Begun] = []
        longest: list[Longest] = []
        sample = np.full((len(naming.lengths), _KEPT, layout.n_cells), np.nan, np.float32)
        missing = np.zeros(layout.n_cells, np.int64)
        for number, first, frames in _pieces(log, naming.lengths):
            valid = RecordingBlocks([frames]).valid(layout.full_scale, present)
            spans.append(Spans.of(valid))
            together.append(Together.of(valid.given, layout))
            pieces.append(len(frames))
            repetitions.append(Repetitions.of(frames[:, present]))
            if not first:
                begun.append(Begun(layout))
                longest.append(Longest(layout))
            begun[-1].add(frames)
            longest[-1].add(frames)
            missing += np.isnan(valid.given[0]).sum(axis=0)
            kept = np.linspace(0, naming.lengths[number] - 1, _KEPT).astype(int) - first
            here = (kept >= 0) & (kept < len(frames))
            sample[number, here] = valid.given[0][kept[here]]
        classes = classes_of(log)
        return cls(
            layout,
            naming,
            None if classes is None else tuple(classes),
            Spans.joined(spans).whole(pieces, naming.lengths),
            Together.joined(together).whole(pieces, naming.lengths),
            Begins.joined([one.begins() for one in begun]),
            StandsStill.joined([one.run() for one in longest]),
            sample,
            missing,
            Repetitions.joined(repetitions),
            groupings or {},
            tuple(one.message for one in getattr(log, "problems", ()) if one.level == "error"),
        )

    @classmethod
    def joined(cls, parts: Sequence[Statistics]) -> Statistics:
        """Return those of all parts, in their order.

        Raises:
            ValueError: they are not of one array.
        """
        first = parts[0]
        for part in parts:
            if part.layout.to_dict() != first.layout.to_dict():
                raise ValueError(
                    f"the parts are not of one array: {first.layout} and {part.layout}; state"
                    " --shape, --full-scale, --unit and --rate for each"
                )
        names = chain.from_iterable(part.naming.recordings for part in parts)
        lengths = chain.from_iterable(part.naming.lengths for part in parts)
        classes = None
        if all(part.classes is not None for part in parts):
            classes = tuple(one for part in parts for one in part.classes or ())
        return cls(
            first.layout,
            Naming(first.naming.pads, tuple(names), tuple(lengths)),
            classes,
            Spans.joined([part.spans for part in parts]),
            Together.joined([part.together for part in parts]),
            Begins.joined([part.begins for part in parts]),
            StandsStill.joined([part.stands_still for part in parts]),
            np.concatenate([part.sample for part in parts]),
            np.sum([part.missing for part in parts], axis=0),
            Repetitions.joined([part.repetitions for part in parts]),
            joined([(part.groupings, len(part.naming.lengths)) for part in parts]),
            tuple(dict.fromkeys(one for part in parts for one in part.unread)),
        )

    @property
    def summary(self) -> Summary:
        """What the recordings hold; rest is the median of the lowest readings."""
        counts, sums = self.together.sums[:2].sum(axis=1)
        classes: dict[str, int] = {}
        for name in self.classes or ():
            classes[name] = classes.get(name, 0) + 1
        return Summary(
            layout=self.layout,
            lengths=np.array(self.naming.lengths, np.int64),
            mean=np.where(counts > 0, sums / np.maximum(counts, 1), np.nan),
            lowest=np.fmin.reduce(self.spans.low),
            highest=np.fmax.reduce(self.spans.high),
            rest=known_quantile(self.spans.low, 0.5, axis=0),
            step=None,
            missing=self.missing,
            classes=classes,
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write a part for :meth:`load`; a file holds the old content or the new, never a part.

        Raises:
            OSError: it cannot be written.
        """
        atomic_write(path, self.to_bytes())

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        about = {
            "schema": SCHEMA,
            "layout": self.layout.to_dict(),
            "pads": self.naming.pads,
            "recordings": self.naming.recordings,
            "lengths": list(map(int, self.naming.lengths)),
            "classes": self.classes,
            "frames": self.repetitions.frames,
            "repeated": self.repetitions.repeated,
            "groupings": {name: list(one) for name, one in self.groupings.items()},
            "unread": self.unread,
        }
        stored = io.BytesIO()
        np.savez_compressed(
            stored,
            about=np.frombuffer(json.dumps(about).encode(), np.uint8),
            low=self.spans.low,
            high=self.spans.high,
            sums=self.together.sums,
            sample=self.sample,
            missing=self.missing,
            between=self.repetitions.between,
            still=np.stack([self.stands_still.lengths, self.stands_still.begins]),
            **{f"begins_{name}": values for name, values in vars(self.begins).items()},
        )
        return stored.getvalue()

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Statistics:
        """Read a part.

        Raises:
            InputError: it is none, or is damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as held:
                about: dict[str, Any] = json.loads(held["about"].tobytes())
                if about["schema"] != SCHEMA:
                    raise ValueError(f"has the schema {about['schema']}")
                classes = about["classes"]
                names = tuple(about["recordings"])
                naming = Naming(tuple(about["pads"]), names, tuple(about["lengths"]))
                counted = Repetitions(about["frames"], about["repeated"], held["between"])
                return cls(
                    SensorLayout.from_dict(about["layout"]),
                    naming,
                    None if classes is None else tuple(classes),
                    Spans(held["low"], held["high"]),
                    Together(held["sums"]),
                    Begins(*(held[f"begins_{field.name}"] for field in fields(Begins))),
                    StandsStill(*held["still"]),
                    held["sample"],
                    held["missing"],
                    counted,
                    about["groupings"],
                    tuple(about["unread"]),
                )
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            what = "is no part of a check, or is damaged; write it again with check --shard"
            raise InputError.at(Path(path), what) from error


def _pieces(
    log: Opened | Recordings, lengths: Sequence[int]
) -> Iterator[tuple[int, int, NDArray[Any]]]:
    """Yield the number of a recording, the first frame of a piece in it, and the piece."""
    if isinstance(log, Recordings):
        for number, frames in enumerate(log.frames):
            yield number, 0, frames
        return
    number = 0
    first = 0
    for piece in log.pieces():
        while first >= lengths[number]:
            number += 1
            first = 0
        yield number, first, piece
        first += len(piece)
