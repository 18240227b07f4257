"""Recall of each class with an interval by recording, and the class that it is most often taken
for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.documents import members, rebuilt
from adaptfault.evaluation.scores import prediction_interval


@dataclass(frozen=True)
class ClassRecall:
    """Recall of one class.

    Attributes:
        label: the class.
        recall: share of its windows that are recognised.
        low, high: 95 % interval, by recording
            (:func:`~adaptfault.evaluation.scores.prediction_interval`).
        confused_with: the class that its other windows are most often taken for; None: all are
            recognised.
        confused: share of its windows that are taken for that class.
        n_recordings: number of its recordings.
    """

    label: int
    recall: float
    low: float
    high: float
    confused_with: int | None
    confused: float
    n_recordings: int

    def named(self, names: Sequence[str] = ()) -> str:
        """Return it as text, with the names of the classes where there are names."""
        known = f"{self.n_recordings} recording{'' if self.n_recordings == 1 else 's'}"
        text = (
            f"{class_name(self.label, names)}: recall {self.recall:.3f} ({self.low:.3f} to"
            f" {self.high:.3f}; {known})"
        )
        if self.confused_with is None:
            return text
        return f"{text}, taken for {class_name(self.confused_with, names)} in {self.confused:.1%}"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return members(self)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> ClassRecall:
        """Build from the dict of :meth:`to_dict`.

        Raises:
            ValueError: it is damaged.
        """
        return rebuilt(d, cls)


def class_recalls(
    y: NDArray[np.int64],
    predicted: NDArray[np.int64],
    recording: NDArray[np.int64],
    *,
    new: float | None = None,
) -> tuple[ClassRecall, ...]:
    """Return the recall of each class that has windows.

    Args:
        y: class of each window ``[N]``; windows without one, -1, are left out.
        predicted: class that a model gives it, ``[N]``, without having been fitted to it.
        recording: of each window, ``[N]``.
        new: number of new recordings, of all classes in their present shares, whose recall the
            intervals hold; infinite: intervals of the recall itself. None: as many as are given.
    """
    every = len(np.unique(recording[y >= 0]))
    share = 1.0 if new is None else new / max(every, 1)
    recalls = []
    for label in np.unique(y[y >= 0]).tolist():
        of_it = y == label
        given = predicted[of_it]
        right = given == label
        own = recording[of_it]
        n = len(np.unique(own))
        low, high = prediction_interval(right, own, new=share * n)
        others, counts = np.unique(given[~right], return_counts=True)
        recalls.append(
            ClassRecall(
                label=label,
                recall=float(right.mean()),
                low=low,
                high=high,
                confused_with=int(others[counts.argmax()]) if len(others) else None,
                confused=float(counts.max(initial=0) / len(given)),
                n_recordings=n,
            )
        )
    return tuple(recalls)


def class_name(label: int, names: Sequence[str]) -> str:
    """Return the name of a class, or its number where classes have no names."""
    return names[label] if names else f"class {label}"
