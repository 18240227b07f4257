"""The training loop: Adam, early stopping, a time budget and crash-safe checkpoints (Section
III-B)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
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
from adaptfault.models.adam import Adam
from adaptfault.models.checkpoint import (
    fingerprint_weights,
    fingerprint_windows,
    read_checkpoint,
    write_checkpoint,
)
from adaptfault.models.history import History, Stopped
from adaptfault.models.network import TactileTransformer, as_tensor, logits_of
from adaptfault.models.time_budget import Clock
from diagnostics import SensorLayout

Augment = Callable[[Tensor, torch.Generator], Tensor]
Loss = Callable[[Tensor, Tensor], Tensor]


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
    ``validation``.

    Best is the highest validation accuracy (R2 for values), of equals the lowest loss. The loss
    alone is a worse criterion: it rises while the accuracy still improves (0.681 against 0.702 on
    the test, five runs on real grasps). Parameters with ``requires_grad`` False stay as they are.
    The model also holds the best weights after an exception, Ctrl-C included. A seed gives
    bit-identical results on one machine with the same number of threads. The global random state
    does not change.

    Args:
        model: maps windows float32 ``[B, T, D]`` to logits or values ``[B, n]``.
        train, validation: fault-free windows, labels 0 to n - 1 or values float ``[N, n]``.
        epochs, learning_rate, batch_size: of Adam; Section III-B has 50 at most, 1e-4 and 32.
        seed: of the order of the windows, of dropout and of ``augment``.
        patience: epochs without a better validation before stopping; None trains all epochs.
        averaging: the exponential average of the weights over the last 1 / (1 - averaging) steps
            (fewer at first) is validated and kept; it varies less than the weights of a single
            step. 0 keeps the weights of the last step, as Section III-B does.
        loss: (outputs ``[B, n]``, y ``[B]`` or ``[B, k]``) -> scalar. None: cross entropy, or the
            mean squared error of values.
        budget: seconds, validation included. The first epoch is cut short to fit, a later one that
            does not fit is left out, so a larger budget never gives a worse result. Time before a
            resume counts.
        evaluate_start: the starting weights are a candidate too, so that fine-tuning never makes
            validation worse.
        augment: ``(x [B, T, D], generator) -> x``, applied to each training batch, a copy that it
            may change.
        repairable: train a model that loses less when cells are imputed: in parts of each batch
            random cells, lines, blocks or a pad are removed and imputed, as
            :class:`~adaptfault.adaptation.adapter.Adapter` does. Validation uses each window twice,
            whole and imputed. Needs about twice the epochs.
        more: additional training windows, generated on demand; an epoch uses all of them.
        checkpoint: file written after each epoch. If it exists, training continues from it, with
            the same result as without the interruption; ``epochs``, ``patience`` and ``budget`` may
            differ from the earlier run's.
        on_epoch: called with the history after each epoch, once the checkpoint is on disk.
        progress: True or False shows or hides the bar on stderr: batches of all epochs, and the
            time that remains if no epoch is left out; None shows it on a terminal.

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
        if augment is not None:
            raise ValueError(
                "repairable is an augmentation itself: give augment or repairable, not both"
            )
        augment, validation = _random_repairs(model, train, validation, seed)
    run = _Run(
        model, learning_rate, averaging, Path(checkpoint) if checkpoint is not None else None
    )
    run.loss = _default_loss(train) if loss is None else loss
    if run.path is not None:
        options: dict[str, Any] = {
            "learning_rate": learning_rate,
            "batch_size": batch_size,
            "seed": seed,
            "averaging": averaging,
            "evaluate_start": evaluate_start,
        }
        run.settings = options | _settings(model, train, validation, loss, augment, more)
        run.resume()
        clock.spent = sum(run.history.seconds)
    source = _Source(train, more)
    hide = None if progress is None else not progress
    try:
        _begin(run, validation, clock, evaluate_start)
        batches = -(-len(source.y) // batch_size)
        with tqdm(
            total=epochs * batches, initial=run.history.epochs * batches, unit="batch", disable=hide
        ) as bar:
            while (stopped := _stop(run.history, epochs, patience, clock, len(source.y))) is None:
                bar.set_description(f"epoch {run.history.epochs + 1} of {epochs}", refresh=False)
                history = _epoch(
                    run, source, validation, batch_size, seed, augment, clock, bar.update
                )
                if history is None:
                    continue
                last = history.train_loss[-1]
                accuracy = history.validation_accuracy[-1]
                bar.set_postfix(
                    loss=f"{last:.4f}", accuracy=f"{accuracy:.4f}", best=history.best_epoch
                )
                if on_epoch is not None:
                    on_epoch(history)
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


def _begin(run: _Run, validation: Windows, clock: Clock, evaluate_start: bool) -> None:
    """Validate the starting weights if they are a candidate; else, with a budget, measure the time
    of a validation."""
    if evaluate_start and run.history.start is None:
        with clock.closing():
            run.record(replace(run.history, start=_validate(run.model, validation, run.loss)))
    elif clock.budget < math.inf:  # the first epoch, too, has to leave time for its validation
        sample = validation.select(slice(0, 32))
        with clock.closing(len(sample) / len(validation)):
            _validate(run.model, sample, run.loss)


def _epoch(
    run: _Run,
    source: _Source,
    validation: Windows,
    batch_size: int,
    seed: int,
    augment: Augment | None,
    clock: Clock,
    on_batch: Callable[[], object],
) -> History | None:
    """Train for an epoch, validate and record; None if time ran out within a later epoch."""
    began = time.perf_counter()
    n = len(source.y)
    device = next(run.model.parameters()).device
    run.model.train()
    with seeded(seed, run.history.epochs, device) as generator:
        order = torch.split(torch.randperm(n, generator=generator), batch_size)
        loss, seen = _pass(run, source, order, augment, generator, clock, on_batch)
    if seen < n and run.history.epochs:
        return None
    with clock.closing():
        with run.averaged():
            scores = _validate(run.model, validation, run.loss)
        history = run.history.longer(loss, scores, time.perf_counter() - began)
        run.record(history, save=seen == n)  # a run cannot resume within an epoch
    return history


def _pass(
    run: _Run,
    source: _Source,
    order: Sequence[Tensor],
    augment: Augment | None,
    generator: torch.Generator,
    clock: Clock,
    on_batch: Callable[[], object],
) -> tuple[float, int]:
    """Train on batches until they or the time run out; return the mean loss and the number of
    windows used."""
    device = next(run.model.parameters()).device
    total = 0.0
    seen = 0
    began = time.perf_counter()
    for index in order:
        if seen and clock.late(len(index)):
            clock.over = True
            break
        # copies
        x = source.take(index)
        y = source.y[index]
        x = x if augment is None else augment(x, generator)
        loss = run.loss(run.model(x.to(device)), y.to(device))
        run.step(loss)
        total = total + loss.item() * len(index)
        seen = seen + len(index)
        if not math.isfinite(total):
            raise ValueError(
                f"the loss became {loss.item()} in epoch {run.history.epochs + 1}: lower"
                " learning_rate"
            )
        clock.pace = (time.perf_counter() - began) / seen
        on_batch()
    return total / seen, seen


class _Source:
    """The training windows and the additional ones."""

    def __init__(self, windows: Windows, more: MoreWindows | None) -> None:
        self.x = as_tensor(windows.x)
        self.more = more
        self.known = len(windows)
        self.y = as_tensor(windows.y if more is None else np.concatenate([windows.y, more.y]))

    def take(self, index: Tensor) -> Tensor:
        """Return a copy of the windows with these indices, ``[B, T, D]``."""
        if self.more is None:
            return self.x[index]
        added = index >= self.known
        x = self.x[index.clamp(max=self.known - 1)]
        x[added] = torch.from_numpy(self.more.draw((index[added] - self.known).numpy()))
        return x


class Optimisation:
    """Adam on a model's parameters, fused, and their exponential average."""

    def __init__(self, model: nn.Module, learning_rate: float, averaging: float) -> None:
        self.averaging = averaging
        self.trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
        if not self.trained:
            raise ValueError(
                "nothing to train: every parameter of the model has requires_grad False"
            )
        self.optimizer = Adam(self.trained.values(), learning_rate)
        self.average = {name: p.detach().clone() for name, p in self.trained.items()}
        self.steps = 0

    def step(self, loss: Tensor) -> None:
        """Make one step down the gradient of ``loss``."""
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self._follow()

    @torch.no_grad()
    def _follow(self) -> None:
        """Update the average after a step."""
        self.steps += 1
        # at first over the last tenth of few steps
        kept = min(self.averaging, self.steps / (self.steps + 10))
        torch._foreach_lerp_(list(self.average.values()), list(self.trained.values()), 1 - kept)

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Put the averaged weights into the model within a context."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def _swap(self) -> None:
        for name, parameter in self.trained.items():
            parameter.data, self.average[name] = self.average[name], parameter.data


class _Run(Optimisation):
    """State of a run: model, best weights, moments of Adam and history, also on disk if a path is
    given."""

    def __init__(
        self, model: nn.Module, learning_rate: float, averaging: float, path: Path | None
    ) -> None:
        super().__init__(model, learning_rate, averaging)
        self.model = model
        self.path = path
        self.history = History()
        frozen = {name for name, p in model.named_parameters() if not p.requires_grad}
        # training changes these
        self.names = [name for name in model.state_dict() if name not in frozen]
        self.best = self._weights()
        self.settings: dict[str, Any] = {}
        self.loss: Loss = F.cross_entropy

    def _weights(self) -> dict[str, Tensor]:
        state = self.model.state_dict()
        return {
            name: state[name].detach().clone(memory_format=torch.contiguous_format)
            for name in self.names
        }

    def restore_best(self) -> None:
        self.model.load_state_dict(self.best, strict=False)

    def record(self, history: History, *, save: bool = True) -> None:
        """Set the history, store the weights if the last epoch is the best, write the
        checkpoint."""
        if history.best_epoch == history.epochs:
            with self.averaged():
                self.best = self._weights()
        self.history = history
        if not save or self.path is None:
            return
        tensors = {f"model.{name}": tensor for name, tensor in self._weights().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        for name, parameter in self.trained.items():
            tensors[f"average.{name}"] = self.average[name]
            tensors |= {
                f"adam.{key}.{name}": value
                for key, value in self.optimizer.state.get(parameter, {}).items()
            }
        write_checkpoint(self.path, tensors, settings=self.settings, state=history.to_dict())

    def resume(self) -> None:
        """Continue from the checkpoint if there is one."""
        if self.path is None or not self.path.exists():
            return
        tensors, state = read_checkpoint(self.path, self.settings)
        self.history = History.from_dict(state)
        self.model.load_state_dict(_under("model.", tensors), strict=False)
        self.best = _under("best.", tensors)
        average = _under("average.", tensors)
        self.average = {name: average[name].to(p.device) for name, p in self.trained.items()}
        for key in ("step", "exp_avg", "exp_avg_sq"):
            for name, value in _under(f"adam.{key}.", tensors).items():
                state = self.optimizer.state.setdefault(self.trained[name], {})
                state[key] = value.to(self.trained[name].device)
                if key == "step":
                    self.steps = int(value)


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
        n = logits_of(model, windows.x[:1]).shape[1]
        if windows.y.ndim == 2:
            if windows.y.shape[1] != n or not np.isfinite(windows.y).all():
                raise ValueError(
                    f"{name} targets need {n} finite values a window, got {list(windows.y.shape)}"
                )
            continue
        if windows.y.min() < 0 or windows.y.max() >= n:
            raise ValueError(
                f"{name} labels run from {windows.y.min()} to {windows.y.max()}, the model has {n}"
                " classes"
            )


def _random_repairs(
    model: nn.Module, train: Windows, validation: Windows, seed: int
) -> tuple[RandomRepairs, Windows]:
    layout = getattr(model, "layout", None)
    if not isinstance(layout, SensorLayout):
        raise TypeError(f"repairable needs a network of a known layout, got {type(model).__name__}")
    repairs = RandomRepairs(layout, CellStatistics.fit(train))
    return repairs, repairs.beside(validation, seed)


def _default_loss(windows: Windows) -> Loss:
    return F.mse_loss if windows.y.ndim == 2 else F.cross_entropy


def _validate(model: nn.Module, windows: Windows, criterion: Loss) -> tuple[float, float]:
    """Return loss, and accuracy or R2."""
    logits = logits_of(model, windows.x)
    labels = as_tensor(windows.y)
    loss = criterion(logits, labels).item()
    if not math.isfinite(loss):
        raise ValueError(f"the validation loss became {loss}: lower learning_rate")
    if windows.y.ndim == 2:
        return loss, r2(windows.y, logits.numpy())
    return loss, (logits.argmax(1) == labels).double().mean().item()


def _stop(
    history: History, epochs: int, patience: int | None, clock: Clock, whole: int
) -> Stopped | None:
    """Return why the run ends; None while it continues. After the first epoch a whole epoch has to
    fit."""
    if clock.over:
        return "budget"
    if patience is not None and history.epochs - history.best_epoch >= patience:
        return "patience"
    if history.epochs >= epochs:
        return "epochs"
    return "budget" if clock.late(whole if history.epochs else 1) else None


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


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names start with a prefix, without the prefix."""
    return {
        name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)
    }
