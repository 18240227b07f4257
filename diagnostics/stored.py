"""What a fitted diagnosis knows, as JSON and plain arrays, and back, checked: no pickle, and not a bit lost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.contact import ContactModel
from diagnostics.flicker import Flicker
from diagnostics.layout import SensorLayout
from diagnostics.reference import Reference, living
from diagnostics.resting import Least
from diagnostics.rim import INPUTS, Rim
from diagnostics.scale import Scale
from diagnostics.tare import UsualOffset
from diagnostics.temporal import Onsets
from diagnostics.tiles import Tile
from diagnostics.unrest import Usual
from diagnostics.weighing import Weights

Arrays = dict[str, NDArray[Any]]

# Fields of a tile or of the rim that are not stored as arrays: in the dict, or following from others.
_TOLD = ("surest", "place", "touches")
# Arrays that may hold infinity: a feature that never changed is divided by it, and nothing is less than not known.
_ENDLESS = ("scale", "least", "longest")
_UNKNOWN = ("spread",)  # arrays that may hold NaN: of cells that were never loaded


def weights_state(weights: Weights) -> dict[str, Any]:
    """Return the weights, JSON-safe, as :func:`weights_from_state` reads them."""
    return {name: list(v) if isinstance(v, tuple) else float(v) for name, v in vars(weights).items()}


def weights_from_state(about: Mapping[str, Any]) -> Weights:
    """Rebuild the weights.

    Raises:
        KeyError, TypeError, ValueError: a field is missing or of a wrong kind.
    """
    usual = vars(Weights())
    read = {name: tuple(float(value) for value in about[name]) for name in usual if name != "gains"}
    for name, values in read.items():
        if len(values) != len(usual[name]) or not np.isfinite(values).all():
            raise ValueError(f"expected {len(usual[name])} numbers for {name}, got {list(values)}")
    gains = float(about["gains"])
    if not 0 < gains <= 1:
        raise ValueError(f"expected a share for gains, got {gains}")
    return Weights(**read, gains=gains)


def reference_state(reference: Reference) -> tuple[dict[str, Any], Arrays]:
    """Return a reference as a JSON-safe dict and its arrays by name, as :func:`reference_from_state` reads them."""
    about = {
        "tolerance": float(reference.tolerance),
        "near": float(reference.scale.near),
        "usual": float(reference.least.usual) if np.isfinite(reference.least.usual) else None,
        "recording": float(reference.flicker.recording),
        "patience": int(reference.patience),
        "blinks": float(reference.usual.blinks),
        "blinks_count": float(reference.usual.blinks_count),
        "noise_counts": float(reference.usual.noise_counts),
        "alone": bool(reference.usual.alone),
        "offset": [float(value) for value in reference.offset],
        "twins": int(reference.twins),
        "surest": None if reference.model is None else [float(tile.surest) for tile in reference.model.tiles],
        "rim": reference.model.rim.touches if reference.model and reference.model.rim else None,
    }
    arrays: Arrays = {
        "resting": reference.scale.resting,
        "least": reference.least.reading,
        "longest": reference.flicker.longest,
        "onsets": reference.onsets.log_ratio,
        "noise": reference.usual.noise,
        "dead": reference.dead,
    }
    if reference.model:
        rim = vars(reference.model.rim) if reference.model.rim else {}
        arrays |= {f"rim.{name}": value for name, value in rim.items() if name not in _TOLD}
        for i, tile in enumerate(reference.model.tiles):
            arrays |= {f"tile{i}.{name}": value for name, value in vars(tile).items() if name not in _TOLD}
    return about, {name: np.array(value, order="C") for name, value in arrays.items()}


def reference_from_state(about: Mapping[str, Any], arrays: Mapping[str, ArrayLike], layout: SensorLayout) -> Reference:
    """Rebuild a reference.

    Raises:
        KeyError, TypeError, ValueError: a field or array is missing, of a wrong kind or shape, or not finite.
    """
    unknown = Reference.unknown(layout)

    def read(name: str, like: NDArray[Any]) -> NDArray[Any]:
        return _checked(name, arrays[name], like.shape, like.dtype)

    scale = Scale(read("resting", unknown.scale.resting), float(about["near"]), layout.full_scale)
    dead = read("dead", unknown.dead)
    reference = Reference(
        float(about["tolerance"]),
        scale,
        Onsets(read("onsets", unknown.onsets.log_ratio)),
        Least(
            read("least", unknown.least.reading),
            -np.inf if about["usual"] is None else float(about["usual"]),
        ),
        Flicker(read("longest", unknown.flicker.longest), float(about["recording"])),
        UsualOffset(*(float(value) for value in about["offset"])),
        int(about["patience"]),
        Usual(
            float(about["blinks"]),
            read("noise", unknown.usual.noise),
            float(about["blinks_count"]),
            float(about["noise_counts"]),
            bool(about["alone"]),
        ),
        int(about["twins"]),
        None if about["surest"] is None else _model(about, arrays, living(layout, dead)),
        dead,
    )
    usual = reference.usual
    shares = (usual.blinks, usual.blinks_count, usual.noise_counts)
    positive = (reference.tolerance, scale.near, reference.flicker.recording, reference.patience, *shares)
    if not (np.isfinite(positive).all() and min(positive) > 0):
        wanted = "tolerance, near, recording, patience, blinks, blinks_count and noise_counts"
        raise ValueError(f"expected positive numbers for {wanted}, got {positive}")
    if np.isnan([reference.least.usual, *reference.offset]).any():
        raise ValueError(f"expected numbers for usual and offset, got {reference.least.usual}, {reference.offset}")
    return reference


def _model(about: Mapping[str, Any], arrays: Mapping[str, ArrayLike], layout: SensorLayout) -> ContactModel:
    tiles = tuple(_tile(arrays, i, float(surest), layout) for i, surest in enumerate(about["surest"]))
    outputs = np.sort(np.concatenate([tile.outputs for tile in tiles])) if tiles else np.zeros(0)
    if not np.array_equal(outputs, np.flatnonzero(layout.present)):
        raise ValueError(f"the models do not cover the cells of {layout}, each once")
    if about["rim"] is None:
        return ContactModel(tiles, layout)
    touches = int(about["rim"])
    if touches < 1:
        raise ValueError(f"expected the number of touches that the rim was learned from, got {touches}")
    units = np.shape(arrays["rim.hidden"])[1:2]
    shapes = {
        "mean": (INPUTS,), "scale": (INPUTS,), "weight": (INPUTS, 2), "bias": (2,),
        "hidden": (INPUTS, *units), "threshold": units, "out": (*units, 2),
    }  # fmt: skip
    kind = np.dtype(np.float64)
    read = {name: _checked(f"rim.{name}", arrays[f"rim.{name}"], shape, kind) for name, shape in shapes.items()}
    return ContactModel(tiles, layout, Rim(**read, touches=touches))


def _tile(arrays: Mapping[str, ArrayLike], i: int, surest: float, layout: SensorLayout) -> Tile:
    if not 0 < surest < 1:
        raise ValueError(f"expected surest between 0 and 1, got {surest}")
    inputs, outputs = (_cells(f"tile{i}.{name}", arrays, layout) for name in ("inputs", "outputs"))
    n_in, n_out = len(inputs), len(outputs)
    if not np.isin(outputs, inputs).all():
        raise ValueError(f"tile{i}.outputs holds cells that tile{i}.inputs lacks")
    single, double = np.dtype(np.float32), np.dtype(np.float64)
    shapes: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {
        "mean": ((4, n_in), single),
        "scale": ((4, n_in), single),
        "weight": ((4 * n_in, 2 * n_out), single),
        "bias": ((2 * n_out,), single),
        "covariance": ((n_in, n_in), double),
        "precision": ((n_in, n_in), double),
        "spread": ((n_out,), double),
    }
    read = {name: _checked(f"tile{i}.{name}", arrays[f"tile{i}.{name}"], *like) for name, like in shapes.items()}
    return Tile(inputs, outputs, np.searchsorted(inputs, outputs), **read, surest=surest)


def _cells(name: str, arrays: Mapping[str, ArrayLike], layout: SensorLayout) -> NDArray[np.intp]:
    cells = np.asarray(arrays[name])
    if cells.dtype.kind != "i" or not np.array_equal(cells, np.unique(np.clip(cells, 0, layout.n_cells - 1))):
        raise ValueError(f"expected indices of the {layout.n_cells} cells for {name}, ascending")
    return cells.astype(np.intp)


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a copy of its own, as the fitted arrays are."""
    array = np.asarray(value)
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(f"expected {dtype} {list(shape)} for {name}, got {array.dtype} {list(array.shape)}")
    strange = (np.isnan(array) & (not name.endswith(_UNKNOWN))) | (np.isinf(array) & (not name.endswith(_ENDLESS)))
    if strange.any():
        raise ValueError(f"{name} holds numbers that are not finite")
    return np.array(array, order="C")
