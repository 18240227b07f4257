"""Scores of a model: accuracy and macro averages of classes (Section III-B), R2 and absolute error
of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import softmax
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support

from adaptfault.data.determination import r2
from adaptfault.data.documents import check_schema, members, rebuilt
from adaptfault.data.windows import Windows
from diagnostics.shown import shown

SCHEMA = "adaptfault.scores/1"
VALUES_SCHEMA = "adaptfault.value_scores/1"


class Classifier(Protocol):
    """Anything with ``predict`` for windows ``[N, T, D]``."""

    def predict(self, x: NDArray[np.float32], /) -> ArrayLike:
        """Return int ``[N]``."""


@shown
@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of a classifier on labelled windows.

    Precision, recall and F1 are macro averages over the classes that occur or were predicted; 0
    where one is undefined (a class that was never predicted has precision 0).

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
        """Score predicted against true classes, both int ``[N]``; ``n_classes`` is the least size
        of the confusion.

        Raises:
            ValueError: no windows, a window without a label, arrays of different lengths.
        """
        t = np.asarray(true)
        p = np.asarray(predicted)
        if t.ndim != 1 or t.shape != p.shape:
            raise ValueError(
                f"expected one predicted class for each of {t.size} windows, got shape"
                f" {list(p.shape)}"
            )
        if not len(t):
            raise ValueError("no windows to score")
        if t.min() < 0:
            raise ValueError(f"{int((t < 0).sum())} of {len(t)} windows have no label")
        size = max(int(t.max()) + 1, int(p.max()) + 1, n_classes or 0)
        precision, recall, f1, _ = precision_recall_fscore_support(
            t, p, average="macro", zero_division=0
        )
        confusion = confusion_matrix(t, p, labels=np.arange(size)).astype(np.int64)
        confusion.setflags(write=False)
        return cls(
            float((t == p).mean()), float(precision), float(recall), float(f1), confusion, len(t)
        )

    @property
    def by_class(self) -> NDArray[np.float64]:
        """Recall of each class, float ``[C]``; NaN for a class without a window."""
        right = self.confusion.diagonal()
        total = self.confusion.sum(axis=1)
        return np.where(total > 0, right / np.maximum(total, 1), np.nan)

    def __eq__(self, other: object) -> bool:
        return self.to_dict() == other.to_dict() if isinstance(other, Scores) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.n, self.confusion.tobytes()))

    def __str__(self) -> str:
        return (
            f"accuracy {self.accuracy:.3f}, precision {self.precision:.3f}, recall"
            f" {self.recall:.3f}, F1 {self.f1:.3f} on {self.n} windows"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {"schema": SCHEMA, **members(self)}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Scores:
        """Build scores from :meth:`to_dict`'s dict.

        Raises:
            ValueError: another schema.
        """
        check_schema(d, SCHEMA)
        confusion = np.asarray(d["confusion"], dtype=np.int64)
        confusion.setflags(write=False)
        return cls(d["accuracy"], d["precision"], d["recall"], d["f1"], confusion, d["n"])

    def plot(self, ax: Any = None, *, class_names: Sequence[str] | None = None) -> Any:
        """Draw the confusion as shares of each true class; return matplotlib's axes."""
        # loaded only here: evaluation must stay quick to import
        from matplotlib.figure import (
            Figure,
        )

        ax = Figure(layout="constrained").subplots() if ax is None else ax
        total = np.maximum(self.confusion.sum(axis=1, keepdims=True), 1)
        ax.imshow(self.confusion / total, vmin=0, vmax=1, cmap="Blues")
        ax.set(xlabel="predicted class", ylabel="true class", title=str(self))
        if class_names is not None:
            ax.set_xticks(range(len(class_names)), class_names, rotation=90)
            ax.set_yticks(range(len(class_names)), class_names)
        return ax


@shown
@dataclass(frozen=True)
class ValueScores:
    """Scores of a regression of k values.

    Attributes:
        r2: coefficient of determination, mean over the values (``sklearn.metrics.r2_score``); 1 is
            perfect, 0 is the mean of the values.
        mae: mean absolute error of each value, in its unit.
        n: number of windows.
    """

    r2: float
    mae: tuple[float, ...]
    n: int

    @classmethod
    def of(cls, true: ArrayLike, predicted: ArrayLike) -> ValueScores:
        """Score predicted against true values, both float ``[N, k]``, or actions ``[N, ...]``.

        Raises:
            ValueError: no windows, or arrays of different shapes.
        """
        t = np.asarray(true, dtype=np.float64)
        p = np.asarray(predicted, dtype=np.float64)
        if t.ndim < 2 or t.shape != p.shape or not len(t):
            raise ValueError(
                f"expected values of shape {list(t.shape)} [N, k], got {list(p.shape)}"
            )
        return cls(r2(t, p), tuple(np.abs(t - p).mean(axis=0).ravel().tolist()), len(t))

    def __str__(self) -> str:
        return self.named()

    def named(self, names: Sequence[str] = ()) -> str:
        """Return the scores as text, with the name of each value where there are names."""
        labels = [f"{name} " for name in names] or [""] * len(self.mae)
        errors = ", ".join(
            f"{label}{error:.4g}" for label, error in zip(labels, self.mae, strict=True)
        )
        return f"R2 {self.r2:.3f}, mean absolute error {errors} on {self.n} windows"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {"schema": VALUES_SCHEMA, **members(self)}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> ValueScores:
        """Build scores from the dict of :meth:`to_dict`.

        Raises:
            ValueError: another schema.
        """
        return rebuilt(d, cls, schema=VALUES_SCHEMA)


def recording_scores(probabilities: ArrayLike, windows: Windows) -> Scores:
    """Score one decision for each recording, that of :func:`of_recording`.

    Args:
        probabilities: ``[N, n_classes]`` of the windows.
        windows: labelled; all windows of a recording have one class.

    Returns:
        Scores whose ``n`` counts recordings.

    Raises:
        ValueError: as :meth:`Scores.of`.
    """
    p = np.asarray(probabilities, dtype=np.float64)
    numbers, first = np.unique(windows.recording, return_index=True)
    decided = [of_recording(p[windows.recording == number]).argmax() for number in numbers]
    return Scores.of(windows.y[first], decided, n_classes=p.shape[1])


def of_recording(probabilities: ArrayLike) -> NDArray[np.float64]:
    """Return the probabilities of the classes for a whole recording, ``[n_classes]``: the geometric
    mean over its windows, of sum 1.

    The class with the largest is that of the product of the windows. As probabilities they are
    cautious: windows of one recording count as one.

    Args:
        probabilities: of its windows, ``[N, n_classes]``, at least one.
    """
    p = np.asarray(probabilities, dtype=np.float64)
    logs = np.log(np.maximum(p, np.finfo(np.float32).tiny)).mean(axis=0)
    whole: NDArray[np.float64] = softmax(logs)
    return whole


def chance(y: ArrayLike) -> tuple[float, float]:
    """Return the accuracy m of always naming the most frequent class, and the least that exceeds it
    beyond chance.

    The latter is m + 2 sqrt(m (1 - m) / n), two standard errors of n windows, classes ``y [n]``.
    """
    counts = np.unique(np.asarray(y), return_counts=True)[1]
    share = float(counts.max() / counts.sum())
    return share, share + 2 * float(np.sqrt(share * (1 - share) / counts.sum()))


def mean_interval(
    values: ArrayLike, recording: ArrayLike, *, level: float = 0.95
) -> tuple[float, float]:
    """Return the cluster-robust t interval of the mean of ``values [N]``, clustered by recording
    ``[N]``.

    A single recording has no spread between recordings; its interval is unbounded.
    """
    from statsmodels.regression.linear_model import OLS

    v = np.asarray(values, dtype=float)
    recording = np.asarray(recording)
    if len(np.unique(recording)) < 2:
        return -np.inf, np.inf
    fit = OLS(v, np.ones((len(v), 1))).fit(
        cov_type="cluster", cov_kwds={"groups": recording}, use_t=True
    )
    low, high = fit.conf_int(1 - level)[0]
    return float(low), float(high)


def accuracy_interval(
    right: ArrayLike, recording: ArrayLike, *, level: float = 0.95
) -> tuple[float, float]:
    """Return the confidence interval of an accuracy, clustered by recording.

    Windows of one recording are correlated, so the recordings count as samples: a cluster-robust t
    interval, or the exact binomial interval over recordings where all windows are right or all are
    wrong.

    Args:
        right: bool ``[N]``, whether each window was classified correctly.
        recording: int ``[N]``, the recording of each window.
        level: of confidence.
    """
    from statsmodels.stats.proportion import proportion_confint

    right = np.asarray(right, dtype=bool)
    recording = np.asarray(recording)
    count = len(np.unique(recording))
    if right.all() or not right.any() or count < 2:
        low, high = proportion_confint(count * int(right.all()), count, 1 - level, method="beta")
        return float(low), float(high)
    low, high = mean_interval(right, recording, level=level)
    return max(0.0, low), min(1.0, high)


def prediction_interval(
    right: ArrayLike, recording: ArrayLike, *, new: float | None = None, level: float = 0.95
) -> tuple[float, float]:
    """Return the interval of the accuracy on ``new`` recordings that are like the known ones.

    The score prediction interval of Krishnamoorthy and Peng (2011), with t quantiles. The windows
    count as their effective number, n_e = p (1 - p) / (cluster-robust variance of p) (Korn and
    Graubard 1998). With infinitely many new recordings it is the score interval of Wilson (1927).

    Args:
        right: bool ``[N]``, whether each window was classified correctly.
        recording: int ``[N]``, the recording of each window.
        new: number of recordings to come, positive or infinite; None: as many as are known.
        level: probability that the interval holds the accuracy on the new recordings.

    Returns:
        The lowest and the highest accuracy. From a single recording nothing can be said: 0 and 1.
    """
    from scipy import stats

    right = np.asarray(right, dtype=bool)
    recording = np.asarray(recording)
    known = len(np.unique(recording))
    new = known if new is None else new
    if known < 2:
        return 0.0, 1.0
    p = float(right.mean())
    quantile = float(stats.t.ppf((1 + level) / 2, known - 1))
    low, high = mean_interval(right, recording, level=level)
    variance = ((high - low) / 2 / quantile) ** 2
    # Where all windows are right, nothing shows how alike those of a recording are: a recording
    # then counts as one.
    effective = (
        known
        if p in (0.0, 1.0)
        else min(len(right), p * (1 - p) / max(variance, np.finfo(float).tiny))
    )
    # All a with (p - a)^2 <= scale q (1 - q), where q = share p + (1 - share) a is the accuracy of
    # both samples.
    scale = quantile**2 / effective * (1 + known / new)
    share = known / (known + new)
    square = 1 + scale * (1 - share) ** 2
    half = p + scale * (1 - share) * (1 - 2 * share * p) / 2
    root = np.sqrt(max(0.0, half**2 - square * (p**2 - scale * share * p * (1 - share * p))))
    low = (half - root) / square
    high = (half + root) / square
    # p itself solves it, but for rounding
    return float(np.clip(low, 0.0, p)), float(np.clip(high, p, 1.0))


def scored(true: ArrayLike, outputs: NDArray[Any]) -> Scores | ValueScores:
    """Score outputs ``[N, n]``: as values against true ones ``[N, n]``, or as logits or
    probabilities of the classes ``[N]``."""
    if np.ndim(true) >= 2:
        return ValueScores.of(true, outputs)
    return Scores.of(true, outputs.argmax(1), n_classes=outputs.shape[1])


def evaluate(model: Classifier | Any, windows: Windows) -> Any:
    """Score ``model`` on labelled windows: :class:`Scores` of classes, :class:`ValueScores` of
    values.

    Args:
        model: anything with ``predict(x [N, T, D]) -> int [N]``, or a torch module that returns
            logits.
        windows: what to score it on.

    Raises:
        ValueError: no windows, or windows without labels.
        TypeError: ``model`` is neither.
    """
    predict = getattr(model, "predict", None)
    if callable(predict) and windows.y.ndim == 1:  # a plain classifier is scored without torch
        n_classes = getattr(model, "n_classes", None)
        predicted = predict(windows.x, **windows.extra)
        return Scores.of(windows.y, predicted, n_classes=n_classes)
    from torch import nn

    from adaptfault.models.network import logits_of

    if isinstance(model, nn.Module):
        return scored(windows.y, logits_of(model, windows.x, windows.extra).numpy())
    if callable(predict):
        return ValueScores.of(windows.y, predict(windows.x, **windows.extra))
    raise TypeError(
        f"expected something with predict(x) or a torch module, got {type(model).__name__}"
    )
