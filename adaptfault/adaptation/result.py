"""A model adapted to a fault set F: predictions, cost of each stage, scores, storage."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.reduced_model import ReducedModel, phi
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import Scores, ValueScores
from adaptfault.imputation.linear import AffineFill, NearestFill
from adaptfault.imputation.tiled import TiledFill
from adaptfault.models.accumulation import ContactStatistics
from adaptfault.models.any_model import network_from_config
from adaptfault.models.builders import ModelNotAllowed
from adaptfault.models.heads import Head
from adaptfault.models.network import logits_of
from adaptfault.models.store import ADAPTATION, load_tensors, load_with_head, save_tensors
from diagnostics import FaultSet


@dataclass(frozen=True)
class Stage:
    """Cost and validation score of one stage of an adaptation.

    Attributes:
        name: "fill", "head", "finetune" or "scratch".
        seconds: wall clock, without the scoring.
        accuracy: on validation (R2 of a regression); None where it was not computed.
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

    def predict(self, x: NDArray[Any] | Tensor) -> NDArray[Any]:
        """Return the class of each window ``[N, T, D]``, int64 ``[N]``, or its values, float32
        ``[N, k]``.

        The cells in F may hold anything, NaN included.
        """
        outputs = self._logits(x)
        answers: NDArray[Any] = (
            outputs if self.task == "regression" else outputs.argmax(1)
        ).numpy()
        return answers

    def predict_proba(self, x: NDArray[Any] | Tensor) -> NDArray[np.float32]:
        """Return class probabilities ``[N, n_classes]`` of windows ``[N, T, D]``.

        Raises:
            ValueError: the model is a regression.
        """
        if self.task == "regression":
            raise ValueError("a regression has no class probabilities: use predict")
        probabilities: NDArray[np.float32] = self._logits(x).softmax(1).numpy()
        return probabilities

    def _logits(self, x: NDArray[Any] | Tensor) -> Tensor:
        return logits_of(self.model, phi(np.asarray(x, dtype=np.float32), self.fault_set))

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
        outputs = self._outputs(self._validation)
        if self.task == "regression":
            return ValueScores.of(self._validation.y, outputs.numpy())
        return Scores.of(
            self._validation.y, outputs.argmax(1).numpy(), n_classes=self.model.network.n_classes
        )

    def _outputs(self, validation: Windows) -> Tensor:
        """Return the outputs for the validation windows, computed once."""
        if self._held_out is None:
            object.__setattr__(self, "_held_out", self._logits(validation.x))
        assert self._held_out is not None
        return self._held_out

    @property
    def contact(self) -> ContactStatistics | None:
        """What accumulating probabilities over a contact needs; None for a regression, or where it
        is not stored."""
        if self._contact is not None or self._validation is None or self.task == "regression":
            return self._contact
        windows = self._validation
        likely = self._outputs(windows).softmax(1).numpy()
        return ContactStatistics.fit(windows.x, likely, windows.y, windows.recording)

    def save(self, path: str | Path) -> None:
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
        }
        save_tensors(path, ADAPTATION, about, model.state_dict())

    @classmethod
    def load(
        cls, path: str | Path, *, network: nn.Module | None = None, features: Any = None
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
        try:
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
        except ModelNotAllowed:
            raise
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(
                f"the adaptation in {path} is damaged: {str(error).splitlines()[0]}"
            ) from None
        return cls(model.eval(), fault_set, stages, task, _scores=scores, _contact=contact)


def load_healthy(folder: str | Path) -> Adaptation:
    """Read the model that :func:`~adaptfault.save_model` wrote, with its head in closed form.

    The result is an adaptation to the empty fault set, without scores. Raises the errors of
    :func:`~adaptfault.load_model`.
    """
    model, head = load_with_head(folder)
    none = FaultSet((), model.layout.n_cells)
    return Adaptation(ReducedModel(model, none, None, head).eval(), none, ())


def _empty_front(about: dict[str, Any], fault_set: FaultSet) -> nn.Module:
    """Build the front end to load a state into."""
    if about.get("patches") is not None:
        return TiledFill(fault_set, about["patches"])
    linear = AffineFill.empty(fault_set)
    frames = about["reference_frames"]
    if frames is None:
        return linear
    return NearestFill(fault_set, linear, np.zeros((frames, fault_set.n_cells), "f4"))
