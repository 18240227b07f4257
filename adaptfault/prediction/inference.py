"""Runs an adapted model from its folder: on ONNX Runtime without torch where it is installed, else
on torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adaptfault.models.accumulation import ContactStatistics
from adaptfault.models.prediction_sets import PredictionSets
from adaptfault.models.store import (
    ADAPTATION,
    Place,
    read_attached,
    read_manifest,
    undamaged,
)
from diagnostics import FaultSet, SensorLayout
from diagnostics.preprocessing.array_likes import plain_array

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

ONNX_FILE = "model.onnx"
Runtime = Literal["onnx", "torch"]

# windows run at once; ONNX has no kernel of absolute distances that holds less than all differences
_BATCH = 16


@dataclass(eq=False)
class Inference:
    """A classifier, or a regression, of whole windows, adapted to F.

    Attributes:
        run: maps windows ``[N, T, D]`` to outputs ``[N, n_classes]``.
        runtime: "onnx" or "torch".
        layout: the array whose windows it takes.
        fault_set: F; the readings of its cells cannot reach the output, not even NaN or infinity.
        length: T, frames in a window.
        n_classes: number of classes, or of values.
        contact: for decisions about whole contacts.
        task: "classification" or "regression".
        sets: for sets of classes; None: stored without.
    """

    run: Callable[[NDArray[np.float32]], NDArray[np.float32]]
    runtime: Runtime
    layout: SensorLayout
    fault_set: FaultSet
    length: int
    n_classes: int
    contact: ContactStatistics
    task: Literal["classification", "regression"] = "classification"
    sets: PredictionSets | None = None

    @classmethod
    def load(cls, folder: Place, *, runtime: Runtime | None = None) -> Inference:
        """Read a folder that :meth:`Adaptation.save` wrote, with an ONNX file where ``add_onnx``
        added one.

        Args:
            folder: the folder to read.
            runtime: "onnx" or "torch". None: ONNX Runtime if it is installed and the folder has an
                ONNX file, else torch.

        Raises:
            FileNotFoundError: the folder or a file is missing.
            ValueError: a file is damaged or of another kind; the runtime is unknown or cannot run
                this model.
            ImportError: the runtime is not installed.
        """
        if runtime is not None and runtime not in get_args(Runtime):
            raise ValueError(
                f"unknown runtime {runtime!r}: use one of {', '.join(get_args(Runtime))}"
            )
        manifest = read_manifest(folder, ADAPTATION)
        with undamaged("adaptation", folder):
            network = manifest["network"]
            layout = SensorLayout.from_dict(network["layout"])
            fault_set = FaultSet(tuple(manifest["fault_set"]), layout.n_cells)
            length = int(network["length"])
            n_classes = int(network["n_classes"])
            stored = manifest.get("contact")
            contact = ContactStatistics.unknown(layout.n_cells)
            if stored is not None:
                contact = ContactStatistics.from_dict(stored)
            kept = manifest.get("sets")
            sets = None if kept is None else PredictionSets.from_dict(kept)
            task = manifest.get("task", "classification")
            if task not in ("classification", "regression"):
                raise ValueError(f"unknown task {task!r}")
        exported = "onnx" in manifest
        if runtime is None:
            runtime = "onnx" if exported and find_spec("onnxruntime") else "torch"
        if runtime == "onnx" and not exported:
            raise ValueError(
                f"{folder} has no ONNX file: add one with add_onnx, or run it on torch"
            )
        run = _on_onnx(folder, manifest) if runtime == "onnx" else _on_torch(folder)
        return cls(run, runtime, layout, fault_set, length, n_classes, contact, task, sets)

    def prediction_sets(
        self, x: NDArray[Any], alpha: float = 0.1, *, by_class: bool = False
    ) -> NDArray[np.bool_]:
        """Return for each window ``[N, T, D]`` the set of classes that holds its true one with
        probability 1 - ``alpha``, bool ``[N, n_classes]``; ``by_class``: of each class
        (:mod:`adaptfault.models.prediction_sets`).

        Raises:
            ValueError: windows of another shape, an ``alpha`` that is no share, a regression, or an
                adaptation that was stored without validation.
        """
        return self.sets_of(self.predict_proba(x), alpha, by_class=by_class)

    def sets_of(
        self, likely: NDArray[np.float32], alpha: float, *, by_class: bool = False
    ) -> NDArray[np.bool_]:
        """Return the sets of classes, bool ``[N, n_classes]``, for probabilities
        ``[N, n_classes]`` of this model.

        Raises:
            ValueError: an ``alpha`` that is no share, or an adaptation that was stored without
                validation.
        """
        if self.sets is None:
            raise ValueError("sets of classes need validation windows, which were not stored here")
        return self.sets.sets(likely, alpha, by_class)

    def predict_proba(self, x: NDArray[Any]) -> NDArray[np.float32]:
        """Return the probability of each class for windows ``[N, T, D]`` on the 0..1 scale,
        ``[N, n_classes]``.

        Raises:
            ValueError: windows of another shape; the model is a regression.
        """
        if self.task == "regression":
            raise ValueError("a regression has no class probabilities: use predict")
        return self._outputs(x)

    def _outputs(self, x: NDArray[Any]) -> NDArray[np.float32]:
        x = plain_array(x).astype(np.float32, copy=False)
        if x.ndim != 3 or x.shape[1:] != (self.length, self.layout.n_cells):
            raise ValueError(
                f"expected windows [N, {self.length}, {self.layout.n_cells}], got {list(x.shape)}"
            )
        batches = [self.run(x[i : i + _BATCH]) for i in range(0, len(x), _BATCH)]
        return np.concatenate(batches) if batches else np.zeros((0, self.n_classes), np.float32)

    def predict(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return the class of each window ``[N, T, D]``, int64 ``[N]``, or its values, float32
        ``[N, k]``.

        Raises:
            ValueError: windows of another shape.
        """
        outputs = self._outputs(x)
        return outputs if self.task == "regression" else outputs.argmax(axis=1).astype(np.int64)

    def __str__(self) -> str:
        runtime = "ONNX Runtime" if self.runtime == "onnx" else "torch"
        kind = "values" if self.task == "regression" else "classes"
        what = f"{self.n_classes} {kind} from {self.length} frames of {self.layout}"
        return f"{what}, {len(self.fault_set)} cells dropped, on {runtime}"


def open_session(data: bytes) -> InferenceSession:
    """Return an ONNX Runtime session for the content of an ONNX file.

    It uses one thread without spinning: spinning threads take 29 % of a core at 10 frames a second.

    Raises:
        ImportError: ONNX Runtime is not installed.
        ValueError: it is not an ONNX file, or its version is too new for this ONNX Runtime.
    """
    from onnxruntime import InferenceSession, SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3  # errors; they are raised as well
    try:
        return InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime derives its errors from Exception directly
        raise ValueError(
            f"ONNX Runtime cannot run this file: {str(error).splitlines()[0]}"
        ) from None


def run_session(session: InferenceSession, x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the outputs ``[N, n]`` of a session for windows ``[N, T, D]``."""
    outputs: NDArray[np.float32] = session.run(None, {"x": np.ascontiguousarray(x)})[0]
    return outputs


def _on_onnx(
    folder: Place, manifest: dict[str, Any]
) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    session = open_session(read_attached(folder, manifest, "onnx"))
    return lambda x: run_session(session, x)


def _on_torch(folder: Place) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    from adaptfault.adaptation.result import Adaptation

    adaptation = Adaptation.load(folder)
    return adaptation.predict if adaptation.task == "regression" else adaptation.predict_proba
