"""Expected accuracy after a repair, estimated before the repair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.determination import explained
from adaptfault.data.documents import members
from adaptfault.evaluation.class_recall import ClassRecall, class_recalls
from adaptfault.evaluation.scores import mean_interval, prediction_interval
from diagnostics import FaultSet
from diagnostics.shown import shown

SCHEMA = "adaptfault.forecast/1"


@dataclass(frozen=True)
class Expected:
    """An expected accuracy, or R2 of a regression.

    Attributes:
        accuracy: on the validation windows.
        low, high: 95 % interval of the accuracy on new recordings, whose number is
            :attr:`Forecast.n_new`.
        likelihood: mean calibrated probability of the true class (R2 of a regression). It ranks
            fault sets more reliably than the accuracy, because windows near a decision count in
            proportion.
    """

    accuracy: float
    low: float
    high: float
    likelihood: float

    def __str__(self) -> str:
        return f"{self.accuracy:.3f} ({self.low:.3f} to {self.high:.3f})"

    @classmethod
    def of(
        cls,
        right: NDArray[np.bool_],
        recording: NDArray[np.int64],
        new: float | None = None,
        likely: NDArray[np.floating] | None = None,
    ) -> Expected:
        """Return the accuracy to expect on ``new`` recordings (None: as many) from windows ``[N]``
        that are right.

        ``likely`` is the probability of the true class, ``[N]``; None: 1 where the window is right,
        else 0.
        """
        likelihood = float((right if likely is None else likely).mean())
        return cls(float(right.mean()), *prediction_interval(right, recording, new=new), likelihood)

    @classmethod
    def of_errors(
        cls, shares: NDArray[np.floating], recording: NDArray[np.int64], new: float | None
    ) -> Expected:
        """Return the R2 to expect from the share of the variance that is explained in each window
        ``[N]``."""
        low, high = mean_interval(shares, recording)
        known = len(np.unique(recording))
        wider = np.sqrt(1 + known / (known if new is None else new))
        r2 = float(shares.mean())
        return cls(r2, r2 - wider * (r2 - low), min(1.0, r2 + wider * (high - r2)), r2)


@shown
@dataclass(frozen=True)
class Forecast:
    """Expected accuracy of each stage of a repair, in the order of their cost.

    Attributes:
        fault_set: F.
        stages: "fault-free", "fill" and "head", measured on validation windows with F taken away;
            "finetune" and "scratch" need training, so they have the accuracy of the best measured
            stage and an interval that extends to that of the fault-free model. With F empty,
            "fault-free" alone.
        worst_class: the class that loses most recall at the best measured stage; None with F empty
            or a regression.
        worst_loss: loss of its recall, 0..1.
        n_recordings: number of validation recordings.
        n_new: number of new recordings whose accuracy the intervals hold.
        measure: what is expected, "accuracy" or "R2".
        classes: recall of each class at the best measured stage; none of a regression.
    """

    fault_set: FaultSet
    stages: dict[str, Expected]
    worst_class: int | None
    worst_loss: float
    n_recordings: int
    n_new: float
    measure: str = "accuracy"
    classes: tuple[ClassRecall, ...] = ()

    @classmethod
    def of(
        cls,
        fault_set: FaultSet,
        y: NDArray[Any],
        recording: NDArray[np.int64],
        predicted: Mapping[str, NDArray[Any]],
        new: float | None = None,
        likely: Mapping[str, NDArray[np.floating]] | None = None,
    ) -> Forecast:
        """Build a forecast from what each measured stage predicted for validation windows.

        Args:
            fault_set: F.
            y: classes ``[N]``, or values ``[N, k]``.
            recording: of each window, ``[N]``.
            predicted: by each stage, as ``y``.
            new: number of new recordings; None: as many.
            likely: the probabilities ``[N]`` that each stage gave the true class.
        """
        values = y.ndim == 2
        stages = {}
        for name, answers in predicted.items():
            if values:
                shares = explained(y, answers).mean(axis=1)  # its mean is R2
                stages[name] = Expected.of_errors(shares, recording, new)
            else:
                of_true = likely[name] if likely else None
                stages[name] = Expected.of(answers == y, recording, new, of_true)
        best = "fault-free"
        if len(stages) > 1:
            best = max("fill", "head", key=lambda name: stages[name].accuracy)
            reached = stages[best]
            trained = replace(reached, high=max(reached.high, stages["fault-free"].high))
            stages |= {"finetune": trained, "scratch": trained}
        count = len(np.unique(recording))
        new = count if new is None else new
        if values:
            return cls(fault_set, stages, None, 0.0, count, new, "R2")
        recalls = class_recalls(y, predicted[best], recording, new=new)
        gains = (predicted["fault-free"] == y) * 1.0 - (predicted[best] == y)
        lost = {c: float(gains[y == c].mean()) for c in np.unique(y).tolist()}
        worst = max(lost, key=lost.__getitem__)
        label = None if best == "fault-free" else worst
        return cls(fault_set, stages, label, lost[worst], count, new, classes=recalls)

    def __str__(self) -> str:
        k = len(self.fault_set)
        many = "many new recordings" if np.isinf(self.n_new) else f"{self.n_new:g} new ones"
        many += " like these"
        lines = [
            f"expected {self.measure} without {k} cells, from {self.n_recordings} recordings (95 %"
            f" interval, {many}):"
        ]
        lines += [f"  {name:10s} {expected}" for name, expected in self.stages.items()]
        if self.worst_class is not None:
            lines.append(
                f"  class {self.worst_class} suffers most: its recall falls by"
                f" {self.worst_loss:.2f}"
            )
        return "\n".join(lines)

    def by_class(self, names: Sequence[str] = ()) -> str:
        """Return the recall of each class as text, the class with the lowest limit first."""
        ordered = sorted(self.classes, key=lambda one: one.low)
        return "\n".join(f"  {one.named(names)}" for one in ordered)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {"schema": SCHEMA, **members(self)}
