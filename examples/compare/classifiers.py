"""The classifiers of compare_classification.py: each with its shortest correct call, and when it
learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from adaptation_figures import rate, summary
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier
from sklearn.experimental import enable_iterative_imputer  # noqa: F401
from sklearn.impute import IterativeImputer, KNNImputer, SimpleImputer
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

import adaptfault as af
from adaptfault.data.windows import evenly
from adaptfault.imputation.dropout import random_fault_set
from diagnostics import FaultSet, SensorLayout

Predict = Callable[[np.ndarray], np.ndarray]  # windows [N, T, D] -> classes [N]
Repair = Callable[[FaultSet], Predict]  # what happens once F is known
OURS = "adaptfault auto"


@dataclass(frozen=True)
class Effort:
    """How much each one may learn, for what they cost: a run has to end."""

    epochs: int  # of the network
    trees: int  # of boosting, for each class; a forest has three times as many
    gru_epochs: int  # of GRU-D
    kernels: int  # of MiniRocket
    gappy: int  # windows that IterativeImputer learns from, whole and with gaps
    rounds: int  # of IterativeImputer


FULL = Effort(20, 100, 30, 10_000, 1000, 10)
SMALL = Effort(1, 2, 1, 84, 40, 1)


@dataclass(frozen=True)
class Task:
    """What every classifier gets of one seed."""

    layout: SensorLayout
    train: af.Windows
    validation: af.Windows
    test: af.Windows
    seed: int
    simulated: bool
    effort: Effort
    networks: Path | None = None  # where fault-free networks lie, base0 for seed 0 and so on

    @cached_property
    def x(self) -> np.ndarray:
        """Windows to learn from, ``[N, T, D]``."""
        return np.concatenate([self.train.x, self.validation.x])

    @cached_property
    def y(self) -> np.ndarray:
        """Their classes."""
        return np.concatenate([self.train.y, self.validation.y])

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return int(self.y.max()) + 1

    def healthy(self, faults: FaultSet | None = None) -> np.ndarray:
        """The cells that exist and are not in F, ascending."""
        cells = np.flatnonzero(self.layout.present)
        return cells if faults is None else np.setdiff1d(cells, list(faults))

    def lost(self, x: np.ndarray, faults: FaultSet) -> np.ndarray:
        """Return windows of the cells that exist, those in F as NaN."""
        x = x.copy()
        x[..., list(faults)] = np.nan
        return x[..., self.healthy()]

    def with_losses(self, windows: af.Windows) -> tuple[np.ndarray, np.ndarray]:
        """Return windows twice, whole and with a random fault set for each recording, and their
        classes."""
        rng = np.random.default_rng(self.seed)
        lost = windows.x.copy()
        for recording in np.unique(windows.recording):
            faults = list(random_fault_set(self.layout, rng))
            lost[np.ix_(windows.recording == recording, np.arange(lost.shape[1]), faults)] = np.nan
        return np.concatenate([windows.x, lost])[..., self.healthy()], np.tile(windows.y, 2)


def adaptfault(task: Task) -> dict[str, Repair]:
    """The paper's network, trained once; F is dealt with by the adapter."""
    if task.networks is not None:
        model = af.load_model(task.networks / f"base{task.seed}")
    else:
        quick = {"padding": "valid", "init": "glorot"} if task.simulated else {}
        model = af.TactileTransformer(
            task.layout, task.n_classes, length=task.x.shape[1], seed=task.seed, **quick
        )
        af.train(
            model,
            task.train,
            task.validation,
            epochs=task.effort.epochs,
            patience=None,
            learning_rate=rate(model),
            seed=task.seed,
            progress=False,
        )
    adapter = af.Adapter(model, task.train, task.validation)
    adapter.statistics, adapter.fault_free_accuracy  # noqa: B018 - known before the fault

    def auto(faults: FaultSet) -> Predict:
        return adapter.adapt(faults).predict if len(faults) else adapter.healthy.predict

    return {
        "adaptfault fill": lambda faults: adapter.adapt(faults, method="fill").predict,
        OURS: auto,
    }


def imputed_svc(imputer, task: Task) -> Repair:
    classifier = make_pipeline(imputer, StandardScaler(), SVC(C=10)).fit(
        summary(task.x[..., task.healthy()]), task.y
    )
    return lambda faults: lambda x: classifier.predict(summary(task.lost(x, faults)))


def iterative_svc(task: Task) -> Repair:
    """The imputer learns once F is known: fitted on tables without a gap it would make one round
    only."""
    whole = summary(task.x[..., task.healthy()])
    classifier = make_pipeline(StandardScaler(), SVC(C=10)).fit(whole, task.y)

    def repair(faults: FaultSet) -> Predict:
        imputer = IterativeImputer(Ridge(), skip_complete=True, max_iter=task.effort.rounds)
        some = evenly(len(whole), task.effort.gappy)
        imputer.fit(np.concatenate([whole[some], summary(task.lost(task.x[some], faults))]))
        return lambda x: classifier.predict(imputer.transform(summary(task.lost(x, faults))))

    return repair


def boosting_ready(task: Task) -> Repair:
    x, y = task.with_losses(
        af.Windows(
            task.x, task.y, np.concatenate([task.train.recording, task.validation.recording])
        )
    )
    classifier = HistGradientBoostingClassifier(
        max_iter=task.effort.trees, random_state=task.seed
    ).fit(summary(x), y)
    return lambda faults: lambda x: classifier.predict(summary(task.lost(x, faults)))


def retrained(make: Callable[[Task], object], task: Task) -> Repair:
    """Return a table's classifier that learns once F is known."""

    def repair(faults: FaultSet) -> Predict:
        cells = task.healthy(faults)
        classifier = make(task).fit(summary(task.x[..., cells]), task.y)
        return lambda x: classifier.predict(summary(x[..., cells]))

    return repair


def minirocket(task: Task, cells: np.ndarray) -> Predict:
    from aeon.classification.convolution_based import MiniRocketClassifier

    classifier = MiniRocketClassifier(n_kernels=task.effort.kernels, random_state=task.seed)
    classifier.fit(task.x[..., cells].transpose(0, 2, 1), task.y)  # [N, D, T]
    return lambda x: classifier.predict(x[..., cells].transpose(0, 2, 1))


def minirocket_ready(task: Task) -> Repair:
    """Let a dead cell read its healthy mean: it takes no NaN."""
    predict = minirocket(task, task.healthy())
    mean = task.x.mean(axis=(0, 1))

    def repair(faults: FaultSet) -> Predict:
        return lambda x: predict(np.where(faults.mask, mean, x).astype(np.float32))

    return repair


def grud(task: Task, train: tuple, validation: tuple) -> Predict:
    """Chosen by the validation windows; PyPOTS fills what was never seen of a cell with 0 and tells
    the net."""
    from pypots.classification import GRUD

    _, length, cells = train[0].shape
    epochs = task.effort.gru_epochs
    torch.manual_seed(task.seed)
    network = GRUD(
        length,
        cells,
        task.n_classes,
        rnn_hidden_size=128,
        epochs=epochs,
        patience=5 if epochs > 5 else None,
        device="cpu",
        verbose=False,
    )
    network.fit(*({"X": x, "y": y} for x, y in (train, validation)))
    return lambda x: network.predict({"X": x})["classification"]


def grud_ready(task: Task) -> Repair:
    predict = grud(task, task.with_losses(task.train), task.with_losses(task.validation))
    return lambda faults: lambda x: predict(task.lost(x, faults))


def grud_anew(task: Task) -> Repair:
    def repair(faults: FaultSet) -> Predict:
        cells = task.healthy(faults)
        predict = grud(task, *((w.x[..., cells], w.y) for w in (task.train, task.validation)))
        return lambda x: predict(x[..., cells])

    return repair


def minirocket_anew(task: Task) -> Repair:
    return lambda faults: minirocket(task, task.healthy(faults))


def compile_minirocket(task: Task) -> None:
    """Let numba compile, which it does once and not while a clock runs."""
    few = [windows.select(evenly(len(windows), 40)) for windows in (task.train, task.validation)]
    minirocket(replace(task, train=few[0], validation=few[1], effort=SMALL), task.healthy())(
        task.test.x[:2]
    )


def load_grud(task: Task) -> None:
    """Import what takes seconds before a clock runs."""
    from pypots.classification import GRUD  # noqa: F401


@dataclass(frozen=True)
class Peer:
    """A classifier, where it comes from, when it learns, and what it does before the fault."""

    name: str
    package: str
    protocol: str  # ready, adapted or anew
    prepare: Callable[[Task], Repair | dict[str, Repair]]
    warm_up: Callable[[Task], None] = lambda task: None  # not timed

    @property
    def rows(self) -> tuple[str, ...]:
        """The names of its rows in the table."""
        return ("adaptfault fill", OURS) if self.prepare is adaptfault else (self.name,)


PEERS = (
    Peer("adaptfault", "adaptfault", "adapted", adaptfault),
    Peer("SimpleImputer + SVC", "scikit-learn", "ready", partial(imputed_svc, SimpleImputer())),
    Peer("KNNImputer + SVC", "scikit-learn", "ready", partial(imputed_svc, KNNImputer())),
    Peer("IterativeImputer + SVC", "scikit-learn", "adapted", iterative_svc),
    Peer(
        "SVC anew",
        "scikit-learn",
        "anew",
        partial(retrained, lambda task: make_pipeline(StandardScaler(), SVC(C=10))),
    ),
    Peer(
        "ExtraTrees anew",
        "scikit-learn",
        "anew",
        partial(
            retrained,
            lambda task: ExtraTreesClassifier(3 * task.effort.trees, random_state=task.seed),
        ),
    ),
    Peer("boosting ready", "scikit-learn", "ready", boosting_ready),
    Peer(
        "boosting anew",
        "scikit-learn",
        "anew",
        partial(
            retrained,
            lambda task: HistGradientBoostingClassifier(
                max_iter=task.effort.trees, random_state=task.seed
            ),
        ),
    ),
    Peer("MiniRocket ready", "aeon", "ready", minirocket_ready, compile_minirocket),
    Peer("MiniRocket anew", "aeon", "anew", minirocket_anew, compile_minirocket),
    Peer("GRU-D ready", "pypots", "ready", grud_ready, load_grud),
    Peer("GRU-D anew", "pypots", "anew", grud_anew, load_grud),
)
