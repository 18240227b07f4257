"""One adaptation under way: stages that grow dearer, and the training that they ask for."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor, nn

from adaptfault.adaptation.heads import MOST_WINDOWS, Blend, calibrate, fit_head, linear_head
from adaptfault.adaptation.reduced_model import ReducedModel, reduce_windows
from adaptfault.adaptation.result import Adaptation, Stage
from adaptfault.data.windows import Windows, evenly
from adaptfault.models.compact import CompactNetwork, compacted
from adaptfault.models.history import History
from adaptfault.models.network import TactileTransformer, as_tensor, logits_of
from adaptfault.models.training import train
from diagnostics import FaultSet

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter

Method = Literal["auto", "fill", "head", "finetune", "scratch"]

_ENOUGH = 0.99  # auto stops at the first stage that keeps this share of the fault-free validation accuracy
_ROUND_EPOCHS, _ROUNDS, _ROUND_PATIENCE = 2, 6, 1  # of fine-tuning
_FOLDS = 5  # of validation recordings, each held out of a head in turn
_BATCH, _PILOT = 256, 500  # windows run at once; of a head made to see how long a whole one takes
_SCRATCH_EPOCHS, _SCRATCH_PATIENCE = 50, 10  # Section III-B: 50 at most


@dataclass(frozen=True, eq=False)
class Lesson:
    """Training that an adaptation asks for: as :func:`~adaptfault.models.training.train` takes it."""

    reduced: ReducedModel
    epochs: int
    seed: int
    patience: int | None
    reserve: float = 0.0  # seconds to be left of a budget


Trained = Generator[Lesson, History, None]  # asks for training, and is told how it went
Work = Generator[Lesson, History, Adaptation]


class Run:
    """One adaptation under way: ``reduced`` is the best model so far, ``logits`` its answers to the validation windows.

    Each answer is by a head that did not learn from that window.
    """

    def __init__(
        self, adapter: Adapter, fault_set: FaultSet, budget: float | None, seed: int, progress: bool | None
    ) -> None:
        self.adapter, self.fault_set, self.seed, self.progress = adapter, fault_set, seed, progress
        self.budget, self.device = budget, adapter.model.head.weight.device
        self.training = reduce_windows(adapter.train, fault_set)
        self.validation = reduce_windows(adapter.validation, fault_set)
        self.logits: Tensor | None = None
        self.quick: CompactNetwork | None = None  # the network of the weights at hand, on fewer numbers
        self.head_seconds = 0.0
        fills = adapter.fills  # estimated once, not a cost of this F
        began = time.perf_counter()
        front = fills.nearest(fault_set) if len(fault_set) else None
        self.stages = [Stage("fill", time.perf_counter() - began)]
        self.reduced = self._behind(front, copy.deepcopy(adapter.model))

    def go(self, method: Method) -> Adaptation:
        """Run the stages of a method, each training as it comes."""
        work = self.stages_of(method)
        try:
            lesson = next(work)
            while True:
                lesson = work.send(self._train(lesson))
        except StopIteration as end:
            adaptation: Adaptation = end.value
            return adaptation

    def stages_of(self, method: Method) -> Work:
        """Run the stages of a method, but for the training: that is asked of the caller, who may train several F."""
        if not len(self.fault_set) and method != "scratch":
            return self.done()  # nothing to repair: the fault-free model, bit for bit
        if method not in ("fill", "scratch"):
            self.quick = self.adapter.compact  # made once, not a cost of this F
        self.began = time.perf_counter()
        match method:
            case "scratch":
                yield from self.scratch()
            case "head":
                self.head()
            case "finetune":
                self.head()
                yield from self.finetune()
            case "auto":
                if self.accuracy() < _ENOUGH * self.adapter.fault_free_accuracy:
                    self.head()
                    if self.budget is not None and self.accuracy() < _ENOUGH * self.adapter.fault_free_accuracy:
                        yield from self.finetune()
        return self.done()

    def head(self) -> None:
        """Fit a new head in closed form; kept if validation agrees that it is better."""
        self._keep_better("head", self._behind(self.adapter.fills.linear(self.fault_set), self.reduced.network))

    def finetune(self) -> Trained:
        """Train on, front end included, in rounds that each end with a new head; stop when a round brings nothing.

        A larger budget only allows more of the same rounds, so it never ends worse.
        """
        network = copy.deepcopy(self.adapter.model)
        reduced = self._behind(self.adapter.fills.linear(self.fault_set), network)
        features = self._views(reduced, self.training)[0].cpu().double().numpy()
        weight, bias = linear_head(features, self.training.y, network.n_classes)
        network.head.load_state_dict({"weight": weight, "bias": bias})
        idle, took = 0, 0.0
        for number in range(_ROUNDS):
            if idle > _ROUND_PATIENCE or self.left() < took + self.head_seconds:
                break
            began = time.perf_counter()
            self.quick = None  # of other weights
            history = yield Lesson(reduced, _ROUND_EPOCHS, self.seed * _ROUNDS + number, None, self.head_seconds)
            if history.stopped == "budget":
                break
            self.quick = compacted(network, len(self.training) + len(self.validation))
            took = time.perf_counter() - began
            better = self._keep_better("finetune", copy.deepcopy(reduced), began)
            idle = 0 if better else idle + 1

    def scratch(self) -> Trained:
        """Train a new network behind the fill, as the paper does for each F."""
        model = self.adapter.model
        fresh = type(model).from_config({**model.config, "seed": self.seed + 1})
        self.reduced = self._behind(self.adapter.fills.linear(self.fault_set), fresh)
        self.stages.clear()
        began = time.perf_counter()
        history = yield Lesson(self.reduced, _SCRATCH_EPOCHS, self.seed, _SCRATCH_PATIENCE)
        self.stages.append(Stage("scratch", time.perf_counter() - began, history.best_accuracy))
        self.logits = None

    def held_out(self) -> Tensor:
        """Return the logits ``[N, n_classes]`` of the validation windows, from what did not learn from them."""
        if self.logits is None:
            self.logits = logits_of(self._quickly(self.reduced), self.validation.x)
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
        """Return the adaptation as it stands."""
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

    def _behind(self, front: nn.Module | None, network: TactileTransformer) -> ReducedModel:
        """Return the reduced model of a front end and a network, on the adapter's device."""
        return ReducedModel(network, self.fault_set, front).to(self.device).eval()

    def _quickly(self, reduced: ReducedModel) -> ReducedModel:
        """Return the same model with its network on fewer numbers, where there is such a one of these weights."""
        if self.quick is None:
            return reduced
        same = ReducedModel(reduced.network, self.fault_set, reduced.front, reduced.head)
        same.add_module("network", self.quick)
        return same.eval()

    def _views(self, reduced: ReducedModel, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return both views of windows, computed in batches, on the adapter's device."""
        quick = self._quickly(reduced.eval())
        with torch.no_grad():
            views = [quick.views(x.to(self.device)) for x in torch.split(as_tensor(windows.x), _BATCH)]
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

    def _train(self, lesson: Lesson) -> History:
        return train(
            lesson.reduced,
            self.training,
            self.validation,
            epochs=lesson.epochs,
            patience=lesson.patience,
            budget=None if self.budget is None else max(0.0, self.left() - lesson.reserve),
            seed=lesson.seed,
            progress=self.progress,
        )
