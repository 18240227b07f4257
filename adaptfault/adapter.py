"""Adapts the fault-free model to a fault set F, always from the fault-free weights, in stages that grow dearer."""

from __future__ import annotations

import copy
import math
import time
from dataclasses import replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from adaptfault.adaptation import Adaptation, Stage
from adaptfault.evaluation import evaluate
from adaptfault.fills import CellStatistics
from adaptfault.forecast import Forecast
from adaptfault.heads import MOST_WINDOWS, Blend, calibrate, fit_head, linear_head
from adaptfault.history import History
from adaptfault.network import TactileTransformer, as_tensor, logits_of
from adaptfault.patch_fills import LARGE, PatchStatistics
from adaptfault.reduction import ReducedModel, reduce_windows
from adaptfault.training import train
from adaptfault.windows import Windows, evenly
from diagnostics import FaultSet

Method = Literal["auto", "fill", "head", "finetune", "scratch"]

_ENOUGH = 0.99  # auto stops at the first stage that keeps this share of the fault-free validation accuracy
_ROUND_EPOCHS, _ROUNDS, _ROUND_PATIENCE = 2, 6, 1  # of fine-tuning
_FOLDS = 5  # of validation recordings, each held out of a head in turn
_BATCH, _PILOT = 256, 500  # windows run at once; of a head made to see how long a whole one takes
_SCRATCH_EPOCHS, _SCRATCH_PATIENCE = 50, 10  # Section III-B: 50 at most


class Adapter:
    """Repairs a fault-free model for any F.

    Windows without a label (y = -1) take the fault-free model's word for it: the heads learn its probabilities.

    Args:
        model: the fault-free model; it is copied, never changed.
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
        self.model = model
        self.train, self.targets = _labelled(model, train)
        most = MOST_WINDOWS // 2  # tell accuracies well enough apart
        self.validation, self.validation_targets = _labelled(model, validation.select(evenly(len(validation), most)))

    @cached_property
    def statistics(self) -> CellStatistics:
        """What the fills know of the fault-free frames; estimated once, used for every F."""
        return CellStatistics.fit(self.train)

    @cached_property
    def fills(self) -> CellStatistics | PatchStatistics:
        """What makes the fills: of a large array, what surrounds each cell; else ``statistics``."""
        layout = self.model.layout
        return PatchStatistics.fit(self.train, layout) if layout.n_cells > LARGE else self.statistics

    @cached_property
    def fault_free_accuracy(self) -> float:
        """Of the fault-free model on the fault-free validation windows."""
        return evaluate(self.model, self.validation).accuracy

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
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}: use one of {', '.join(get_args(Method))}")
        self._check(fault_set)
        return _Run(self, fault_set, budget, seed, progress).go(method)

    def forecast(self, fault_set: FaultSet) -> Forecast:
        """Say what accuracy to expect of each stage, from validation windows with F taken away.

        Nothing is deployed or trained; it takes as long as ``method="head"``.

        Raises:
            ValueError: F over another number of cells, or no healthy cell left.
        """
        self._check(fault_set)
        windows = self.validation
        predicted = {"fault-free": self.model.predict(windows.x)}
        if len(fault_set):
            run = _Run(self, fault_set, None, 0, False)
            predicted["fill"] = run.held_out().argmax(1).numpy()
            run.head()
            predicted["head"] = run.held_out().argmax(1).numpy()
        return Forecast.of(fault_set, windows.y, windows.recording, predicted)

    def _check(self, fault_set: FaultSet) -> None:
        d = self.train.x.shape[2]
        if fault_set.n_cells != d:
            raise ValueError(f"F is over {fault_set.n_cells} cells, the model over {d}")
        if not self.model.layout.present.ravel()[fault_set.healthy].any():
            raise ValueError(
                f"F holds all {int(self.model.layout.present.sum())} cells: no healthy one is left to predict from;"
                " replace the sensor"
            )


class _Run:
    """One adaptation under way: ``reduced`` is the best model so far, ``logits`` its answers to the validation windows.

    Each answer is by a head that did not learn from that window.
    """

    def __init__(
        self, adapter: Adapter, fault_set: FaultSet, budget: float | None, seed: int, progress: bool | None
    ) -> None:
        self.adapter, self.fault_set, self.seed, self.progress = adapter, fault_set, seed, progress
        self.began, self.budget = time.perf_counter(), budget
        self.training = reduce_windows(adapter.train, fault_set)
        self.validation = reduce_windows(adapter.validation, fault_set)
        self.logits: Tensor | None = None
        self.head_seconds = 0.0
        fills = adapter.fills  # estimated once, not a cost of this F
        began = time.perf_counter()
        front = fills.nearest(fault_set) if len(fault_set) else None
        self.stages = [Stage("fill", time.perf_counter() - began)]
        self.reduced = ReducedModel(copy.deepcopy(adapter.model), fault_set, front).eval()

    def go(self, method: Method) -> Adaptation:
        """Run the stages of a method."""
        if not len(self.fault_set) and method != "scratch":
            return self.done()  # nothing to repair: the fault-free model, bit for bit
        match method:
            case "fill":
                pass
            case "scratch":
                self.scratch()
            case "head":
                self.head()
            case "finetune":
                self.head()
                self.finetune()
            case "auto":
                for stage in (self.head, self.finetune) if self.budget is not None else (self.head,):
                    if self.accuracy() >= _ENOUGH * self.adapter.fault_free_accuracy:
                        break
                    stage()
        return self.done()

    def head(self) -> None:
        """Fit a new head in closed form; kept if validation agrees that it is better."""
        linear = self.adapter.fills.linear(self.fault_set)
        self._keep_better("head", ReducedModel(self.reduced.network, self.fault_set, linear).eval())

    def finetune(self) -> None:
        """Train on, front end included, in rounds that each end with a new head; stop when a round brings nothing.

        A larger budget only allows more of the same rounds, so it never ends worse.
        """
        network = copy.deepcopy(self.adapter.model)
        reduced = ReducedModel(network, self.fault_set, self.adapter.fills.linear(self.fault_set)).eval()
        features = self._views(reduced, self.training)[0].double().numpy()
        weight, bias = linear_head(features, self.training.y, network.n_classes)
        network.head.load_state_dict({"weight": weight, "bias": bias})
        idle, took = 0, 0.0
        for number in range(_ROUNDS):
            if idle > _ROUND_PATIENCE or self.left() < took + self.head_seconds:
                break
            began = time.perf_counter()
            history = self._train(
                reduced, _ROUND_EPOCHS, seed=self.seed * _ROUNDS + number, reserve=self.head_seconds, patience=None
            )
            if history.stopped == "budget":
                break
            took = time.perf_counter() - began
            better = self._keep_better("finetune", copy.deepcopy(reduced), began)
            idle = 0 if better else idle + 1

    def scratch(self) -> None:
        """Train a new network behind the fill, as the paper does for each F."""
        model = self.adapter.model
        fresh = type(model).from_config({**model.config, "seed": self.seed + 1})
        self.reduced = ReducedModel(fresh, self.fault_set, self.adapter.fills.linear(self.fault_set))
        self.stages.clear()
        began = time.perf_counter()
        history = self._train(self.reduced, _SCRATCH_EPOCHS, seed=self.seed, patience=_SCRATCH_PATIENCE)
        self.stages.append(Stage("scratch", time.perf_counter() - began, history.best_accuracy))
        self.logits = None

    def held_out(self) -> Tensor:
        """Return the logits ``[N, n_classes]`` of the validation windows, from what did not learn from them."""
        if self.logits is None:
            self.logits = logits_of(self.reduced, self.validation.x)
        return self.logits

    def accuracy(self) -> float:
        """Return the validation accuracy as things stand."""
        accuracy = self._accuracy(self.held_out())
        if self.stages[-1].accuracy is None:
            self.stages[-1] = replace(self.stages[-1], accuracy=accuracy)
        return accuracy

    def _accuracy(self, logits: Tensor) -> float:
        return float((logits.argmax(1).numpy() == self.validation.y).mean())

    def left(self) -> float:
        """Return the seconds that are left; infinite without a budget."""
        return math.inf if self.budget is None else self.budget - (time.perf_counter() - self.began)

    def done(self) -> Adaptation:
        return Adaptation(
            self.reduced.eval(),
            self.fault_set,
            tuple(self.stages),
            _validation=self.adapter.validation,
            _held_out=None if self.logits is None else self.logits.argmax(1).numpy(),
        )

    def _keep_better(self, name: str, reduced: ReducedModel, began: float | None = None) -> bool:
        """Give ``reduced`` a new head and keep it if that is better; False where it is not, or time is short.

        Better is a higher validation accuracy, or the same at a lower cross entropy, each at its best scale.
        """
        before = self.accuracy(), -calibrate(self.held_out(), self.validation.y)[1]
        start = time.perf_counter()
        began = start if began is None else began
        fitted = self._head(reduced)
        if fitted is None:
            return False
        head, logits = fitted
        self.head_seconds = time.perf_counter() - start
        reached = self._accuracy(logits), -calibrate(logits, self.validation.y)[1]
        better = reached > before
        if better:
            reduced.head = head
            self.reduced, self.logits = reduced, logits
        self.stages.append(Stage(name, time.perf_counter() - began, max(before, reached)[0]))
        return better

    def _head(self, reduced: ReducedModel) -> tuple[Blend, Tensor] | None:
        """Return a head, and the logits of validation windows that it did not learn from; None if time is short."""
        adapter = self.adapter
        if self._too_long(reduced, len(self.training) + len(self.validation)):
            return None
        learnt = evenly(len(self.training), MOST_WINDOWS - len(self.validation))
        training = self.training.select(learnt)
        first, second = (self._views(reduced, windows) for windows in (training, self.validation))
        folds = np.unique(self.validation.recording, return_inverse=True)[1] % _FOLDS
        return fit_head(first, second, adapter.targets[learnt], adapter.validation_targets, folds)

    def _views(self, reduced: ReducedModel, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return both views of windows, computed in batches."""
        reduced.eval()
        with torch.no_grad():
            views = [reduced.views(x) for x in torch.split(as_tensor(windows.x), _BATCH)]
        return torch.cat([v[0] for v in views]), torch.cat([v[1] for v in views])

    def _too_long(self, reduced: ReducedModel, n: int) -> bool:
        """Say whether a head on n windows would not fit into the time left, going by what a few take."""
        if self.budget is None:
            return False
        few = self.training.select(slice(0, _BATCH))
        began = time.perf_counter()
        views = self._views(reduced, few)
        pace = (time.perf_counter() - began) / len(few)
        m = min(n, _PILOT)
        known = [view[torch.arange(m) % len(few)] for view in views]
        began = time.perf_counter()
        held, targets = m // 5, np.eye(self.adapter.targets.shape[1], dtype=np.float32)
        targets = targets[np.arange(m) % len(targets)]
        first, second = [v[held:] for v in known], [v[:held] for v in known]
        fit_head(first, second, targets[held:], targets[:held], np.arange(held) % _FOLDS)
        fit = (time.perf_counter() - began) * (n / m) ** 1.8  # between the forest's 1 and the kernel's 3
        return bool(pace * n + fit > self.left())

    def _train(
        self, reduced: ReducedModel, epochs: int, *, seed: int, patience: int | None, reserve: float = 0.0
    ) -> History:
        return train(
            reduced,
            self.training,
            self.validation,
            epochs=epochs,
            patience=patience,
            budget=None if self.budget is None else max(0.0, self.left() - reserve),
            seed=seed,
            progress=self.progress,
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
