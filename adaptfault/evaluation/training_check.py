"""Checks whether a training run has learned anything, and draws its curves and confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.evaluation.scores import Scores, ValueScores, chance
from adaptfault.models.history import History

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FALL = 0.02
"""A training loss that falls by less than this share has not fallen."""

_LOWEST = 0.05
"""Quantile of the lowest readings of a recording."""

_FOLDS = 5
"""Of a cross-validation, and the least recordings of a class in it."""

_TREES = 100
"""Of what predicts the class from the lowest readings."""

_SHOWN = 4
"""Values that the picture of a training shows."""

_NO_R2 = 0.1
"""An R2 below this is hardly that of a model."""


def training_problems(
    scores: Scores, history: History, class_names: Sequence[str]
) -> tuple[str, ...]:
    """Return one sentence for each sign of a failed training, with likely causes; empty if there is
    none.

    The signs are a test accuracy near chance, a class without a window, a class that is never
    predicted, and a training loss that did not fall.
    An accuracy is near chance if it is below the limit of
    :func:`adaptfault.evaluation.scores.chance`. A run on unbalanced classes may be useful below
    that limit; the sentence names both numbers.

    Args:
        scores: of the test windows.
        history: of the run.
        class_names: one name a class.
    """
    counts = scores.confusion.sum(axis=1)
    problems = []
    share, limit = chance(np.repeat(np.arange(len(counts)), counts))
    if scores.accuracy < limit:
        problems.append(
            f"test accuracy {scores.accuracy:.3f} is near chance ({share:.3f}): train longer"
            " (--epochs), and check the labels, the full scale (adaptfault info) and that the"
            " classes differ in contact"
        )
    absent = np.flatnonzero(counts == 0)
    if absent.size:
        causes = "its recordings are shorter than a window (--length), or too few"
        problems.append(f"{_classes(absent, 'without a window', class_names)}: {causes}")
    never = np.flatnonzero((scores.confusion.sum(axis=0) == 0) & (counts > 0))
    if never.size:
        causes = "too few recordings, labels that are mixed up, or too few epochs"
        problems.append(f"{_classes(never, 'never predicted', class_names)}: {causes}")
    problems += _of_loss(history, "labels")
    return tuple(problems)


def rest_level_note(
    frames: Sequence[NDArray[Any]], labels: NDArray[np.int64], accuracy: float
) -> str:
    """Return a question if the lowest readings of a recording tell its class as well as all of it
    does; else nothing.

    Recordings of one class that were made together share rest levels that drift, and a classifier
    then learns the day instead of the object. The lowest reading of a cell is its 5 % quantile in a
    recording. Extremely randomised trees predict the class from these, by cross-validation. An
    object that is held from the first frame to the last is in the lowest readings, too, so it is a
    question and no verdict.

    Args:
        frames: recordings, each ``[T, D]``.
        labels: int ``[n]``.
        accuracy: of the model on test windows.
    """
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.model_selection import StratifiedKFold, cross_val_score

    counts = np.bincount(labels)
    enough = np.isin(labels, np.flatnonzero(counts >= _FOLDS))
    if len(np.unique(labels[enough])) < 2:
        return ""
    lowest = np.stack([np.quantile(np.nan_to_num(of), _LOWEST, axis=0) for of in frames])
    reached = cross_val_score(
        ExtraTreesClassifier(_TREES, random_state=0),
        lowest[enough],
        labels[enough],
        cv=StratifiedKFold(_FOLDS, shuffle=True, random_state=0),
    ).mean()
    if reached <= chance(labels[enough])[1] or reached < accuracy - _FALL:
        return ""
    return (
        f"the lowest reading of each cell in a recording alone predicts its class ({reached:.3f},"
        f" the model {accuracy:.3f}): were recordings of one class made together? Then the model"
        " may know them by their rest levels, not by the contact; try it on recordings of another"
        " day"
    )


def value_training_problems(scores: ValueScores, history: History) -> tuple[str, ...]:
    """Return one sentence for each sign of a failed training of a regression; empty if there is
    none.

    The signs are a test R2 of nearly 0, which the mean of the values has, and a training loss that
    did not fall.

    Args:
        scores: of the test windows.
        history: of the run.
    """
    problems = []
    if scores.r2 < _NO_R2:
        problems.append(
            f"test R2 {scores.r2:.3f} is hardly above that of the mean of the values (0): train"
            " longer (--epochs), or at a higher --learning-rate, and check the targets, the full"
            " scale (adaptfault info) and that the values show in the readings"
        )
    return (*problems, *_of_loss(history, "targets"))


def _of_loss(history: History, learned: str) -> list[str]:
    losses = history.train_loss
    if len(losses) > 1 and min(losses[1:]) > (1 - _FALL) * losses[0]:
        return [
            f"the training loss did not fall ({losses[0]:.3f} to {losses[-1]:.3f}): check the full"
            f" scale (adaptfault info) and the {learned}"
        ]
    return []


def _classes(which: NDArray[np.intp], what: str, class_names: Sequence[str]) -> str:
    names = ", ".join(class_names[i] if len(class_names) else str(i) for i in which[:5])
    more = f" and {which.size - 5} more" if which.size > 5 else ""
    return f"{'class' if which.size == 1 else 'classes'} {what}: {names}{more}"


def plot_training(scores: Scores, history: History, class_names: Sequence[str]) -> Figure:
    """Draw loss and accuracy by epoch, and the confusion matrix of the test windows, rows summing
    to 1."""
    from matplotlib.figure import Figure

    n = len(scores.confusion)
    side = float(np.clip(0.25 * n, 3.0, 9.0))
    figure = Figure(figsize=(4.5 + side + 2.0, max(5.0, side + 2.0)), layout="constrained")
    parts = figure.add_gridspec(2, 2, width_ratios=[4.5, side + 2.0])
    _curves(figure, (parts[0, 0], parts[1, 0]), history, scores.accuracy)
    ax = figure.add_subplot(parts[:, 1])
    rows = scores.confusion.sum(axis=1, keepdims=True)
    image = ax.imshow(scores.confusion / np.maximum(rows, 1), vmin=0, vmax=1, cmap="Blues")
    names = [class_names[i] if i < len(class_names) else str(i) for i in range(n)]
    ax.set_xticks(range(n), names, rotation=90, fontsize=7)
    ax.set_yticks(range(n), names, fontsize=7)
    ax.set(xlabel="predicted", ylabel="true", title="confusion of the test windows")
    figure.colorbar(image, ax=ax, shrink=0.7, label="share of the true class")
    return figure


def plot_value_training(
    true: NDArray[np.floating],
    predicted: NDArray[np.floating],
    scores: ValueScores,
    history: History,
    names: Sequence[str],
) -> Figure:
    """Draw loss and R2 by epoch, and predicted against true values ``[N, k]`` of the test windows,
    the first four of them."""
    from matplotlib.figure import Figure

    shown = min(len(names), _SHOWN)
    figure = Figure(figsize=(9.5, 2.6 * max(2, shown)), layout="constrained")
    parts = figure.add_gridspec(2 * shown, 2)
    _curves(figure, (parts[:shown, 0], parts[shown:, 0]), history, scores.r2, "mean squared error")
    for i, name in enumerate(names[:shown]):
        ax = figure.add_subplot(parts[2 * i : 2 * i + 2, 1])
        ends = [float(true[:, i].min()), float(true[:, i].max())]
        ax.plot(ends, ends, color="0.5", lw=1, ls="--")
        ax.plot(true[:, i], predicted[:, i], ".", ms=3)
        title = f"{name}: mean absolute error {scores.mae[i]:.4g}"
        ax.set(xlabel="true", ylabel="predicted", title=title)
    return figure


def _curves(
    figure: Figure, places: Any, history: History, reached: float, criterion: str = "cross entropy"
) -> None:
    """Draw the loss and the accuracy, or R2, by epoch into two places of a figure."""
    from matplotlib.ticker import MaxNLocator

    epochs = np.arange(1, history.epochs + 1)
    loss = figure.add_subplot(places[0])
    accuracy = figure.add_subplot(places[1])
    loss.plot(epochs, history.train_loss, ".-", label="training")
    loss.plot(epochs, history.validation_loss, ".-", label="validation")
    loss.set_ylabel(criterion)
    loss.legend(fontsize=8)
    accuracy.plot(
        epochs, history.validation_accuracy, ".-", label="validation, network in training"
    )
    # A head in closed form, added after the training, may lift the finished model far above the
    # curve.
    accuracy.axhline(
        reached, color="0.5", lw=1, ls="--", label=f"test, finished model: {reached:.3f}"
    )
    accuracy.set(xlabel="epoch", ylabel="accuracy", ylim=(0, 1))
    if criterion != "cross entropy":
        accuracy.set(ylabel="R2", ylim=(None, 1))
    for curves in (loss, accuracy):
        curves.xaxis.set_major_locator(MaxNLocator(integer=True))
    accuracy.legend(fontsize=8)
