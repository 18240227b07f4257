"""The fault-free model with its windows: the data from which each adaptation starts."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.determination import r2
from adaptfault.data.windows import Windows, evenly
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.imputation.tiled_statistics import LARGE, TiledStatistics
from adaptfault.models.any_model import AnyModel, Features, device_of
from adaptfault.models.builders import first_line
from adaptfault.models.compact import CompactNetwork, compacted
from adaptfault.models.heads import MOST_WINDOWS
from adaptfault.models.network import TactileTransformer, as_tensor, logits_of, tensors_of
from diagnostics import SensorLayout

Task = Literal["classification", "regression"]
Network = TactileTransformer | AnyModel

_REST = 0.05  # quantile of the readings of a cell


class FaultFreeModel:
    """A model, fault-free windows, and the statistics that all adaptations share.

    Args:
        model, train, validation, layout, features, task, loss, touch: as in
            :class:`~adaptfault.adaptation.adapter.Adapter`.

    Attributes:
        model: the network; other modules are wrapped in
            :class:`~adaptfault.models.any_model.AnyModel`.
        task: "classification" or "regression".
        acts: it is a policy: it sees more than touch, or returns actions of several axes.
        targets, validation_targets: ``[N, n]``, class indicators or probabilities; values of a
            regression.
    """

    def __init__(
        self,
        model: nn.Module,
        train: Windows,
        validation: Windows,
        *,
        layout: SensorLayout | None = None,
        features: Features | None = None,
        task: Task | Literal["auto"] = "auto",
        loss: Callable[[Tensor, Tensor], Tensor] | None = None,
        touch: str | None = None,
    ) -> None:
        if not len(train) or not len(validation):
            raise ValueError(
                "an adapter needs fault-free windows to learn from and to validate on; one set is"
                " empty"
            )
        _check_windows(train, validation)
        # a copy would be held out of a fold that learns from it
        train = train.independent
        validation = validation.independent
        self.task = _task(task, train, validation)
        self.acts = _acts(train)
        self.model = _wrapped(model, train, layout, features, touch)
        _check_targets(self.model, self.task, train, validation)
        self.loss = loss
        if loss is not None and train.y.ndim > 2:
            self.loss = _OfActions(loss, train.y.shape[1:])
        train = train.flat
        validation = validation.flat
        most = MOST_WINDOWS // 2  # enough to compare accuracies
        validation = validation.select(evenly(len(validation), most))
        self.train, self.targets = _labelled(self.model, self.task, train)
        self.validation, self.validation_targets = _labelled(self.model, self.task, validation)
        if self.loss is not None:
            _check_loss(self.model, self.loss, self.train)

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.model.layout

    @cached_property
    def statistics(self) -> CellStatistics:
        """Moments of the fault-free frames, estimated once and used for each F."""
        return CellStatistics.fit(self.train)

    @cached_property
    def rest(self) -> Tensor:
        """What each cell reads without load, float32 ``[D]``: the 5 % quantile of its readings."""
        readings = self.train.x.reshape(-1, self.train.x.shape[2])
        return torch.from_numpy(np.quantile(readings, _REST, axis=0).astype(np.float32))

    @cached_property
    def compact(self) -> CompactNetwork | None:
        """Low-rank form of the paper's network for its windows; None for other models, few windows
        or large arrays."""
        return self.compacted(self.model)

    def compacted(self, network: Network) -> CompactNetwork | None:
        """Return the low-rank form of a network on its device, where it saves time."""
        if not isinstance(network, TactileTransformer):
            return None
        return compacted(network, as_tensor(self.train.x))

    @cached_property
    def imputation(self) -> CellStatistics | TiledStatistics:
        """The source of front ends: ``statistics``, or tiles on a large array."""
        return (
            TiledStatistics.fit(self.train, self.layout)
            if self.layout.n_cells > LARGE
            else self.statistics
        )

    @property
    def measure(self) -> str:
        """What :meth:`score` returns: "accuracy" or "R2"."""
        return "R2" if self.task == "regression" else "accuracy"

    def score(self, outputs: Tensor) -> float:
        """Return accuracy or R2 of outputs ``[N, n]`` for the validation windows."""
        if self.task == "regression":
            return r2(self.validation.y, outputs.numpy())
        return float((outputs.argmax(1).numpy() == self.validation.y).mean())

    @property
    def has_features(self) -> bool:
        """Whether a new head can be fitted."""
        return isinstance(self.model, TactileTransformer) or self.model.has_features

    def fresh(self, seed: int) -> Network:
        """Return the network with new initial weights, that of the paper standardised as for a
        first training."""
        model = self.model
        if not isinstance(model, TactileTransformer):
            return model.fresh(seed)
        fresh = type(model).from_config({**model.config, "seed": seed})
        fresh.standardise(self.train.x)
        return fresh


@dataclass(frozen=True)
class _OfActions:
    """A loss of actions ``[B, ...]`` that takes them as values ``[B, k]``.

    Attributes:
        loss: of actions of this shape.
        shape: of the actions of one window.
    """

    loss: Callable[[Tensor, Tensor], Tensor]
    shape: tuple[int, ...]

    def __call__(self, outputs: Tensor, y: Tensor) -> Tensor:
        """Return the loss of outputs ``[B, k]`` and targets ``[B, k]``."""
        return self.loss(torch.unflatten(outputs, 1, self.shape), torch.unflatten(y, 1, self.shape))


def _wrapped(
    model: nn.Module,
    train: Windows,
    layout: SensorLayout | None,
    features: Features | None,
    touch: str | None,
) -> Network:
    if not isinstance(model, nn.Module):
        raise TypeError(
            f"an adapter repairs a torch.nn.Module, got {type(model).__name__}; use"
            " FaultTolerantClassifier or FaultTolerantRegressor for scikit-learn"
        )
    own = getattr(model, "layout", None)
    layout = own if layout is None else layout
    if not isinstance(layout, SensorLayout):
        raise ValueError(
            f"{type(model).__name__} has no layout: give layout=SensorLayout(pads, rows, cols)"
        )
    d = train.x.shape[2]
    if layout.n_cells != d:
        raise ValueError(f"the layout {layout} has {layout.n_cells} cells, the windows have {d}")
    if device_of(model).type != "cpu":
        model = copy.deepcopy(model).cpu()
    if isinstance(model, AnyModel) or (isinstance(model, TactileTransformer) and features is None):
        return model
    few = train.select(slice(0, 8))
    return AnyModel.probe(
        model,
        layout,
        as_tensor(few.x),
        features,
        extra=tensors_of(few.extra),
        touch=touch,
        actions=few.y.ndim > 2,
    )


def _acts(windows: Windows) -> bool:
    """Return whether these are windows of a policy."""
    return bool(windows.extra) or windows.y.ndim > 2


def _check_windows(train: Windows, validation: Windows) -> None:
    if train.x.shape[1:] != validation.x.shape[1:]:
        shapes = f"{list(train.x.shape[1:])}, validation windows {list(validation.x.shape[1:])}"
        raise ValueError(f"training windows are {shapes}: cut both with the same length and layout")
    for name, windows in (("training", train), ("validation", validation)):
        if not np.isfinite(windows.x).all():
            raise ValueError(
                f"{name} windows hold NaN or infinity: make_windows holds the last reading of a"
                " cell"
            )
        for key, values in windows.extra.items():
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise ValueError(
                    f"the input {key!r} of {name} windows holds NaN or infinity: leave these"
                    " windows out"
                )
    if set(train.extra) != set(validation.extra):
        raise ValueError(
            f"training windows have the inputs {sorted(train.extra)}, validation windows"
            f" {sorted(validation.extra)}: give both the same"
        )
    shared = np.intersect1d(train.recording, validation.recording)
    if len(shared) and _acts(train):
        raise ValueError(
            f"episode {shared[0]} is in training and in validation: split by episode, as"
            " adaptfault.split does, and give every episode its own number"
        )


def _check_loss(model: Network, loss: Callable[[Tensor, Tensor], Tensor], windows: Windows) -> None:
    # more windows than outputs: a wrong shape does not broadcast
    few = windows.select(slice(0, model.n_classes + 1))
    outputs = logits_of(model, few.x, few.extra)
    y = as_tensor(few.y)
    given = f"outputs {list(outputs.shape)} and y {list(y.shape)}"
    try:
        value = loss(outputs, y.float() if y.ndim == 2 else y)
    except Exception as error:  # a loss may raise anything
        raise ValueError(
            f"the loss fails on {given}: {first_line(error)}; give one that maps them to a scalar"
        ) from None
    if not isinstance(value, Tensor) or value.numel() != 1:
        shape = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"the loss of {given} is {shape}: expected a scalar")


def _task(task: str, train: Windows, validation: Windows) -> Task:
    if task not in (*get_args(Task), "auto"):
        raise ValueError(f"unknown task {task!r}: use 'classification', 'regression' or 'auto'")
    if train.y.ndim != validation.y.ndim:
        raise ValueError(
            "training and validation windows have different targets: classes [N] and values [N, k]"
        )
    found: Task = "regression" if train.y.ndim >= 2 else "classification"
    if task not in ("auto", found):
        raise ValueError(
            f"task {task!r} needs {'y float [N, k]' if found == 'classification' else 'y int [N]'}"
        )
    return found


def _check_targets(model: Network, task: Task, *parts: Windows) -> None:
    name = type(model.module if isinstance(model, AnyModel) else model).__name__
    shape = getattr(model, "shape", (model.n_classes,))
    for windows in parts:
        if max(len(shape) + 1, windows.y.ndim) > 2 and windows.y.shape[1:] != shape:
            raise ValueError(
                f"{name} returns actions [N, {', '.join(map(str, shape))}], the targets are"
                f" {list(windows.y.shape)}: give what it should return for each window"
            )
        if task == "regression" and windows.y.shape[1:] != shape:
            k = windows.y.shape[1]
            raise ValueError(
                f"{name} has {model.n_classes} outputs, the targets {k} values: give a model"
                f" with {k}"
            )
        if task == "regression" and not np.isfinite(windows.y).all():
            raise ValueError("the targets hold NaN or infinity: leave these windows out")
        if task == "classification" and windows.y.max() >= model.n_classes:
            n = windows.y.max() + 1
            raise ValueError(
                f"{name} has {model.n_classes} outputs, labels run to {n - 1}: give a model with at"
                f" least {n}"
            )


def _labelled(model: Network, task: Task, windows: Windows) -> tuple[Windows, NDArray[np.float32]]:
    """Return windows with classes, and targets ``[N, n]``: without a label the probabilities of the
    model."""
    if task == "regression":
        return windows, windows.y.astype(np.float32)
    targets = np.eye(model.n_classes, dtype=np.float32)[np.maximum(windows.y, 0)]
    unknown = windows.y < 0
    if unknown.any():
        open_ones = windows.select(unknown)
        targets[unknown] = logits_of(model, open_ones.x, open_ones.extra).softmax(1).numpy()
    y: NDArray[Any] = np.where(unknown, targets.argmax(1), windows.y)
    return replace(windows, y=y), targets
