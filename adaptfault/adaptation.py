"""Adapts the fault-free model to a fault set F, always from the fault-free weights, in stages that grow dearer."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.evaluation import Scores, evaluate
from adaptfault.network import TactileTransformer, as_tensor, logits_of
from adaptfault.reduction import AffineFill, CellStatistics, ReducedModel, phi, reduce_windows
from adaptfault.store import load_tensors, save_tensors
from adaptfault.training import train
from adaptfault.windows import Windows
from diagnostics import FaultSet

Method = Literal["auto", "fill", "head", "finetune", "scratch"]

SCHEMA = "adaptfault.adaptation/1"

_HEAD_C = 0.3  # inverse strength of the refitted head's ridge penalty
_ENOUGH = 0.99  # auto stops at the first stage that keeps this share of the fault-free validation accuracy
_FINETUNE_EPOCHS, _FINETUNE_PATIENCE = 12, 3
_SCRATCH_EPOCHS, _SCRATCH_PATIENCE = 50, 10  # Section III-B: 50 at most


@dataclass(frozen=True)
class Stage:
    """What one stage of an adaptation cost and reached.

    Attributes:
        name: "fill", "head", "finetune" or "scratch".
        seconds: wall clock, without the scoring.
        accuracy: on validation; None where it was not needed to go on.
    """

    name: str
    seconds: float
    accuracy: float | None = None

    def __str__(self) -> str:
        reached = "" if self.accuracy is None else f", validation accuracy {self.accuracy:.3f}"
        return f"{self.name}: {self.seconds:.2f} s{reached}"


@dataclass(frozen=True, eq=False)
class Adaptation:
    """A model adapted to F.

    Attributes:
        model: the reduced model, from the D - k healthy cells to logits.
        fault_set: F.
        stages: what each stage cost and reached, in the order they ran.
    """

    model: ReducedModel
    fault_set: FaultSet
    stages: tuple[Stage, ...]
    _validation: Windows | None = field(default=None, repr=False)
    _scores: Scores | None = field(default=None, repr=False)

    def predict(self, x: NDArray[Any] | Tensor) -> NDArray[np.int64]:
        """Return the class of each window ``[N, T, D]``, int64 ``[N]``; F's cells may hold anything, NaN too."""
        classes: NDArray[np.int64] = self._logits(x).argmax(1).numpy()
        return classes

    def predict_proba(self, x: NDArray[Any] | Tensor) -> NDArray[np.float32]:
        """Return class probabilities ``[N, n_classes]`` of windows ``[N, T, D]``."""
        probabilities: NDArray[np.float32] = self._logits(x).softmax(1).numpy()
        return probabilities

    def _logits(self, x: NDArray[Any] | Tensor) -> Tensor:
        return logits_of(self.model, phi(np.asarray(x, dtype=np.float32), self.fault_set))

    @cached_property
    def scores(self) -> Scores:
        """Scores on the fault-free validation windows with F taken away; computed when first asked for."""
        if self._scores is not None:
            return self._scores
        if self._validation is None:
            raise ValueError("this adaptation was loaded without scores")
        return evaluate(self, self._validation)

    def save(self, path: str | Path) -> None:
        """Write to a folder: weights as safetensors, the rest as JSON, no pickle."""
        about = {
            "network": self.model.network.config,
            "fault_set": list(self.fault_set),
            "stages": [vars(stage) for stage in self.stages],
            "scores": self.scores.to_dict(),
        }
        save_tensors(path, SCHEMA, about, self.model.state_dict())

    @classmethod
    def load(cls, path: str | Path) -> Adaptation:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: there is nothing, or a file is missing.
            ValueError: a file is damaged or of another kind.
        """
        about, tensors = load_tensors(path, SCHEMA)
        try:
            network = TactileTransformer.from_config(about["network"])
            fault_set = FaultSet(tuple(about["fault_set"]), network.layout.n_cells)
            k = len(fault_set)
            front = AffineFill(fault_set, np.zeros((k, fault_set.n_cells - k)), np.zeros(k)) if k else None
            model = ReducedModel(network, fault_set, front)
            model.load_state_dict(tensors)
            stages = tuple(Stage(**stage) for stage in about["stages"])
            scores = Scores.from_dict(about["scores"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"the adaptation in {path} is damaged: {str(error).splitlines()[0]}") from None
        return cls(model.eval(), fault_set, stages, _scores=scores)


class Adapter:
    """Repairs a fault-free model for any F.

    Args:
        model: the fault-free model; it is copied, never changed.
        train, validation: fault-free windows, ``[N, T, D]``.

    Raises:
        TypeError: ``model`` is another module.
        ValueError: there are no windows.
    """

    def __init__(self, model: TactileTransformer, train: Windows, validation: Windows) -> None:
        if not isinstance(model, TactileTransformer):
            raise TypeError(f"an adapter repairs a TactileTransformer, got {type(model).__name__}")
        if not len(train) or not len(validation):
            raise ValueError("an adapter needs fault-free windows to learn from and to validate on; one set is empty")
        self.model, self.train, self.validation = model, train, validation

    @cached_property
    def statistics(self) -> CellStatistics:
        """Mean and covariance of the fault-free frames; estimated once, used for every F."""
        return CellStatistics.fit(self.train)

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
        """Return the model adapted to ``fault_set``.

        Args:
            fault_set: F, over the D cells of the model's layout.
            method: how far to go. "fill": the missing cells are expected from the healthy ones, no training. "head":
                then the last layer is refitted in closed form. "finetune": then everything is trained on, the front
                end too. "scratch": a new network is trained on the healthy cells, the paper's protocol. "auto": fill,
                head, finetune, stopping at the first that keeps 99 % of the fault-free validation accuracy.
            budget: seconds of training allowed; None trains until validation stops improving.
            seed: of training.
            progress: show or hide progress on stderr; None shows it on a terminal.

        Raises:
            ValueError: an unknown method, F over another number of cells, or no healthy cell left.
        """
        if method not in get_args(Method):
            raise ValueError(f"unknown method {method!r}: use one of {', '.join(get_args(Method))}")
        d = self.train.x.shape[2]
        if fault_set.n_cells != d:
            raise ValueError(f"F is over {fault_set.n_cells} cells, the model over {d}")
        if not len(fault_set.healthy):
            raise ValueError(f"F holds all {d} cells: no healthy one is left to predict from; replace the sensor")
        return _Run(self, fault_set, budget, seed, progress).go(method)


class _Run:
    """One adaptation under way."""

    def __init__(
        self, adapter: Adapter, fault_set: FaultSet, budget: float | None, seed: int, progress: bool | None
    ) -> None:
        self.adapter, self.fault_set, self.budget = adapter, fault_set, budget
        self.seed, self.progress = seed, progress
        self.stages: list[Stage] = []
        self.reduced = self.filled(copy.deepcopy(adapter.model))

    def go(self, method: Method) -> Adaptation:
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
                for stage in (self.head, self.finetune):
                    if self.accuracy() >= _ENOUGH * self.adapter.fault_free_accuracy:
                        break
                    stage()
        return self.done()

    def filled(self, network: TactileTransformer) -> ReducedModel:
        began = time.perf_counter()
        front = AffineFill(self.fault_set, *self.adapter.statistics.conditional_mean(self.fault_set))
        reduced = ReducedModel(network, self.fault_set, front).eval()
        self.stages.append(Stage("fill", time.perf_counter() - began))
        return reduced

    def head(self) -> None:
        """Refit the last layer as a multinomial logistic regression on the features of the filled windows."""
        from sklearn.linear_model import LogisticRegression
        from sklearn.preprocessing import StandardScaler

        began = time.perf_counter()
        windows = reduce_windows(self.adapter.train, self.fault_set)
        reduced, before = self.reduced, self.accuracy()
        network = reduced.network
        features = logits_of(_Features(reduced), windows.x).double().numpy()
        scaler = StandardScaler().fit(features)
        classifier = LogisticRegression(C=_HEAD_C, max_iter=300).fit(scaler.transform(features), windows.y)
        coefficients, intercept = classifier.coef_, classifier.intercept_
        if len(classifier.classes_) == 2:  # scikit-learn keeps one row then
            coefficients, intercept = np.vstack([-coefficients, coefficients]) / 2, np.array([-1, 1]) * intercept / 2
        weight = coefficients / scaler.scale_
        bias = intercept - weight @ scaler.mean_
        kept = copy.deepcopy(network.head.state_dict())
        with torch.no_grad():
            # A class that the training windows lack is never the answer.
            network.head.weight.zero_()
            network.head.bias.fill_(-1e4)
            network.head.weight[classifier.classes_] = as_tensor(weight.astype(np.float32))
            network.head.bias[classifier.classes_] = as_tensor(bias.astype(np.float32))
        seconds = time.perf_counter() - began
        reached = self._score()
        if reached < before:  # a stage may cost time, never accuracy
            network.head.load_state_dict(kept)
            reached = before
        self.stages.append(Stage("head", seconds, reached))

    def finetune(self) -> None:
        """Train on, front end included, starting where the head left off; never ends worse."""
        self._train("finetune", _FINETUNE_EPOCHS, _FINETUNE_PATIENCE, start=True)

    def scratch(self) -> None:
        """Train a new network behind the fill, as the paper does for each F."""
        model = self.adapter.model
        fresh = type(model).from_config({**model.config, "seed": self.seed + 1})
        self.reduced = ReducedModel(fresh, self.fault_set, self.reduced.front)
        self.stages.clear()
        self._train("scratch", _SCRATCH_EPOCHS, _SCRATCH_PATIENCE, start=False)

    def _train(self, name: str, epochs: int, patience: int, *, start: bool) -> None:
        began = time.perf_counter()
        history = train(
            self.reduced,
            reduce_windows(self.adapter.train, self.fault_set),
            reduce_windows(self.adapter.validation, self.fault_set),
            epochs=epochs,
            patience=patience,
            budget=self.budget,
            seed=self.seed,
            evaluate_start=start,
            progress=self.progress,
        )
        self.stages.append(Stage(name, time.perf_counter() - began, history.best_accuracy))

    def accuracy(self) -> float:
        """Validation accuracy as things stand, kept with the last stage."""
        last = self.stages[-1]
        if last.accuracy is None:
            self.stages[-1] = last = Stage(last.name, last.seconds, self._score())
        assert last.accuracy is not None
        return last.accuracy

    def _score(self) -> float:
        return evaluate(self.reduced, reduce_windows(self.adapter.validation, self.fault_set)).accuracy

    def done(self) -> Adaptation:
        return Adaptation(self.reduced, self.fault_set, tuple(self.stages), _validation=self.adapter.validation)


class _Features(nn.Module):
    """The reduced model up to its head, as a module that can be run in batches."""

    def __init__(self, reduced: ReducedModel) -> None:
        super().__init__()
        self.reduced = reduced

    def forward(self, x: Tensor) -> Tensor:
        return self.reduced.features(x)
