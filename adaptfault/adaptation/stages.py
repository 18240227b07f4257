"""One adaptation: imputation, a new head, fine-tuning or training anew, each kept only if
validation improves."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.fault_free import FaultFreeModel, Network
from adaptfault.adaptation.reduced_model import ReducedModel, reduce_windows
from adaptfault.adaptation.result import Adaptation, Stage
from adaptfault.data.determination import explained
from adaptfault.data.windows import Windows, evenly
from adaptfault.models.any_model import device_of
from adaptfault.models.compact import CompactNetwork
from adaptfault.models.forest import fit_forest
from adaptfault.models.heads import (
    MOST_WINDOWS,
    Head,
    fit_head,
    linear_head,
)
from adaptfault.models.history import History
from adaptfault.models.kernels import Views
from adaptfault.models.network import as_tensor, batches, logits_of
from adaptfault.models.targets import calibrate, log_likelihood
from adaptfault.models.training import train
from adaptfault.models.value_units import ValueUnits, foldable
from diagnostics import FaultSet

Method = Literal["auto", "fill", "head", "finetune", "scratch"]

# auto does not fine-tune a repair that keeps this share of the healthy validation accuracy
_ENOUGH = 0.99
_NOISE = 1.0  # standard errors of a gain on validation that auto takes for noise
_CHOSEN = 2.0  # those by which the best of several epochs looks better than it is
# of fine-tuning
_ROUND_EPOCHS = 2
_ROUNDS = 6
_ROUND_PATIENCE = 1
_FOLDS = 5  # of validation recordings, each held out of a head in turn
# windows run at once; windows of a trial fit that measures the time of a head
_BATCH = 256
_PILOT = 500
# Section III-B: 50 at most
_SCRATCH_EPOCHS = 50
_SCRATCH_PATIENCE = 10


class Run:
    """One adaptation in progress: ``reduced`` is the best model so far, ``logits`` its validation
    outputs.

    The outputs for each validation window come from a head that was fitted without this window.
    """

    def __init__(
        self,
        fault_free: FaultFreeModel,
        fault_set: FaultSet,
        budget: float | None,
        seed: int,
        progress: bool | None,
        healthy: Callable[[], float] = lambda: 1.0,
    ) -> None:
        self.fault_free = fault_free
        self.fault_set = fault_set
        self.seed = seed
        self.progress = progress
        self.budget = budget
        # accuracy without faults; standard errors that a gain has to exceed
        self.healthy = healthy
        self.noise = 0.0
        self.training = reduce_windows(fault_free.train, fault_set)
        self.validation = reduce_windows(fault_free.validation, fault_set)
        self.logits: Tensor | None = None
        # low-rank form of the network with its present weights
        self.quick: CompactNetwork | None = None
        self.head_seconds = 0.0
        imputation = fault_free.imputation  # estimated once, not a cost of this F
        began = time.perf_counter()
        front = imputation.nearest(fault_set) if len(fault_set) else None
        self.stages = [Stage("fill", time.perf_counter() - began)]
        self.reduced = self._behind(front, copy.deepcopy(fault_free.model))

    def execute(self, method: Method) -> Adaptation:
        """Run the stages of a method and return the adaptation."""
        if not len(self.fault_set) and method == "fill":
            return self.done()  # nothing to impute: the fault-free model, bit for bit
        if method not in ("fill", "scratch"):
            self.quick = self.fault_free.compact  # computed once, not a cost of this F
        self.began = time.perf_counter()
        match method:
            case "scratch":
                self.scratch()
            case "head":
                self.head()
            case "finetune":
                if not (self.fault_free.acts and len(self.fault_set)):
                    self.head()
                if len(self.fault_set):
                    self.finetune()
            case "auto":
                self.noise = _NOISE
                self.head()
                if (
                    self.budget is not None
                    and len(self.fault_set)
                    and self.accuracy() < _ENOUGH * self.healthy()
                ):
                    self.finetune()
        return self.done()

    def head(self) -> None:
        """Fit a new head in closed form; keep it if validation improves. A model without features
        keeps its own."""
        if self.fault_free.has_features:
            linear = self.fault_free.imputation.linear(self.fault_set)
            self._keep_better("head", self._behind(linear, self.reduced.network))

    def finetune(self) -> None:
        """Train all parameters, front end included, in rounds that each end with a new head.

        It stops when rounds no longer improve validation. A larger budget allows more of the same
        rounds, so its result is never worse. A policy keeps its own last layer instead, and starts
        from the fill: a head takes its time at each round, and again at each step of the robot.
        """
        network = copy.deepcopy(self.fault_free.model)
        front: nn.Module | None = self.fault_free.imputation.linear(self.fault_set)
        if self.fault_free.acts:
            front = copy.deepcopy(self.reduced.front)
        reduced = self._behind(front, network)
        if self.fault_free.task == "classification" and network.head is not None:
            features = self._views(reduced, self.training).features.cpu().double().numpy()
            weight, bias = linear_head(features, self.training.y, network.n_classes)
            with torch.no_grad():
                network.head.weight.copy_(weight)
                if network.head.bias is not None:
                    network.head.bias.copy_(bias)
        idle = 0
        took = 0.0
        for number in range(_ROUNDS):
            if idle > _ROUND_PATIENCE or self.left() < took + self.head_seconds:
                break
            began = time.perf_counter()
            self.quick = None  # holds other weights
            history = self._train(
                reduced, _ROUND_EPOCHS, self.seed * _ROUNDS + number, reserve=self.head_seconds
            )
            if history.stopped == "budget":
                break
            self.quick = self.fault_free.compacted(network)
            took = time.perf_counter() - began
            better = self._keep_better("finetune", copy.deepcopy(reduced), began)
            idle = 0 if better else idle + 1

    def scratch(self) -> None:
        """Train a new network behind the linear front end, as the paper does for each F."""
        fresh = self.fault_free.fresh(self.seed + 1)
        self.reduced = self._behind(self.fault_free.imputation.linear(self.fault_set), fresh)
        self.stages.clear()
        began = time.perf_counter()
        history = self._train(
            self.reduced, _SCRATCH_EPOCHS, self.seed, patience=_SCRATCH_PATIENCE, fresh=True
        )
        self.stages.append(Stage("scratch", time.perf_counter() - began, history.best_accuracy))
        self.logits = None

    def held_out(self) -> Tensor:
        """Return the outputs ``[N, n]`` for the validation windows, each from a head fitted without
        it."""
        if self.logits is None:
            windows = self.validation
            self.logits = logits_of(self._quickly(self.reduced), windows.x, windows.extra)
        return self.logits

    def accuracy(self) -> float:
        """Return the validation accuracy (R2 of a regression) of the best model so far."""
        accuracy = self.fault_free.score(self.held_out())
        if self.stages[-1].accuracy is None:
            self.stages[-1] = replace(self.stages[-1], accuracy=accuracy)
        return accuracy

    def _quality(self, outputs: Tensor) -> tuple[float, float]:
        """Return accuracy and negative cross entropy at its best scale, or R2 twice."""
        score = self.fault_free.score(outputs)
        if self.fault_free.task == "regression":
            return score, score
        return score, -calibrate(outputs, self.validation.y)[1]

    def left(self) -> float:
        """Return the seconds left; infinite without a budget."""
        return math.inf if self.budget is None else self.budget - (time.perf_counter() - self.began)

    def done(self) -> Adaptation:
        """Return the best adaptation so far."""
        return Adaptation(
            self.reduced.eval(),
            self.fault_set,
            tuple(replace(stage, measure=self.fault_free.measure) for stage in self.stages),
            task=self.fault_free.task,
            _validation=self.fault_free.validation,
            _held_out=self.logits,
        )

    def _keep_better(self, name: str, reduced: ReducedModel, began: float | None = None) -> bool:
        """Give ``reduced`` a new head and keep it if validation improves; False if it does not, or
        time is short."""
        self.accuracy()
        before = self._quality(self.held_out())
        start = time.perf_counter()
        began = start if began is None else began
        fitted = self._head(reduced, own=name == "finetune" and self.fault_free.acts)
        if fitted is None:
            return False
        head, logits = fitted
        self.head_seconds = time.perf_counter() - start
        reached = self._quality(logits)
        better = self._is_better(name, logits, reached > before)
        if better:
            reduced.head = head
            self.reduced = reduced
            self.logits = logits
        kept = reached if better else before
        self.stages.append(Stage(name, time.perf_counter() - began, kept[0]))
        return better

    def _is_better(self, name: str, outputs: Tensor, improves: bool) -> bool:
        """Return whether a stage with these validation outputs is kept; ``improves``: its score is
        higher.

        For auto the gain counts in its standard errors: that of the logarithm of the probability of
        the true class, or of R2; the standard error is that of a mean of clusters, one for each
        recording. A head is kept unless it loses more than two of them: it is scored on windows
        that it has not seen, but the network is the best of its epochs on these. Fine-tuning has to
        gain more than one.
        """
        if not self.noise:
            return improves
        gain = self._merit(outputs) - self._merit(self.held_out())
        _, inverse = np.unique(self.validation.recording, return_inverse=True)
        deviation = np.bincount(inverse, weights=gain - gain.mean())
        error = np.sqrt((deviation**2).sum()) / len(gain)
        if name == "head":
            return bool(gain.mean() > -_CHOSEN * error)
        return improves and bool(gain.mean() > self.noise * error)

    def _merit(self, outputs: Tensor) -> NDArray[np.float64]:
        """Return for each validation window the log probability of its class, or its share of
        R2."""
        if self.fault_free.task == "regression":
            shares: NDArray[np.float64] = explained(self.validation.y, outputs.numpy()).mean(axis=1)
            return shares
        return log_likelihood(outputs, self.validation.y)

    def _head(self, reduced: ReducedModel, own: bool = False) -> tuple[Head | None, Tensor] | None:
        """Return a head, and the outputs for validation windows of heads fitted without them; None
        if time is short.

        A model without features, or told to, keeps its ``own`` head.
        """
        if own or not self.fault_free.has_features:
            return None, logits_of(reduced, self.validation.x, self.validation.extra)
        if self._too_long(reduced, len(self.training) + len(self.validation)):
            return None
        used = evenly(len(self.training), MOST_WINDOWS - len(self.validation))
        first = self._views(reduced, self.training.select(used))
        second = self._views(reduced, self.validation)
        folds = np.unique(self.validation.recording, return_inverse=True)[1] % _FOLDS
        targets = self.fault_free.targets[used], self.fault_free.validation_targets
        return self._fit(first, second, *targets, folds)

    def _fit(
        self,
        first: Views,
        second: Views,
        targets: NDArray[np.float32],
        held_targets: NDArray[np.float32],
        folds: NDArray[np.int64],
        *,
        forest: bool = True,
    ) -> tuple[Head, Tensor]:
        values = self.fault_free.task == "regression"
        return fit_head(
            first,
            second,
            targets,
            held_targets,
            folds,
            rest=self.reduced.rest,
            values=values,
            forest=forest,
        )

    def _behind(self, front: nn.Module | None, network: Network) -> ReducedModel:
        """Return the reduced model of a front end and a network, on the device of the adapter."""
        rest = self.fault_free.rest
        reduced = ReducedModel(network, self.fault_set, front, rest=rest)
        return reduced.to(device_of(self.fault_free.model)).eval()

    def _quickly(self, reduced: ReducedModel) -> ReducedModel:
        """Return the same model with its network in low-rank form, if there is one for these
        weights."""
        if self.quick is None:
            return reduced
        same = ReducedModel(
            reduced.network, self.fault_set, reduced.front, reduced.head, reduced.rest
        )
        same.add_module("network", self.quick)
        return same.eval()

    def _views(self, reduced: ReducedModel, windows: Windows) -> Views:
        """Return the views of windows, computed in batches, on the device of the adapter."""
        quick = self._quickly(reduced.eval())
        device = device_of(self.fault_free.model)
        with torch.no_grad():
            views = []
            for x, extra in batches(as_tensor(windows.x), windows.extra, _BATCH):
                others = {name: values.to(device) for name, values in extra.items()}
                views.append(quick.views(x.to(device), **others))
        return Views(*(torch.cat(parts) for parts in zip(*views, strict=True)))

    def _too_long(self, reduced: ReducedModel, n: int) -> bool:
        """Return whether a head on n windows exceeds the time left, extrapolated from a trial on a
        few windows."""
        if self.budget is None:
            return False
        few = self.training.select(slice(0, _BATCH))
        began = time.perf_counter()
        views = self._views(reduced, few)
        pace = (time.perf_counter() - began) / len(few)
        m = min(n, _PILOT)
        known = views.select(np.arange(m) % len(few))
        held = m // 5
        k = self.fault_free.targets.shape[1]
        targets = np.eye(k, dtype=np.float32)[np.arange(m) % k]
        if self.fault_free.task == "regression":
            targets = self.fault_free.targets[np.arange(m) % len(self.fault_free.targets)]
        began = time.perf_counter()
        folds = np.arange(held) % _FOLDS
        first = known.select(slice(held, None))
        second = known.select(slice(0, held))
        self._fit(first, second, targets[held:], targets[:held], folds, forest=False)
        kernels = (time.perf_counter() - began) * (n / m) ** 2.5  # distances (2) and solves (3)
        began = time.perf_counter()
        values = self.fault_free.task == "regression"
        fit_forest(known.course.cpu().numpy(), targets, folds, values=values)
        trees = (time.perf_counter() - began) * (n / m) ** 1.2  # n log n
        return bool(pace * n + kernels + trees > self.left())

    def _train(
        self,
        reduced: ReducedModel,
        epochs: int,
        seed: int,
        *,
        patience: int | None = None,
        reserve: float = 0.0,
        fresh: bool = False,
    ) -> History:
        """Train a reduced model; ``reserve`` seconds of the budget stay for a head.

        The values of a regression are standardised meanwhile, if the last layer of the network can
        take up their units and no loss is given. A ``fresh`` network has not taken them up.
        """
        training = self.training
        validation = self.validation
        units = None
        values = self.fault_free.task == "regression" and self.fault_free.loss is None
        if values and foldable(reduced.network, training.extra):
            units = ValueUnits.of(training)
            if not fresh:
                units.unfold(reduced.network)
            training = units.standardised(training)
            validation = units.standardised(validation)
        history = train(
            reduced,
            training,
            validation,
            epochs=epochs,
            patience=patience,
            budget=None if self.budget is None else max(0.0, self.left() - reserve),
            seed=seed,
            loss=self.fault_free.loss,
            progress=self.progress,
        )
        if units is not None:
            units.fold(reduced.network)
        return history
