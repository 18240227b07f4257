"""A model adapted to a fault set F: what it predicts, what it cost, and how it is kept on disk."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.heads import Blend
from adaptfault.adaptation.reduced_model import ReducedModel, phi
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import Scores, evaluate
from adaptfault.imputation.linear import AffineFill, NearestFill
from adaptfault.imputation.tiled import TiledFill
from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.store import ADAPTATION, load_tensors, save_tensors
from diagnostics import FaultSet


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
        fault_set: F, the cells it does without.
        stages: what each stage cost and reached, in the order they ran.
    """

    model: ReducedModel
    fault_set: FaultSet
    stages: tuple[Stage, ...]
    _validation: Windows | None = field(default=None, repr=False)
    _held_out: NDArray[np.int64] | None = field(default=None, repr=False)
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
        """Scores on the fault-free validation windows with F taken away; computed when first asked for.

        A head learns from the validation windows too. They are scored by heads fitted without their fifth of the
        recordings.
        """
        if self._scores is not None:
            return self._scores
        if self._validation is None:
            raise ValueError("this adaptation was loaded without scores")
        if self._held_out is None:
            return evaluate(self, self._validation)
        return Scores.of(self._validation.y, self._held_out, n_classes=self.model.network.n_classes)

    def save(self, path: str | Path) -> None:
        """Write to a folder: weights as safetensors, the rest as JSON, no pickle."""
        model = self.model
        about = {
            "network": model.network.config,
            "fault_set": list(self.fault_set),
            "reference_frames": len(model.front.roots) if isinstance(model.front, NearestFill) else None,
            "patches": model.front.sizes if isinstance(model.front, TiledFill) else None,
            "head": None if model.head is None else model.head.about,
            "stages": [vars(stage) for stage in self.stages],
            "scores": self.scores.to_dict(),
        }
        save_tensors(path, ADAPTATION, about, model.state_dict())

    @classmethod
    def load(cls, path: str | Path) -> Adaptation:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: there is nothing, or a file is missing.
            ValueError: a file is damaged or of another kind.
        """
        about, tensors = load_tensors(path, ADAPTATION)
        try:
            network = TactileTransformer.from_config(about["network"])
            fault_set = FaultSet(tuple(about["fault_set"]), network.layout.n_cells)
            front = _empty_front(about, fault_set)
            head = None if about["head"] is None else Blend.empty(about["head"], network.n_classes)
            model = ReducedModel(network, fault_set, front, head)
            model.load_state_dict(tensors)
            stages = tuple(Stage(**stage) for stage in about["stages"])
            scores = Scores.from_dict(about["scores"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"the adaptation in {path} is damaged: {str(error).splitlines()[0]}") from None
        return cls(model.eval(), fault_set, stages, _scores=scores)


def _empty_front(about: dict[str, Any], fault_set: FaultSet) -> nn.Module:
    """Build the front end that a state was saved of, to load it into."""
    if about.get("patches") is not None:
        return TiledFill(fault_set, about["patches"])
    linear, frames = AffineFill.empty(fault_set), about["reference_frames"]
    if frames is None:
        return linear
    return NearestFill(fault_set, linear, np.zeros((frames, fault_set.n_cells), "f4"))
