"""A set of recordings with their layout and labels: what every reader returns and every routine
takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.printable import printable
from diagnostics import SensorLayout
from diagnostics.shown import shown

if TYPE_CHECKING:
    from diagnostics import Scan


@shown
@dataclass(frozen=True, eq=False)
class Recordings:
    """Recordings of one array.

    Attributes:
        frames: float32 ``[T, D]`` each, in the layout's unit; lengths may differ; NaN = missing
            reading.
        layout: the array they come from.
        labels: int ``[n]``, the class of each recording (an index into ``class_names``); None where
            there are none.
        class_names: one name a class.
        names: where each recording came from ("normal/0001.csv"), for messages; what cannot be
            printed is escaped.
        targets: float32 ``[k]`` each, the values of a recording, or ``[T, k]``, those of its
            frames; None where there are none.
        value_names: one name a value.
        scan: of the read-out, of all recordings together; None: there is none.

    Raises:
        ValueError: a recording that does not fit the layout; labels, class names, names, targets or
            value names of another number.
    """

    frames: tuple[NDArray[np.float32], ...]
    layout: SensorLayout
    labels: NDArray[np.int64] | None = None
    class_names: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    targets: tuple[NDArray[np.float32], ...] | None = None
    value_names: tuple[str, ...] = ()
    scan: Scan | None = None

    def __post_init__(self) -> None:
        names = tuple(map(printable, self.names)) or tuple(
            f"recording {i}" for i in range(len(self.frames))
        )
        frames = tuple(
            self.layout.check_recording(f, name).astype(np.float32)
            for f, name in zip(self.frames, names, strict=True)
        )
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "frames", frames)
        if self.targets is not None:
            self._check_targets(self.targets)
        if self.labels is None:
            return
        labels = np.asarray(self.labels, dtype=np.int64)
        if labels.shape != (len(frames),):
            raise ValueError(
                f"{len(frames)} recordings need as many labels, got an array of shape"
                f" {labels.shape}"
            )
        numbers = range(int(labels.max(initial=-1)) + 1)
        class_names = tuple(map(printable, self.class_names)) or tuple(map(str, numbers))
        if labels.size and (labels.min() < 0 or labels.max() >= len(class_names)):
            raise ValueError(
                f"labels run from {labels.min()} to {labels.max()}, but there are"
                f" {len(class_names)} class names"
            )
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "class_names", class_names)

    def _check_targets(self, given: tuple[NDArray[np.float32], ...]) -> None:
        if len(given) != len(self.frames):
            raise ValueError(
                f"{len(self.frames)} recordings need as many targets, got {len(given)}"
            )
        targets = tuple(np.asarray(of, dtype=np.float32) for of in given)
        k = len(self.value_names) or (targets[0].shape[-1] if targets else 0)
        for name, of, frames in zip(self.names, targets, self.frames, strict=True):
            if of.shape not in ((k,), (len(frames), k)):
                raise ValueError(
                    f"{name}: expected targets [{k}] or [{len(frames)}, {k}], got {list(of.shape)}"
                )
        names = tuple(map(printable, self.value_names)) or tuple(f"value {i}" for i in range(k))
        object.__setattr__(self, "targets", targets)
        object.__setattr__(self, "value_names", names)

    def __len__(self) -> int:
        return len(self.frames)

    def __str__(self) -> str:
        lengths = [len(frames) for frames in self.frames]
        frames = f"{min(lengths, default=0)} to {max(lengths, default=0)} frames"
        classes = "" if self.labels is None else f", {len(self.class_names)} classes"
        return f"{len(self)} recordings of {frames}{classes}: {self.layout}"

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        return iter(self.frames)

    def select(self, which: Sequence[int] | NDArray[np.integer]) -> Recordings:
        """Return the recordings with these indices, in this order."""
        labels = None if self.labels is None else self.labels[np.asarray(which, dtype=np.intp)]
        frames = tuple(self.frames[i] for i in which)
        names = tuple(self.names[i] for i in which)
        targets = None if self.targets is None else tuple(self.targets[i] for i in which)
        return Recordings(
            frames,
            self.layout,
            labels,
            self.class_names,
            names,
            targets,
            self.value_names,
            self.scan,
        )
