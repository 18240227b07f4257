"""Sensitivity to single faults: accuracy lost when a cell, row, column or address bit is stuck (the
paper's abstract).

The result is exact: each cell is stuck at each value in each window. The paper's network runs in
its low-rank form (:mod:`adaptfault.models.compact`), a fifth of the time.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from adaptfault.data.documents import members
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import Classifier
from diagnostics import Line, SensorLayout
from diagnostics.shown import shown

if TYPE_CHECKING:
    from torch import nn

    from adaptfault.models.network import TactileTransformer

SCHEMA = "adaptfault.sensitivity/1"
_NUMBERED = 5  # worst cells that the map numbers
_BATCH = 512  # stuck cells at once

Floats = NDArray[np.float64]
# windows [N, T, D] -> probability of each class [N, C]
_Answer = Callable[[NDArray[np.float32]], Floats]


@dataclass(frozen=True)
class WireLoss:
    """Loss by one broken wire.

    Attributes:
        line: the wire.
        value: reading of its cells on the 0..1 scale; for an address bit the level that it is stuck
            at.
        cells: number of cells affected.
        accuracy_lost, confidence_lost: as in :class:`Sensitivity`.
    """

    line: Line
    value: float
    cells: int
    accuracy_lost: float
    confidence_lost: float

    def __str__(self) -> str:
        return (
            f"{self.line} stuck at {self.value:g}: accuracy {-self.accuracy_lost:+.3f},"
            f" {self.cells} cells"
        )


@shown
@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Loss of a classifier by single faults. V values, D cells, C classes.

    "Lost" is fault-free minus faulty, so positive is worse. Confidence is the probability of the
    true class.

    Attributes:
        layout: the array.
        values: the V values that cells were stuck at, on the 0..1 scale.
        n: number of windows.
        accuracy, confidence: fault-free.
        accuracy_lost, confidence_lost: ``[V, D]``; 0 for positions without a cell.
        accuracy_lost_by_class, confidence_lost_by_class: ``[V, D, C]``, among the windows of one
        class; NaN for a class
            without windows.
        gradient: ``[V, D]``, the first-order estimate of the loss (rise of the cross entropy), from
            one backward pass.
        wires: broken wires, the worst first; empty with ``wires=False``.
    """

    layout: SensorLayout
    values: tuple[float, ...]
    n: int
    accuracy: float
    confidence: float
    accuracy_lost: Floats
    confidence_lost: Floats
    accuracy_lost_by_class: Floats
    confidence_lost_by_class: Floats
    gradient: Floats
    wires: tuple[WireLoss, ...] = ()

    @property
    def rank_correlation(self) -> Floats:
        """Spearman correlation of the gradient estimate and the exact confidence lost, over present
        cells, ``[V]``."""
        from scipy.stats import spearmanr

        present = self.layout.is_cell
        pairs = zip(self.gradient[:, present], self.confidence_lost[:, present], strict=True)
        return np.array(
            [spearmanr(a, b).statistic if np.ptp(a) and np.ptp(b) else np.nan for a, b in pairs]
        )

    def worst(self, n: int = _NUMBERED) -> list[tuple[int, float, float]]:
        """Return the n single faults that cost most accuracy: (cell, value, accuracy lost); ties by
        confidence."""
        order = np.argsort(
            -(self.accuracy_lost + 1e-9 * self.confidence_lost), axis=None, kind="stable"
        )
        places = [divmod(int(i), self.layout.n_cells) for i in order[:n]]
        return [(cell, self.values[v], float(self.accuracy_lost[v, cell])) for v, cell in places]

    def __str__(self) -> str:
        lines = [
            f"accuracy {self.accuracy:.3f}, confidence {self.confidence:.3f} on {self.n} windows,"
            " fault-free"
        ]
        for value, lost, rho in zip(
            self.values, self.accuracy_lost, self.rank_correlation, strict=True
        ):
            present = lost[self.layout.is_cell]
            lines.append(
                f"one cell at {value:g}: accuracy {-present.mean():+.3f} on average,"
                f" {-present.max():+.3f} at worst; gradient estimate: rank correlation {rho:.2f}"
            )
        for cell, value, lost in self.worst():
            lines.append(f"  {self.layout.place(cell)} at {value:g}: {-lost:+.3f}")
        return "\n".join([*lines, *(f"  {wire}" for wire in self.wires[:_NUMBERED])])

    def plot(self) -> Any:
        """Draw the accuracy lost on a map of each pad and value; return the matplotlib figure."""
        from diagnostics.decision.plot import draw_row, pads_figure

        figure, axes = pads_figure(self.layout, n_rows=len(self.values))
        shown = np.where(self.layout.is_cell, self.accuracy_lost, np.nan)
        for value, losses, row in zip(self.values, shown, axes, strict=True):
            # each value on its own scale: a short costs far more
            top = max(float(np.nanmax(losses)), 1 / self.n)
            title = f"stuck at {value:g}, "
            label = "accuracy lost"
            draw_row(row, losses, self.layout, title, top=top, cmap="Reds", label=label)
        for rank, (cell, value, lost) in enumerate(self.worst(), start=1):
            pad, at, col = self.layout.position(cell)
            if lost > 0:
                ax = axes[self.values.index(value), pad]
                ax.text(
                    col,
                    at,
                    str(rank),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white",
                    fontweight="bold",
                )
        return figure

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {"schema": SCHEMA, **members(self)}


def sensitivity(
    model: Classifier | nn.Module,
    windows: Windows,
    *,
    values: Sequence[float] = (0.0, 1.0),
    progress: bool | None = False,
) -> Floats:
    """Return the accuracy lost when one cell is stuck at one value, ``[len(values), D]``; negative
    is a gain.

    Args:
        model: a network, or anything with ``predict(x) -> int [N]``.
        windows: labelled and fault-free.
        values: on the 0..1 scale.
        progress: show or hide it on stderr; None shows it on a terminal.

    Raises:
        ValueError: no windows or values, or windows without labels.
        TypeError: ``model`` is neither.
    """
    usual, stuck = _enumerate(model, windows, values, progress)
    return usual.accuracy - stuck.accuracy


def analyse(
    model: TactileTransformer,
    windows: Windows,
    *,
    values: Sequence[float] = (0.0, 1.0),
    wires: bool = True,
    progress: bool | None = False,
) -> Sensitivity:
    """Return the loss by each single fault: of a cell, and with ``wires`` also of a row, a column,
    an address bit.

    The wires of the paper's array take as long as its cells. Otherwise as :func:`sensitivity`.

    Raises:
        ValueError: no windows or values, or windows without labels.
        TypeError: ``model`` is no :class:`~adaptfault.models.network.TactileTransformer`.
    """
    from adaptfault.models.network import TactileTransformer

    if not isinstance(model, TactileTransformer):
        raise TypeError(
            f"the analysis needs a TactileTransformer, got {type(model).__name__}; sensitivity()"
            " does not"
        )
    usual, stuck = _enumerate(model, windows, values, progress)
    return Sensitivity(
        layout=model.layout,
        values=tuple(float(v) for v in values),
        n=len(windows),
        accuracy=float(usual.accuracy[0, 0]),
        confidence=float(usual.mean_confidence[0, 0]),
        accuracy_lost=usual.accuracy - stuck.accuracy,
        confidence_lost=usual.mean_confidence - stuck.mean_confidence,
        accuracy_lost_by_class=usual.by_class(usual.right) - stuck.by_class(stuck.right),
        confidence_lost_by_class=usual.by_class(usual.confidence)
        - stuck.by_class(stuck.confidence),
        gradient=_gradient(model, windows, values),
        wires=_wires(model, windows, values, usual, progress) if wires else (),
    )


class _Tally:
    """Right answers and confidence of V x D faulty sensors, summed over the windows of each class,
    ``[V, D, C]``."""

    def __init__(self, n_values: int, n_cells: int, n_classes: int) -> None:
        self.right = np.zeros((n_values, n_cells, n_classes))
        self.confidence = np.zeros_like(self.right)
        self.n = np.zeros(n_classes)

    def add(self, probability: Floats, label: int, count: int) -> None:
        """Count the answers ``[V, D, C]`` to ``count`` equal windows of a class."""
        self.right[..., label] += count * (probability.argmax(-1) == label)
        self.confidence[..., label] += count * probability[..., label]
        self.n[label] += count

    @property
    def accuracy(self) -> Floats:
        return np.asarray(self.right.sum(-1) / self.n.sum())

    @property
    def mean_confidence(self) -> Floats:
        return np.asarray(self.confidence.sum(-1) / self.n.sum())

    def by_class(self, sums: Floats) -> Floats:
        """Return means of each class; NaN without windows."""
        return np.where(self.n > 0, sums / np.maximum(self.n, 1), np.nan)


def _enumerate(
    model: Classifier | nn.Module, windows: Windows, values: Sequence[float], progress: bool | None
) -> tuple[_Tally, _Tally]:
    """Return the tallies of the fault-free sensor, ``[1, 1, C]``, and of every single fault,
    ``[V, D, C]``."""
    if not len(windows) or windows.y.min() < 0 or not len(values):
        raise ValueError("sensitivity needs labelled windows and at least one value to be stuck at")
    levels = np.asarray(values, np.float32)
    n_cells = windows.x.shape[2]
    answer, n_classes = _answers(model, windows)
    layout = getattr(model, "layout", None)
    present = layout.is_cell if isinstance(layout, SensorLayout) else np.ones(n_cells, bool)
    usual = _Tally(1, 1, n_classes)
    stuck = _Tally(len(levels), n_cells, n_classes)
    hide = None if progress is None else not progress
    for which, labels in tqdm(_distinct(windows), desc="stuck cells", unit="window", disable=hide):
        window = windows.x[which]
        own = answer(window[None])[0]
        probability = np.tile(own, (*stuck.right.shape[:2], 1))
        # A cell that reads the value already changes nothing.
        v, c = np.nonzero((window != levels[:, None, None]).any(1) & present)
        if len(c):
            probability[v, c] = _stuck(answer, window, c, levels[v])
        for label, count in labels.items():
            usual.add(own[None, None], label, count)
            stuck.add(probability, label, count)
    return usual, stuck


def _distinct(windows: Windows) -> list[tuple[int, dict[int, int]]]:
    """Return an index for each distinct window (idle ones are often alike), and its count of each
    label."""
    alike: dict[bytes, tuple[int, dict[int, int]]] = {}
    for i, (x, label) in enumerate(zip(windows.x, windows.y.tolist(), strict=True)):
        labels = alike.setdefault(x.tobytes(), (i, {}))[1]
        labels[label] = labels.get(label, 0) + 1
    return list(alike.values())


def _answers(model: Classifier | nn.Module, windows: Windows) -> tuple[_Answer, int]:
    """Return what maps windows to probabilities, and C."""
    from torch import nn

    from adaptfault.models.compact import CompactNetwork
    from adaptfault.models.network import TactileTransformer, logits_of

    if isinstance(model, nn.Module):
        module = model
        if isinstance(model, TactileTransformer) and CompactNetwork.suits(model):
            module = CompactNetwork(model).to(model.head.weight.device)

        def answer(x: NDArray[np.float32]) -> Floats:
            return np.asarray(logits_of(module, x).double().softmax(1).numpy())

        n_classes = answer(windows.x[:1]).shape[1]
    elif callable(getattr(model, "predict", None)):
        classifier = model
        n_classes = int(windows.y.max()) + 2  # the last one stands for any other prediction

        def answer(x: NDArray[np.float32]) -> Floats:
            return np.asarray(
                np.asarray(classifier.predict(x))[:, None] == np.arange(n_classes), float
            )

    else:
        raise TypeError(
            f"expected something with predict(x) or a torch module, got {type(model).__name__}"
        )
    return answer, n_classes


def _stuck(
    answer: _Answer,
    window: NDArray[np.float32],
    cells: NDArray[np.intp],
    levels: NDArray[np.float32],
) -> Floats:
    """Return the probabilities ``[P, C]`` of a window ``[T, D]`` with each of some cells stuck at
    a level."""
    parts = []
    for start in range(0, len(cells), _BATCH):
        c = cells[start : start + _BATCH]
        stuck = np.repeat(window[None], len(c), axis=0)
        stuck[np.arange(len(c)), :, c] = levels[start : start + _BATCH, None]
        parts.append(answer(stuck))
    return np.concatenate(parts)


def _gradient(model: TactileTransformer, windows: Windows, values: Sequence[float]) -> Floats:
    """Return the rise of the cross entropy that its slope predicts, ``[V, D]``."""
    import torch

    frozen = copy.deepcopy(model).eval().requires_grad_(False)
    device = model.head.weight.device
    rise = np.zeros((len(values), windows.x.shape[2]))
    for start in range(0, len(windows), _BATCH):
        x = torch.from_numpy(windows.x[start : start + _BATCH].copy()).to(device).requires_grad_()
        y = torch.from_numpy(windows.y[start : start + _BATCH].copy()).to(device)
        (slope,) = torch.autograd.grad(
            torch.nn.functional.cross_entropy(frozen(x), y, reduction="sum"), x
        )
        for i, value in enumerate(values):
            rise[i] += ((value - x.detach()) * slope).sum((0, 1)).double().cpu().numpy()
    return rise / len(windows)


def _wires(
    model: TactileTransformer,
    windows: Windows,
    values: Sequence[float],
    usual: _Tally,
    progress: bool | None,
) -> tuple[WireLoss, ...]:
    """Return the loss by each broken wire, the worst first."""
    answer = _answers(model, windows)[0]
    hide = None if progress is None else not progress
    losses: list[WireLoss] = []
    for line in tqdm(model.layout.lines, desc="wires", unit="wire", disable=hide):
        address = line.kind.endswith("address")
        for value in (0.0, 1.0) if address else values:
            cells = model.layout.cells_on(line)
            x = windows.x.copy()
            if address:
                cells, sources = model.layout.misaddressed(line, int(value))
                x[..., cells] = np.where(sources >= 0, windows.x[..., np.maximum(sources, 0)], 0.0)
            else:
                x[..., cells] = value
            if not len(cells):
                continue
            p = answer(x)
            accuracy = usual.accuracy[0, 0] - (p.argmax(1) == windows.y).mean()
            confidence = usual.mean_confidence[0, 0] - p[np.arange(len(x)), windows.y].mean()
            lost = float(accuracy), float(confidence)
            losses.append(WireLoss(line, float(value), len(cells), *lost))
    return tuple(sorted(losses, key=lambda wire: (-wire.accuracy_lost, -wire.confidence_lost)))
