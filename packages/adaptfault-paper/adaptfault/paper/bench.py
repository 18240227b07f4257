"""Experiments of one seed: split, networks, faults and strategies; networks are stored in the
folder of the run."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.baselines.correction import CausalCorrection, correct
from adaptfault.adaptation.baselines.fault_aware import train_fault_aware
from adaptfault.adaptation.baselines.random_faults import FaultPattern, RandomFaults
from adaptfault.adaptation.reduced_model import ReducedModel, phi, reduce_windows
from adaptfault.adaptation.result import Adaptation
from adaptfault.adaptation.stages import Method
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import Windows, evenly, make_windows, split
from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.store import MANIFEST, load_model, save_model
from adaptfault.models.training import train
from adaptfault.paper.settings import WIRING, Settings, Task, is_aware
from diagnostics import Fault, FaultKind, FaultSet, SelfDiagnosis, inject

# recordings of the faulty sensor for the diagnosis; healthy recordings for its fit
_LOG = 20
_REFERENCE = 200
_SPREAD = 50_000  # offset between the seeds of different draws

Floats = NDArray[np.float32]
Classes = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Setup:
    """Data and settings that all seeds share.

    Attributes:
        recordings: labelled and fault-free.
        windows: cut from them.
        settings: extent of the measurements.
        folder: of the run; networks go into ``models``.
        device: of training.
        progress: show or hide progress.
        say: receives status messages.
    """

    recordings: Recordings
    windows: Windows
    settings: Settings
    folder: Path
    device: str
    progress: bool | None
    say: Callable[[str], None]


class Bench:
    """Data, networks and faults of one seed, created on first use."""

    def __init__(self, setup: Setup, seed: int) -> None:
        self.setup = setup
        self.seed = seed
        self.layout = setup.recordings.layout
        self.train, validation, self.whole = split(setup.windows, seed=seed)
        self.validation = validation.select(evenly(len(validation), setup.settings.judged))
        starts = np.unique(self.whole.recording, return_index=True)[1]
        sizes = np.diff([*starts, len(self.whole)])
        rng = np.random.default_rng(seed)
        few = [
            s + np.sort(rng.permutation(n)[: setup.settings.windows])
            for s, n in zip(starts, sizes, strict=True)
        ]
        self.kept = np.concatenate(few)  # which windows of each recording are tested
        self.test = self.whole.select(self.kept)
        self.present = np.flatnonzero(self.layout.present)

    def predict(self, task: Task) -> Classes:
        """Return the class of each test window under a task's faults and strategy."""
        if task.strategy == "adapted" and task.figure == 5:
            return self._adapted(self.fault_set(task.k))
        if task.strategy == "trained anew":
            return self._trained_anew(self.fault_set(task.k))
        if task.figure == 7:
            return self._against(task)
        x = self.whole.x if task.faults == "none" else self.broken(task.faults, task.k)
        return self._answers(task.strategy, x)

    def _answers(self, strategy: str, x: Floats) -> Classes:
        """Predict windows ``[N, T, D]`` of all test recordings by a strategy without diagnosis."""
        if (more := is_aware(strategy)) is not None:
            return self.aware(*more).predict(x[self.kept])
        match strategy:
            case "nothing":
                corrected = x[self.kept]
            case "correct to 0":
                corrected = correct(x[self.kept])
            case "correct to half":
                corrected = correct(x[self.kept], abnormal=(1.0,), neutral=0.5)
            case "correct to the mean":
                corrected = correct(x[self.kept], abnormal=(1.0,), neutral=self.adapter.statistics)
            case "correct to 0, wait 5":
                corrected = self._waiting(x)[self.kept]
            case _:
                raise ValueError(f"no such strategy: {strategy}")
        return self.base.predict(corrected)

    def _waiting(self, x: Floats) -> Floats:
        """Correct causally, recording by recording."""
        out = x.copy()
        for number in np.unique(self.whole.recording):
            of = self.whole.recording == number
            frames = x[of].reshape(-1, x.shape[2])
            out[of] = CausalCorrection(wait=5).correct(frames).reshape(-1, *x.shape[1:])
        return out

    # Faults

    def broken(self, faults: str, k: int) -> Floats:
        """Return the test windows ``[N, T, D]`` with k faults in each recording, drawn
        independently.

        One pass averages over as many fault sets as there are recordings. Open and short faults
        affect the same cells, and the cells of a smaller k are a subset of those of a larger k.
        """
        x = self.whole.x.copy()
        frames = np.arange(x.shape[1])
        for number in np.unique(self.whole.recording).tolist():
            rng = np.random.default_rng([self.seed, number])
            cells = rng.permutation(self.present)[:k]
            ends = rng.integers(0, 2, len(self.present))[:k]
            of = self.whole.recording == number
            if faults in WIRING:
                for wired, end in self._wiring(faults, k, rng):
                    x[np.ix_(of, frames, wired)] = end
            else:
                value = {"open": 0.0, "short": 1.0}.get(faults, ends)
                x[np.ix_(of, frames, cells)] = value
        return x

    def _wiring(
        self, kind: str, k: int, rng: np.random.Generator
    ) -> list[tuple[NDArray[np.intp], float]]:
        """Draw k broken lines or blocks: their cells and readings on the 0..1 scale."""
        return RandomFaults(self.layout, cast("FaultPattern", kind)).draw(k, rng)

    def fault_set(self, k: int) -> FaultSet:
        """Return the F of this seed with k cells; smaller ones are part of larger ones."""
        cells = np.random.default_rng(_SPREAD + self.seed).permutation(self.present)[:k]
        return FaultSet(tuple(cells.tolist()), self.layout.n_cells)

    # Networks

    @cached_property
    def base(self) -> TactileTransformer:
        """The fault-free network."""
        name = f"base{self.seed}"
        epochs = self.setup.settings.epochs
        return self._kept(
            name,
            self._fresh(self.seed),
            lambda model: train(
                model, self.train, self.validation, epochs=epochs, **self._options(name)
            ),
        )

    def aware(self, n: int, kind: str = "cells") -> TactileTransformer:
        """Return the network trained with n additional windows with faults of a kind; n = 0: the
        base network."""
        if not n:
            return self.base
        settings = self.setup.settings
        name = f"aware{self.seed}-{n}-{kind}"

        def fit(model: TactileTransformer) -> None:
            train_fault_aware(
                model,
                self.train,
                self.validation,
                n_samples=n,
                n_faults={"none": (0,), "cells": (5, 10)}.get(kind, (1, 2)),
                kind=cast("FaultPattern", "cells" if kind == "none" else kind),
                epochs=settings.aware_epochs,
                **self._options(name),
            )

        start = copy.deepcopy(self.base) if settings.warm else self._fresh(self.seed)
        return self._kept(name, start, fit)

    def _fresh(self, seed: int) -> TactileTransformer:
        n_classes = len(self.setup.recordings.class_names)
        return TactileTransformer(self.layout, n_classes, seed=seed, **self.setup.settings.network)

    def _options(self, name: str) -> dict[str, Any]:
        """Return the options that all trainings share."""
        settings = self.setup.settings
        return {
            "learning_rate": settings.learning_rate,
            "patience": settings.patience,
            "seed": self.seed,
            "progress": self.setup.progress,
            "checkpoint": self.setup.folder / "models" / f"{name}.training",
        }

    def _kept(
        self, name: str, model: TactileTransformer, fit: Callable[[TactileTransformer], object]
    ) -> TactileTransformer:
        """Return the network of this name from the folder of the run, or train and store it."""
        folder = self.setup.folder / "models" / name
        if (folder / MANIFEST).exists():
            return cast(TactileTransformer, load_model(folder))
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.setup.say(f"seed {self.seed}: training {name}")
        fit(model.to(self.setup.device))
        save_model(folder, model.cpu())
        (folder.parent / f"{name}.training").unlink(missing_ok=True)
        return model

    # Repair

    @cached_property
    def adapter(self) -> Adapter:
        """The adapter of the base network."""
        return Adapter(self.base, self.train, self.validation)

    def _adapted(self, faults: FaultSet, x: Floats | None = None) -> Classes:
        """Predict by the base network adapted to F; the cells in F read NaN unless ``x`` is
        given."""
        if faults not in self._adaptations:
            # without faults the paper's network alone
            method: Method = "auto" if len(faults) else "fill"
            self._adaptations[faults] = self.adapter.adapt(
                faults, method=method, seed=self.seed, progress=False
            )
        if x is None:
            x = self.test.x.copy()
            x[..., list(faults)] = np.nan
        return self._adaptations[faults].predict(x)

    @cached_property
    def _adaptations(self) -> dict[FaultSet, Adaptation]:
        return {}

    def _trained_anew(self, faults: FaultSet) -> Classes:
        """Predict by a network trained on the healthy cells alone, the paper's protocol (Section
        IV)."""
        reduced = ReducedModel(
            self._fresh(self.seed + 1), faults, self.adapter.statistics.linear(faults)
        )
        name = f"anew{self.seed}-{len(faults)}"
        train(
            reduced.to(self.setup.device),
            reduce_windows(self.train, faults),
            reduce_windows(self.validation, faults),
            epochs=self.setup.settings.epochs,
            **self._options(name),
        )
        predicted: Classes = logits_of(reduced, phi(self.test.x, faults)).argmax(1).numpy()
        (self.setup.folder / "models" / f"{name}.training").unlink(missing_ok=True)
        return predicted

    # Noise, drift, intermittency, wiring: the same faults in all recordings, as a diagnosis needs
    # them

    def causes(self, kind: str, k: int) -> list[Fault]:
        """Return k faults of one kind for this seed."""
        if kind not in WIRING:
            return [Fault(FaultKind(kind), (cell,)) for cell in self.fault_set(k)]
        drawn = self._wiring(kind, k, np.random.default_rng(_SPREAD + self.seed))
        return [
            Fault(FaultKind.SHORT if end else FaultKind.OPEN, tuple(cells.tolist()))
            for cells, end in drawn
        ]

    def _against(self, task: Task) -> Classes:
        """Predict the test recordings of a sensor with k faults of one kind."""
        causes = self.causes(task.faults, task.k)
        x = self._injected(causes).x
        if task.strategy == "adapted":
            broken = {cell for cause in causes for cell in cause.cells}
            return self._adapted(FaultSet(tuple(broken), self.layout.n_cells), x[self.kept])
        if task.strategy == "combined":
            return self._combined(x)
        return self._answers(task.strategy, x)

    def _injected(self, faults: list[Fault]) -> Windows:
        """Return all windows of the test recordings with these faults, in order."""
        frames = self.setup.recordings.frames
        length = self.whole.x.shape[1]
        broken = [
            inject(frames[i], faults, self.layout, seed=_SPREAD * self.seed + i)
            for i in np.unique(self.whole.recording).tolist()
        ]
        return make_windows(broken, None, self.layout, length=length)

    def _combined(self, x: Floats) -> Classes:
        """Correct the first recordings, diagnose from them, adapt, and predict the rest with the
        adapted model."""
        numbers = np.unique(self.whole.recording)
        log = np.random.default_rng(self.seed).permutation(numbers)[: min(_LOG, len(numbers) // 2)]
        full_scale = self.layout.full_scale
        frames = [
            x[self.whole.recording == i].reshape(-1, x.shape[2]).astype(np.float64) * full_scale
            for i in log.tolist()
        ]
        found = self.diagnoser.diagnose(frames).fault_set
        first = np.isin(self.test.recording, log)
        answers = self._answers("correct to the mean", x)
        answers[~first] = self._adapted(found, x[self.kept])[~first]
        return answers

    @cached_property
    def diagnoser(self) -> SelfDiagnosis:
        """Self-diagnosis fitted on fault-free recordings."""
        known = np.unique(self.train.recording)
        return SelfDiagnosis(self.layout).fit(
            [self.setup.recordings.frames[i] for i in known[evenly(len(known), _REFERENCE)]]
        )
