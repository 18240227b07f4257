"""A model adapted to a fault set F: predictions, cost of each stage, scores, storage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.reduced_model import ReducedModel, phi
from adaptfault.data.windows import Windows, finite_windows
from adaptfault.evaluation.class_recall import ClassRecall, class_recalls
from adaptfault.evaluation.scores import Scores, ValueScores, scored
from adaptfault.imputation.linear import AffineFill, NearestFill
from adaptfault.imputation.tiled import TiledFill
from adaptfault.models.accumulation import ContactStatistics
from adaptfault.models.any_model import network_from_config
from adaptfault.models.heads import Head
from adaptfault.models.network import logits_of
from adaptfault.models.prediction_sets import PredictionSets
from adaptfault.models.store import (
    ADAPTATION,
    SCHEMA,
    Place,
    load_tensors,
    load_with_head,
    read_manifest,
    save_tensors,
    undamaged,
)
from diagnostics import FaultSet
from diagnostics.preprocessing.array_likes import plain_array
from diagnostics.shown import shown


@dataclass(frozen=True)
class Stage:
    """Cost and validation score of one stage of an adaptation.

    Attributes:
        name: "fill", "head", "finetune" or "scratch".
        seconds: wall clock, without the scoring.
        accuracy: on validation (R2 of a regression); None where it was not computed.
        measure: what that is, "accuracy" or "R2".
    """

    name: str
    seconds: float
    accuracy: float | None = None
    measure: str = "accuracy"

    def __str__(self) -> str:
        reached = (
            "" if self.accuracy is None else f", validation {self.measure} {self.accuracy:.3f}"
        )
        return f"{self.name}: {self.seconds:.2f} s{reached}"


@shown
@dataclass(frozen=True, eq=False)
class Adaptation:
    """A model adapted to F.

    Attributes:
        model: the reduced model, from the D - k healthy cells to logits or values.
        fault_set: F, the dropped cells.
        stages: cost and score of each stage, in the order they ran.
        task: "classification" or "regression".
    """

    model: ReducedModel
    fault_set: FaultSet
    stages: tuple[Stage, ...]
    task: Literal["classification", "regression"] = "classification"
    _validation: Windows | None = field(default=None, repr=False)
    _held_out: Tensor | None = field(default=None, repr=False)
    _scores: Scores | ValueScores | None = field(default=None, repr=False)
    _contact: ContactStatistics | None = field(default=None, repr=False)
    _conformal: PredictionSets | None = field(default=None, repr=False)
    _recalls: tuple[ClassRecall, ...] = field(default=(), repr=False)

    def __str__(self) -> str:
        left_out = f"{self.task} without {len(self.fault_set)} cells"
        return "\n".join([left_out, *(f"  {stage}" for stage in self.stages)])

    def predict(self, x: NDArray[Any] | Tensor, **extra: NDArray[Any] | Tensor) -> NDArray[Any]:
        """Return the class of each window ``[N, T, D]``, int64 ``[N]``, or its values, float32
        ``[N, k]``; of a policy its actions, float32 ``[N, ...]``.

        The cells in F may hold anything, NaN included; a missing reading of another cell is held
        from the frame before.

        Args:
            x: windows on the 0..1 scale.
            extra: what else the model sees of these windows, by name, ``[N, ...]`` each.
        """
        outputs = self._logits(x, extra)
        if self.task == "classification":
            classes: NDArray[Any] = outputs.argmax(1).numpy()
            return classes
        shape = getattr(self.model.network, "shape", outputs.shape[1:])
        values: NDArray[Any] = outputs.reshape(-1, *shape).numpy()
        return values

    def predict_proba(
        self, x: NDArray[Any] | Tensor, **extra: NDArray[Any] | Tensor
    ) -> NDArray[np.float32]:
        """Return class probabilities ``[N, n_classes]`` of windows ``[N, T, D]``; arguments as
        :meth:`predict`.

        Raises:
            ValueError: the model is a regression.
        """
        if self.task == "regression":
            raise ValueError("a regression has no class probabilities: use predict")
        probabilities: NDArray[np.float32] = self._logits(x, extra).softmax(1).numpy()
        return probabilities

    def _logits(
        self,
        x: NDArray[Any] | Tensor,
        extra: Mapping[str, NDArray[Any] | Tensor] = MappingProxyType({}),
    ) -> Tensor:
        healthy = phi(plain_array(x).astype(np.float32, copy=False), self.fault_set)
        return logits_of(self.model, finite_windows(healthy), extra)

    @cached_property
    def scores(self) -> Scores | ValueScores:
        """Scores on the fault-free validation windows without F, computed on first use.

        A head is fitted to the validation windows too. Each fifth of their recordings is scored by
        a head fitted without it.
        """
        if self._scores is not None:
            return self._scores
        if self._validation is None:
            raise ValueError("this adaptation was loaded without scores")
        return scored(self._validation.y, self._outputs(self._validation).numpy())

    def _outputs(self, validation: Windows) -> Tensor:
        """Return the outputs for the validation windows, computed once."""
        if self._held_out is None:
            outputs = self._logits(validation.x, validation.extra)
            object.__setattr__(self, "_held_out", outputs)
        assert self._held_out is not None
        return self._held_out

    @property
    def accuracy(self) -> float:
        """Accuracy on validation, R2 of a regression: that of :attr:`scores`."""
        scores = self.scores
        return scores.r2 if isinstance(scores, ValueScores) else scores.accuracy

    @property
    def by_class(self) -> NDArray[np.float64]:
        """Recall of each class on validation, float ``[n_classes]``: the share of its windows that
        is recognised; NaN for a class without a window.

        Raises:
            ValueError: the model is a regression.
        """
        scores = self.scores
        if isinstance(scores, ValueScores):
            raise ValueError("a regression has no classes: use scores")
        return scores.by_class

    @cached_property
    def recalls(self) -> tuple[ClassRecall, ...]:
        """Recall of each class on validation without F, with its 95 % interval and the class that
        it is most often taken for; none of a regression, or where validation is not stored."""
        windows = self._validation
        if windows is None or self.task == "regression":
            return self._recalls
        predicted = self._outputs(windows).argmax(1).numpy()
        return class_recalls(windows.y, predicted, windows.recording, new=np.inf)

    def prediction_sets(
        self,
        x: NDArray[Any] | Tensor,
        alpha: float = 0.1,
        *,
        by_class: bool = False,
        **extra: NDArray[Any] | Tensor,
    ) -> NDArray[np.bool_]:
        """Return for each window the set of classes that holds its true one with probability
        1 - ``alpha``, bool ``[N, n_classes]``.

        :mod:`adaptfault.models.prediction_sets` describes the method and what it assumes. A
        robot that acts on sets of a single class only is right about as often as stated; a set of
        several classes, or of none, says that the window does not decide.

        Args:
            x: windows ``[N, T, D]``, 0..1; the cells in F may hold anything.
            alpha: the share of windows whose true class may be missing, between 0 and 1.
            by_class: the share holds for the windows of each class, and not only of all. Needs
                1 / alpha - 1 validation recordings of a class, which else is in every set.
            extra: as for :meth:`predict`.

        Raises:
            ValueError: ``alpha`` is outside; a regression; or the adaptation was stored without
                validation.
        """
        return self.conformal.sets(self.predict_proba(x, **extra), alpha, by_class)

    @cached_property
    def conformal(self) -> PredictionSets:
        """What :meth:`prediction_sets` needs to know of the validation windows.

        Raises:
            ValueError: a regression, or an adaptation without validation windows.
        """
        if self._conformal is not None:
            return self._conformal
        if self.task == "regression":
            raise ValueError("a regression has no sets of classes")
        windows = self._validation
        if windows is None:
            raise ValueError("sets of classes need validation windows, which were not stored here")
        likely = self._outputs(windows).softmax(1).numpy()
        return PredictionSets.fit(likely, windows.y, windows.recording)

    @property
    def contact(self) -> ContactStatistics | None:
        """What accumulating probabilities over a contact needs; None for a regression, or where it
        is not stored."""
        if self._contact is not None or self._validation is None or self.task == "regression":
            return self._contact
        windows = self._validation
        likely = self._outputs(windows).softmax(1).numpy()
        return ContactStatistics.fit(windows.x, likely, windows.y, windows.recording)

    def save(self, path: Place) -> None:
        """Write to a folder: weights as safetensors, the rest as JSON, no pickle."""
        model = self.model
        about = {
            "task": self.task,
            "network": model.network.config,
            "fault_set": list(self.fault_set),
            "reference_frames": len(model.front.roots)
            if isinstance(model.front, NearestFill)
            else None,
            "patches": model.front.sizes if isinstance(model.front, TiledFill) else None,
            "head": None if model.head is None else model.head.about,
            "stages": [vars(stage) for stage in self.stages],
            "scores": self.scores.to_dict(),
            "contact": None if (contact := self.contact) is None else contact.to_dict(),
            "sets": self._sets_to_dict(),
            "classes": [one.to_dict() for one in self.recalls],
        }
        save_tensors(path, ADAPTATION, about, model.state_dict())

    def _sets_to_dict(self) -> dict[str, Any] | None:
        if self.task == "regression" or (self._validation is None and self._conformal is None):
            return None
        return self.conformal.to_dict()

    @classmethod
    def load(
        cls, path: Place, *, network: nn.Module | None = None, features: Any = None
    ) -> Adaptation:
        """Read an adaptation written by :meth:`save`.

        Args:
            path: the folder.
            network: an instance of the adapted model; its weights are replaced. None: a
                ``TactileTransformer``, or a model with an allowed builder
                (:func:`~adaptfault.models.builders.allow_model`).
            features: the function that computed its features, if a function was given.

        Raises:
            FileNotFoundError: the folder or a file is missing.
            ValueError: a file is damaged or of another kind, or ``network`` is needed.
        """
        about, tensors = load_tensors(path, ADAPTATION)
        with undamaged("adaptation", path):
            inner = network_from_config(about["network"], network, features)
            fault_set = FaultSet(tuple(about["fault_set"]), inner.layout.n_cells)
            front = _empty_front(about, fault_set)
            head = None if about["head"] is None else Head.empty(about["head"], inner.n_classes)
            model = ReducedModel(inner, fault_set, front, head)
            model.load_state_dict(tensors)
            stages = tuple(Stage(**stage) for stage in about["stages"])
            task = about.get("task", "classification")
            scores = (ValueScores if task == "regression" else Scores).from_dict(about["scores"])
            stored = about.get("contact")
            contact = None if stored is None else ContactStatistics.from_dict(stored)
            kept = about.get("sets")
            sets = None if kept is None else PredictionSets.from_dict(kept)
            recalls = tuple(ClassRecall.from_dict(one) for one in about.get("classes", ()))
        return cls(
            model.eval(),
            fault_set,
            stages,
            task,
            _scores=scores,
            _contact=contact,
            _conformal=sets,
            _recalls=recalls,
        )


def load_healthy(folder: Place) -> Adaptation:
    """Read the model that :func:`~adaptfault.save_model` wrote, with its head in closed form.

    The result is an adaptation to the empty fault set, without scores. Raises the errors of
    :func:`~adaptfault.load_model`.
    """
    model, head = load_with_head(folder)
    task = read_manifest(folder, SCHEMA).get("task", "classification")
    none = FaultSet((), model.layout.n_cells)
    return Adaptation(ReducedModel(model, none, None, head).eval(), none, (), task)


def _empty_front(about: dict[str, Any], fault_set: FaultSet) -> nn.Module:
    """Build the front end to load a state into."""
    if about.get("patches") is not None:
        return TiledFill(fault_set, about["patches"])
    linear = AffineFill.empty(fault_set)
    frames = about["reference_frames"]
    if frames is None:
        return linear
    return NearestFill(fault_set, linear, np.zeros((frames, fault_set.n_cells), "f4"))
