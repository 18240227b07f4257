"""Adapts the fault-free model to a fault set F, always from the fault-free weights, in stages that grow dearer."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cached_property
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from adaptfault.adaptation.forecast import Forecast
from adaptfault.adaptation.heads import MOST_WINDOWS
from adaptfault.adaptation.result import Adaptation
from adaptfault.adaptation.stages import Method, Run
from adaptfault.data.windows import Windows, evenly
from adaptfault.evaluation.scores import evaluate
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.imputation.tiled_statistics import LARGE, TiledStatistics
from adaptfault.models.compact import CompactNetwork, compacted
from adaptfault.models.network import TactileTransformer, logits_of
from diagnostics import FaultSet


class Adapter:
    """Repairs a fault-free model for any F.

    Windows without a label (y = -1) take the fault-free model's word for it: the heads learn its probabilities.

    Args:
        model: the fault-free model; it is never changed. The work is done on the CPU, unless :meth:`to` moves it.
        train, validation: fault-free windows, ``[N, T, D]``; more than 2500 for validation are thinned evenly.

    Raises:
        TypeError: ``model`` is another module.
        ValueError: there are no windows.
    """

    def __init__(self, model: TactileTransformer, train: Windows, validation: Windows) -> None:
        if not isinstance(model, TactileTransformer):
            raise TypeError(f"an adapter repairs a TactileTransformer, got {type(model).__name__}")
        if not len(train) or not len(validation):
            raise ValueError("an adapter needs fault-free windows to learn from and to validate on; one set is empty")
        self.model = model if model.head.weight.device.type == "cpu" else copy.deepcopy(model).cpu()
        self.train, self.targets = _labelled(model, train)
        most = MOST_WINDOWS // 2  # tell accuracies well enough apart
        self.validation, self.validation_targets = _labelled(model, validation.select(evenly(len(validation), most)))

    @cached_property
    def statistics(self) -> CellStatistics:
        """What the fills know of the fault-free frames; estimated once, used for every F."""
        return CellStatistics.fit(self.train)

    @cached_property
    def compact(self) -> CompactNetwork | None:
        """The fault-free network on fewer numbers; None where there are too few windows, or too many cells, for it."""
        return compacted(self.model, len(self.train) + len(self.validation))

    @cached_property
    def fills(self) -> CellStatistics | TiledStatistics:
        """What makes the fills: of a large array, what surrounds each cell; else ``statistics``."""
        layout = self.model.layout
        return TiledStatistics.fit(self.train, layout) if layout.n_cells > LARGE else self.statistics

    @cached_property
    def fault_free_accuracy(self) -> float:
        """Of the fault-free model on the fault-free validation windows."""
        return evaluate(self.compact or self.model, self.validation).accuracy

    def adapt(
        self,
        fault_set: FaultSet,
        *,
        method: Method = "auto",
        budget: float | None = None,
        seed: int = 0,
        progress: bool | None = None,
    ) -> Adaptation:
        """Return the model adapted to ``fault_set``, always from the fault-free weights: earlier F leave no trace.

        Args:
            fault_set: F, over the D cells of the model's layout.
            method: how far to go. "fill": the missing cells are expected from the healthy ones, no training. "head":
                then a new head is fitted in closed form, on the network's features and the healthy cells. "finetune":
                then everything is trained on, the front end too, in rounds that each end with a new head. "scratch":
                a new network is trained on the healthy cells, the paper's protocol. "auto": fill, then head, stopping
                if the fill keeps 99 % of the fault-free validation accuracy; then finetune if a budget is given and
                the head does not keep as much.
            budget: seconds that the stages after the fill may take; what does not fit is left out. None: until
                validation stops improving.
            seed: of training.
            progress: show or hide progress on stderr; None shows it on a terminal.

        Raises:
            ValueError: an unknown method, F over another number of cells, or no healthy cell left.
        """
        self.check(fault_set, method)
        return Run(self, fault_set, budget, seed, progress).go(method)

    def forecast(self, fault_set: FaultSet) -> Forecast:
        """Say what accuracy to expect of each stage, from validation windows with F taken away.

        Nothing is deployed or trained; it takes as long as ``method="head"``.

        Raises:
            ValueError: F over another number of cells, or no healthy cell left.
        """
        self.check(fault_set)
        windows = self.validation
        predicted = {"fault-free": logits_of(self.compact or self.model, windows.x).argmax(1).numpy()}
        if len(fault_set):
            run = Run(self, fault_set, None, 0, False)
            predicted["fill"] = run.held_out().argmax(1).numpy()
            run.head()
            predicted["head"] = run.held_out().argmax(1).numpy()
        return Forecast.of(fault_set, windows.y, windows.recording, predicted)

    def to(self, device: str | torch.device) -> Adapter:
        """Return an adapter that works on a device, as "cuda"; this one stays. What it adapts is on that device too."""
        other = copy.copy(self)
        other.model = copy.deepcopy(self.model).to(device)
        other.__dict__.pop("compact", None)  # is on the device that it was made on
        return other

    def check(self, fault_set: FaultSet, method: Method = "auto") -> None:
        """Refuse what cannot be adapted to.

        Raises:
            ValueError: an unknown method, F over another number of cells, or no healthy cell left.
        """
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}: use one of {', '.join(get_args(Method))}")
        d = self.train.x.shape[2]
        if fault_set.n_cells != d:
            raise ValueError(f"F is over {fault_set.n_cells} cells, the model over {d}")
        if not self.model.layout.present.ravel()[fault_set.healthy].any():
            raise ValueError(
                f"F holds all {int(self.model.layout.present.sum())} cells: no healthy one is left to predict from;"
                " replace the sensor"
            )


def _labelled(model: TactileTransformer, windows: Windows) -> tuple[Windows, NDArray[np.float32]]:
    """Return windows that all have a class, and their targets ``[N, n_classes]``: what has no label is distilled."""
    if windows.y.max() >= model.n_classes:
        raise ValueError(f"labels run to {windows.y.max()}, the model has {model.n_classes} classes")
    targets = np.eye(model.n_classes, dtype=np.float32)[np.maximum(windows.y, 0)]
    unknown = windows.y < 0
    if unknown.any():
        targets[unknown] = model.predict_proba(windows.x[unknown])
    return replace(windows, y=np.where(unknown, targets.argmax(1), windows.y)), targets
