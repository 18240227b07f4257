"""The training loop: Adam, early stopping, a time budget and crash-safe checkpoints (Section
III-B).

Best is the highest validation accuracy (R2 for values), of equals the lowest loss. The loss alone
is a worse criterion: it rises while the accuracy still improves (0.681 against 0.702 on the test,
five runs on real grasps). A seed gives bit-identical results on one machine with the same number of
threads. The global random state does not change.

The exponential average of the weights over the last 1 / (1 - averaging) steps (fewer at first) is
validated and kept; it varies less than the weights of a single step. 0 keeps the weights of the
last step, as Section III-B does.

With a budget, the first epoch is cut short to fit, a later one that does not fit is left out, so a
larger budget never gives a worse result.

What is trained to be repairable loses random cells, lines, blocks or a pad in parts of each batch,
which are imputed as :class:`~adaptfault.adaptation.adapter.Adapter` does. Validation uses each
window twice, whole and imputed. It needs about twice the epochs.

A run that continues from a checkpoint has the same result as without the interruption; ``epochs``,
``patience`` and ``budget`` may differ from the earlier run's. The bar counts batches of all epochs,
and shows the time that remains if no epoch is left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from adaptfault.data.determination import r2
from adaptfault.data.windows import Windows
from adaptfault.imputation.dropout import RandomRepairs
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.models.checkpoint import fingerprint_weights, fingerprint_windows
from adaptfault.models.history import History, Stopped
from adaptfault.models.network import TactileTransformer, as_tensor, logits_of, tensors_of
from adaptfault.models.time_budget import Clock
from adaptfault.models.training_run import Loss, TrainingRun
from diagnostics import SensorLayout

Augment = Callable[[Tensor, torch.Generator], Tensor]


class MoreWindows(Protocol):
    """Training windows generated on demand; ``str`` of it identifies the set."""

    @property
    def y(self) -> NDArray[np.int64]:
        """Class of each window, int ``[M]``."""

    def draw(self, index: NDArray[np.int64], /) -> NDArray[np.float32]:
        """Return the windows with these indices, ``[B, T, D]``; the same for each call."""


def train(
    model: nn.Module,
    train: Windows,
    validation: Windows,
    *,
    epochs: int = 50,
    learning_rate: float = 1e-4,
    batch_size: int = 32,
    seed: int = 0,
    patience: int | None = 10,
    averaging: float = 0.995,
    loss: Loss | None = None,
    budget: float | None = None,
    evaluate_start: bool = False,
    augment: Augment | None = None,
    repairable: bool = False,
    more: MoreWindows | None = None,
    checkpoint: str | Path | None = None,
    on_epoch: Callable[[History], None] | None = None,
    progress: bool | None = None,
) -> History:
    """Train ``model`` in place and leave it in eval mode with the weights that are best on
    ``validation``, also after an exception or Ctrl-C; :mod:`adaptfault.models.training` has more.

    Args:
        model: maps windows float32 ``[B, T, D]``, and what else the windows hold by name, to logits
            or values ``[B, n]``, or to actions of any other shape. Parameters with
            ``requires_grad`` False stay as they are.
        train, validation: fault-free windows, labels 0 to n - 1, values float ``[N, n]``, or
            actions of the shape of the outputs.
        epochs, learning_rate, batch_size: of Adam; Section III-B has 50 at most, 1e-4 and 32.
        seed: of the order of the windows, of dropout and of ``augment``.
        patience: epochs without a better validation before stopping; None trains all epochs.
        averaging: of the weights, over the last 1 / (1 - averaging) steps; 0: of the last step.
        loss: (outputs ``[B, n]``, y ``[B]`` or ``[B, k]``) -> scalar. None: cross entropy, or the
            mean squared error of values.
        budget: seconds, validation included; time before a resume counts.
        evaluate_start: the starting weights are a candidate too, so that fine-tuning never makes
            validation worse.
        augment: ``(x [B, T, D], generator) -> x``, applied to each training batch, a copy that it
            may change.
        repairable: train a model that loses less when cells are imputed; in twice the epochs.
        more: additional training windows, generated on demand; an epoch uses all of them.
        checkpoint: file written after each epoch; where it exists, training continues from it.
        on_epoch: called with the history after each epoch, once the checkpoint is on disk.
        progress: show or hide the bar on stderr; None shows it on a terminal.

    Raises:
        ValueError: windows that are empty or not finite, or labels beyond the outputs of the model;
            a checkpoint of another run; a loss that is not finite; ``repairable`` together with
            ``augment``.
        TypeError: ``repairable`` for a model without a layout.
    """
    _check_options(epochs, batch_size, learning_rate, averaging)
    clock = Clock(budget)
    _check(model, train, validation)
    if isinstance(model, TactileTransformer):
        model.standardise(train.x)
    if repairable:
        augment, validation = _random_repairs(model, train, validation, seed, augment)
    run = TrainingRun(model, learning_rate, averaging, checkpoint)
    run.loss = _default_loss(train) if loss is None else loss
    if run.path is not None:
        run.settings = {
            "learning_rate": learning_rate,
            "batch_size": batch_size,
            "seed": seed,
            "averaging": averaging,
            "evaluate_start": evaluate_start,
            **_settings(model, train, validation, loss, augment, more),
        }
        run.resume()
        clock.spent = sum(run.history.seconds)
    training = _Training(run, _Source(train, more), validation, batch_size, seed, augment, clock)
    try:
        training.begin(evaluate_start)
        stopped = training.go_on(epochs, patience, on_epoch, progress)
    finally:
        run.restore_best()
        model.eval()
    return replace(run.history, stopped=stopped)


def _settings(
    model: nn.Module,
    train: Windows,
    validation: Windows,
    loss: Loss | None,
    augment: Augment | None,
    more: MoreWindows | None,
) -> dict[str, Any]:
    """Return what identifies a run beside its numbers: a checkpoint with other settings is of
    another run."""

    def name(function: Callable[..., Any]) -> str:
        return str(getattr(function, "__qualname__", type(function).__qualname__))

    return {
        **({} if loss is None else {"loss": name(loss)}),
        "augment": None if augment is None else name(augment),
        "data": fingerprint_windows(train, validation),
        "more": None if more is None else str(more),
        "starting weights": fingerprint_weights(model),
    }


@dataclass(frozen=True)
class _Training:
    """A training run, its windows and its clock.

    Attributes:
        run: the model and what was reached.
        source: of the windows that it learns.
        validation, batch_size, seed, augment: as in :func:`train`.
        clock: of the budget.
    """

    run: TrainingRun
    source: _Source
    validation: Windows
    batch_size: int
    seed: int
    augment: Augment | None
    clock: Clock

    def begin(self, evaluate_start: bool) -> None:
        """Validate the starting weights if they are a candidate; else, with a budget, measure the
        time of a validation."""
        run = self.run
        if evaluate_start and run.history.start is None:
            with self.clock.closing():
                start = _validate(run.model, self.validation, run.loss)
                run.record(replace(run.history, start=start))
        elif self.clock.budget < math.inf:  # the first epoch has to leave time for it, too
            sample = self.validation.select(slice(0, 32))
            with self.clock.closing(len(sample) / len(self.validation)):
                _validate(run.model, sample, run.loss)

    def go_on(
        self,
        epochs: int,
        patience: int | None,
        on_epoch: Callable[[History], None] | None,
        progress: bool | None,
    ) -> Stopped:
        """Train epoch by epoch, and return why the run ends; arguments as in :func:`train`."""
        run = self.run
        batches = -(-len(self.source) // self.batch_size)
        with tqdm(
            total=epochs * batches,
            initial=run.history.epochs * batches,
            unit="batch",
            disable=None if progress is None else not progress,
        ) as bar:
            while (stopped := self._stop(epochs, patience)) is None:
                bar.set_description(f"epoch {run.history.epochs + 1} of {epochs}", refresh=False)
                history = self._epoch(bar.update)
                if history is None:
                    continue
                last = history.train_loss[-1]
                accuracy = history.validation_accuracy[-1]
                bar.set_postfix(
                    loss=f"{last:.4f}", accuracy=f"{accuracy:.4f}", best=history.best_epoch
                )
                if on_epoch is not None:
                    on_epoch(history)
        return stopped

    def _stop(self, epochs: int, patience: int | None) -> Stopped | None:
        """Return why the run ends; None while it continues. After the first epoch a whole epoch has
        to fit."""
        history = self.run.history
        if self.clock.over:
            return "budget"
        if patience is not None and history.epochs - history.best_epoch >= patience:
            return "patience"
        if history.epochs >= epochs:
            return "epochs"
        return "budget" if self.clock.late(len(self.source) if history.epochs else 1) else None

    def _epoch(self, on_batch: Callable[[], object]) -> History | None:
        """Train for an epoch, validate and record; None if time ran out within a later epoch."""
        run = self.run
        began = time.perf_counter()
        n = len(self.source)
        run.model.train()
        with seeded(self.seed, run.history.epochs, run.device) as generator:
            order = torch.split(torch.randperm(n, generator=generator), self.batch_size)
            loss, seen = self._pass(order, generator, on_batch)
        if seen < n and run.history.epochs:
            return None
        with self.clock.closing():
            with run.averaged():
                scores = _validate(run.model, self.validation, run.loss)
            history = run.history.longer(loss, scores, time.perf_counter() - began)
            run.record(history, save=seen == n)  # a run cannot resume within an epoch
        return history

    def _pass(
        self, order: Sequence[Tensor], generator: torch.Generator, on_batch: Callable[[], object]
    ) -> tuple[float, int]:
        """Train on batches until they or the time run out; return the mean loss and the number of
        windows used."""
        run = self.run
        total = 0.0
        seen = 0
        began = time.perf_counter()
        for index in order:
            if seen and self.clock.late(len(index)):
                self.clock.over = True
                break
            x, y = self.source.take(index)
            if self.augment is not None:
                x = self.augment(x, generator)
            extra = {name: of[index].to(run.device) for name, of in self.source.extra.items()}
            loss = run.loss(run.model(x.to(run.device), **extra), y.to(run.device))
            run.step(loss)
            total += loss.item() * len(index)
            seen += len(index)
            if not math.isfinite(total):
                raise ValueError(
                    f"the loss became {loss.item()} in epoch {run.history.epochs + 1}: lower"
                    " learning_rate"
                )
            self.clock.pace = (time.perf_counter() - began) / seen
            on_batch()
        return total / seen, seen


class _Source:
    """The training windows and the additional ones."""

    def __init__(self, windows: Windows, more: MoreWindows | None) -> None:
        if more is not None and windows.extra:
            raise ValueError(
                f"additional windows have no input {next(iter(windows.extra))!r}: train without"
                " more, or on windows of touch alone"
            )
        self.x = as_tensor(windows.x)
        self.extra = tensors_of(windows.extra)
        self.more = more
        self.known = len(windows)
        self.y = as_tensor(windows.y if more is None else np.concatenate([windows.y, more.y]))

    def __len__(self) -> int:
        return len(self.y)

    def take(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return copies of the windows with these indices, ``[B, T, D]``, and their targets."""
        x = self.x[index.clamp(max=self.known - 1)]
        if self.more is not None:
            added = index >= self.known
            x[added] = torch.from_numpy(self.more.draw((index[added] - self.known).numpy()))
        return x, self.y[index]


def _check_options(epochs: int, batch_size: int, learning_rate: float, averaging: float) -> None:
    if epochs < 1 or batch_size < 1 or not learning_rate > 0:
        raise ValueError(
            f"training needs epochs, batch_size, learning_rate > 0, got {epochs}, {batch_size},"
            f" {learning_rate}"
        )
    if not 0 <= averaging < 1:
        raise ValueError(f"averaging must lie in [0, 1), got {averaging}")


def _check(model: nn.Module, train: Windows, validation: Windows) -> None:
    """Refuse unusable windows before any training."""
    for name, windows in (("training", train), ("validation", validation)):
        if not len(windows):
            raise ValueError(f"no {name} windows")
        if bad := int((~np.isfinite(windows.x)).any(axis=(1, 2)).sum()):
            raise ValueError(
                f"{bad} of {len(windows)} {name} windows hold NaN or infinite readings:"
                " make_windows holds them"
            )
        first = windows.select(slice(0, 1))
        shape = logits_of(model, first.x, first.extra).shape[1:]
        n = shape[0]
        if windows.y.ndim >= 2:
            if windows.y.shape[1:] != shape or not np.isfinite(windows.y).all():
                needed = n if len(shape) == 1 else list(shape)
                raise ValueError(
                    f"{name} targets need {needed} finite values a window, got"
                    f" {list(windows.y.shape)}"
                )
            continue
        if windows.y.min() < 0 or windows.y.max() >= n:
            raise ValueError(
                f"{name} labels run from {windows.y.min()} to {windows.y.max()}, the model has {n}"
                " classes"
            )


def _random_repairs(
    model: nn.Module, train: Windows, validation: Windows, seed: int, augment: Augment | None
) -> tuple[RandomRepairs, Windows]:
    """Return what removes cells in training, and validation windows beside imputed ones."""
    if augment is not None:
        raise ValueError(
            "repairable is an augmentation itself: give augment or repairable, not both"
        )
    layout = getattr(model, "layout", None)
    if not isinstance(layout, SensorLayout):
        raise TypeError(f"repairable needs a network of a known layout, got {type(model).__name__}")
    repairs = RandomRepairs(layout, CellStatistics.fit(train))
    return repairs, repairs.beside(validation, seed)


def _default_loss(windows: Windows) -> Loss:
    return F.mse_loss if windows.y.ndim >= 2 else F.cross_entropy


def _validate(model: nn.Module, windows: Windows, criterion: Loss) -> tuple[float, float]:
    """Return loss, and accuracy or R2."""
    logits = logits_of(model, windows.x, windows.extra)
    labels = as_tensor(windows.y)
    loss = criterion(logits, labels).item()
    if not math.isfinite(loss):
        raise ValueError(f"the validation loss became {loss}: lower learning_rate")
    if windows.y.ndim >= 2:
        return loss, r2(windows.y, logits.numpy())
    return loss, (logits.argmax(1) == labels).double().mean().item()


@contextmanager
def seeded(seed: int, epoch: int, device: torch.device) -> Iterator[torch.Generator]:
    """Seed an epoch, dropout included, so that a resumed run draws the same numbers as an
    uninterrupted one."""
    state = int(
        np.random.SeedSequence([seed, epoch]).generate_state(1, np.uint64)[0] >> np.uint64(1)
    )
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.default_generator.manual_seed(state)
        if device.type == "cuda":
            with torch.cuda.device(device):
                torch.cuda.manual_seed(state)
        yield torch.Generator().manual_seed(state)
