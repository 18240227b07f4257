"""Fault-aware training (Section III-C): windows with random faults are added to the training data.

The paper adds 10 000, 100 000 or 200 000 windows. Here each window is generated from its index when
training needs it: the same set in every epoch, without storage. The paper has faults in scattered
cells only; real arrays also lose lines and patches, which ``kind`` selects.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from adaptfault.adaptation.baselines.random_faults import FaultPattern, RandomFaults
from adaptfault.data.windows import Windows
from adaptfault.models import training
from adaptfault.models.history import History
from diagnostics import SensorLayout


class FaultySamples:
    """Windows with random faults, generated on demand: sample i is always the same.

    Sample i is a window drawn from ``windows`` with k cells open (0) or short (full scale), each
    with equal chance; k is drawn from ``n_faults``. A faulty line or block reads one of the two as
    a whole.

    Args:
        windows: fault-free.
        layout: the array.
        n: number of samples.
        n_faults: numbers of faults to draw from: of cells, or of lines or blocks; (0,) gives the
            same windows healthy.
        kind: "cells", "lines" or "blocks"
            (:class:`~adaptfault.adaptation.baselines.random_faults.RandomFaults`).
        seed: of windows and faults.

    Raises:
        ValueError: no windows, another number of cells than the layout's, an unknown kind, faults
            that do not fit.
    """

    def __init__(
        self,
        windows: Windows,
        layout: SensorLayout,
        *,
        n: int,
        n_faults: Sequence[int] = (5, 10),
        kind: FaultPattern = "cells",
        seed: int = 0,
    ) -> None:
        self.faults = RandomFaults(layout, kind)
        if n < 0 or not len(n_faults) or min(n_faults) < 0 or max(n_faults) > self.faults.most:
            most = self.faults.most
            raise ValueError(
                f"expected n >= 0 and numbers of faults from 0 to {most}, got {n} and"
                f" {list(n_faults)}"
            )
        if not len(windows) or windows.x.shape[2] != layout.n_cells:
            raise ValueError(
                f"expected windows of {layout.n_cells} cells, got {list(windows.x.shape)}"
            )
        self.windows = windows
        self.layout = layout
        self.n_faults = tuple(n_faults)
        self.kind = kind
        self.seed = seed
        self.source = np.random.default_rng(seed).integers(len(windows), size=n)
        self.y: NDArray[np.int64] = windows.y[self.source]

    def __len__(self) -> int:
        return len(self.source)

    def __str__(self) -> str:
        return f"{len(self)} windows with {self.n_faults} faulty {self.kind}, seed {self.seed}"

    def draw(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the samples with these indices, ``[B, T, D]``."""
        x = self.windows.x[self.source[index]]
        for window, i in zip(x, index.tolist(), strict=True):
            rng = np.random.default_rng([self.seed, i])
            for cells, value in self.faults.draw(int(rng.choice(self.n_faults)), rng):
                window[:, cells] = value
        return x


def train_fault_aware(
    model: nn.Module,
    train: Windows,
    validation: Windows,
    *,
    n_faults: Sequence[int] = (5, 10),
    n_samples: int = 10_000,
    kind: FaultPattern = "cells",
    seed: int = 0,
    **options: Any,
) -> History:
    """Train ``model`` in place on fault-free windows and on ``n_samples`` more with random faults
    (Section III-C).

    The selected weights are best on validation windows of which half have faults of the same kind.
    (The paper selects on fault-free windows, which do not measure the robustness to faults.)

    Args:
        model: a network of a known layout.
        train, validation: fault-free windows.
        n_faults: numbers of faults in a sample, drawn with equal chance. (0,) is the control: the
            same windows in the same order, as many steps, no faults.
        n_samples: windows with faults in an epoch, the same in each epoch.
        kind: "cells" as in the paper, "lines" or "blocks" (:class:`FaultySamples`).
        seed: of the faults, and of training.
        options: further arguments of :func:`adaptfault.train`, as ``epochs``.

    Raises:
        ValueError: as :class:`FaultySamples` and :func:`adaptfault.train`.
        TypeError: the model has no layout.
    """
    layout = getattr(model, "layout", None)
    if not isinstance(layout, SensorLayout):
        raise TypeError(
            f"fault-aware training needs a network of a known layout, got {type(model).__name__}"
        )
    added = FaultySamples(train, layout, n=n_samples, n_faults=n_faults, kind=kind, seed=seed)
    broken = FaultySamples(
        validation, layout, n=len(validation), n_faults=n_faults, kind=kind, seed=seed + 1
    )
    both = Windows(
        np.concatenate([validation.x, broken.draw(np.arange(len(broken)))]),
        np.concatenate([validation.y, broken.y]),
        np.concatenate([validation.recording, validation.recording[broken.source]]),
    )
    return training.train(
        model, train, both, more=added if n_samples else None, seed=seed, **options
    )
