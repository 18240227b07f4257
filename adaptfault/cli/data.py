"""A trained model with the recordings it belongs to: the same windows, split as they were when it was trained."""

from __future__ import annotations

from typing import Any

from adaptfault.adaptation.fault_free import Network
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import Windows, make_windows, split
from adaptfault.models.store import SCHEMA, load_model, read_manifest


def open_model(folder: str) -> tuple[Network, dict[str, Any]]:
    """Return a model written by ``adaptfault train`` and its manifest."""
    return load_model(folder), read_manifest(folder, SCHEMA)


def windows_of(recordings: Recordings, model: Network, manifest: dict[str, Any]) -> Windows:
    """Cut recordings into the windows that the model takes.

    Raises:
        ValueError: another array, or other classes, than the model's.
    """
    if recordings.layout.shape != model.layout.shape:
        raise ValueError(f"the recordings are of {recordings.layout}, the model of {model.layout}")
    known = tuple(manifest["class_names"])
    if recordings.labels is not None and known and recordings.class_names != known:
        strange = sorted(set(recordings.class_names) - set(known)) or sorted(set(known) - set(recordings.class_names))
        raise ValueError(f"the recordings and the model differ in their classes: {strange[0]!r} is in one of them only")
    return make_windows(recordings.frames, recordings.labels, recordings.layout, length=model.length)


def parts_of(recordings: Recordings, model: Network, manifest: dict[str, Any]) -> tuple[Windows, Windows, Windows]:
    """Return training, validation and test windows, the same as in training."""
    return split(windows_of(recordings, model, manifest), seed=int(manifest["extra"].get("split_seed", 0)))
