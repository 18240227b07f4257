"""Scores of a model: accuracy and macro averages of classes (Section III-B), R2 and absolute error of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support

from adaptfault.data.windows import Windows

SCHEMA = "adaptfault.scores/1"


class Classifier(Protocol):
    """Anything with ``predict`` for windows ``[N, T, D]``."""

    def predict(self, x: NDArray[np.float32], /) -> ArrayLike:
        """Return int ``[N]``."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of a classifier on labelled windows.

    Precision, recall and F1 are macro averages over the classes that occur or were predicted; 0 where one is undefined
    (a class that was never predicted has precision 0).

    Attributes:
        accuracy, precision, recall, f1: 0..1.
        confusion: int64 ``[C, C]``, true class by predicted class.
        n: number of windows.
    """

    accuracy: float
    precision: float
    recall: float
    f1: float
    confusion: NDArray[np.int64]
    n: int

    @classmethod
    def of(cls, true: ArrayLike, predicted: ArrayLike, *, n_classes: int | None = None) -> Scores:
        """Score predicted against true classes, both int ``[N]``; ``n_classes`` is the least size of the confusion.

        Raises:
            ValueError: no windows, a window without a label, arrays of different lengths.
        """
        t, p = np.asarray(true), np.asarray(predicted)
        if t.ndim != 1 or t.shape != p.shape:
            raise ValueError(f"expected one predicted class for each of {t.size} windows, got shape {list(p.shape)}")
        if not len(t):
            raise ValueError("no windows to score")
        if t.min() < 0:
            raise ValueError(f"{int((t < 0).sum())} of {len(t)} windows have no label")
        size = max(int(t.max()) + 1, int(p.max()) + 1, n_classes or 0)
        precision, recall, f1, _ = precision_recall_fscore_support(t, p, average="macro", zero_division=0)
        confusion = confusion_matrix(t, p, labels=np.arange(size)).astype(np.int64)
        confusion.setflags(write=False)
        return cls(float((t == p).mean()), float(precision), float(recall), float(f1), confusion, len(t))

    def __eq__(self, other: object) -> bool:
        return self.to_dict() == other.to_dict() if isinstance(other, Scores) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.n, self.confusion.tobytes()))

    def __str__(self) -> str:
        return (
            f"accuracy {self.accuracy:.3f}, precision {self.precision:.3f}, recall {self.recall:.3f}, "
            f"F1 {self.f1:.3f} on {self.n} windows"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        d: dict[str, Any] = {"schema": SCHEMA}
        d |= {name: getattr(self, name) for name in ("accuracy", "precision", "recall", "f1", "n")}
        return d | {"confusion": self.confusion.tolist()}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Scores:
        """Build scores from :meth:`to_dict`'s dict.

        Raises:
            ValueError: another schema.
        """
        if d.get("schema") != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA!r}, got {d.get('schema')!r}")
        confusion = np.asarray(d["confusion"], dtype=np.int64)
        confusion.setflags(write=False)
        return cls(d["accuracy"], d["precision"], d["recall"], d["f1"], confusion, d["n"])

    def plot(self, ax: Any = None, *, class_names: Sequence[str] | None = None) -> Any:
        """Draw the confusion as shares of each true class; return matplotlib's axes."""
        from matplotlib.figure import Figure  # loaded only here: evaluation must stay quick to import

        ax = Figure(layout="constrained").subplots() if ax is None else ax
        total = np.maximum(self.confusion.sum(axis=1, keepdims=True), 1)
        ax.imshow(self.confusion / total, vmin=0, vmax=1, cmap="Blues")
        ax.set(xlabel="predicted class", ylabel="true class", title=str(self))
        if class_names is not None:
            ax.set_xticks(range(len(class_names)), class_names, rotation=90)
            ax.set_yticks(range(len(class_names)), class_names)
        return ax


def accuracy_interval(right: ArrayLike, recording: ArrayLike, *, level: float = 0.95) -> tuple[float, float]:
    """Return the confidence interval of an accuracy, clustered by recording.

    Windows of one recording are correlated, so the recordings count as samples: a cluster-robust t interval, or the
    exact binomial interval over recordings where all windows are right or all are wrong.

    Args:
        right: bool ``[N]``, whether each window was classified correctly.
        recording: int ``[N]``, the recording of each window.
        level: of confidence.
    """
    from statsmodels.regression.linear_model import OLS
    from statsmodels.stats.proportion import proportion_confint

    right, recording = np.asarray(right, dtype=bool), np.asarray(recording)
    count = len(np.unique(recording))
    if right.all() or not right.any() or count < 2:
        low, high = proportion_confint(count * int(right.all()), count, 1 - level, method="beta")
        return float(low), float(high)
    fit = OLS(right.astype(float), np.ones((len(right), 1))).fit(
        cov_type="cluster", cov_kwds={"groups": recording}, use_t=True
    )
    low, high = fit.conf_int(1 - level)[0]
    return max(0.0, float(low)), min(1.0, float(high))


def evaluate(model: Classifier | Any, windows: Windows) -> Scores:
    """Score ``model`` on labelled windows.

    Args:
        model: anything with ``predict(x [N, T, D]) -> int [N]``, or a torch module that returns logits.
        windows: what to score it on.

    Raises:
        ValueError: no windows, or windows without labels.
        TypeError: ``model`` is neither.
    """
    n_classes = getattr(model, "n_classes", None)
    if callable(getattr(model, "predict", None)):
        return Scores.of(windows.y, model.predict(windows.x), n_classes=n_classes)
    from torch import nn  # a plain classifier is scored without torch

    from adaptfault.models.network import logits_of

    if not isinstance(model, nn.Module):
        raise TypeError(f"expected something with predict(x) or a torch module, got {type(model).__name__}")
    logits = logits_of(model, windows.x)
    return Scores.of(windows.y, logits.argmax(1).numpy(), n_classes=logits.shape[1])
