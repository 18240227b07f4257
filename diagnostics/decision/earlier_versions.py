"""Reads a diagnosis that was stored with schema 8 or 9, so that the bundles of deployed robots still open."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.layout import SensorLayout

_SCHEMA_8, _SCHEMA_9 = "adaptfault.diagnoser/8", "adaptfault.diagnoser/9"
SCHEMAS = _SCHEMA_8, _SCHEMA_9
_REGRESSION = {"inputs", "outputs", "mean", "scale", "weight", "bias", "covariance", "precision", "spread"}
_STACKING = {"mean", "scale", "weight", "bias", "hidden", "threshold", "out"}


State = tuple[dict[str, Any], dict[str, NDArray[Any]]]


def converted(about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> State:
    """Return the state and the arrays of an earlier schema as those of the present one."""
    return _from_9(*_from_8(about, arrays)) if about["schema"] == _SCHEMA_8 else _from_9(about, arrays)


def _from_9(about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> State:
    state = copy.deepcopy(dict(about))
    found: dict[str, NDArray[Any]] = {name: np.array(value) for name, value in arrays.items()}
    reference = state["reference"]
    if reference is None:
        return state, found
    stacking = reference["model"] and reference["model"]["stacking"]
    if not stacking:
        return state, found
    # The linear part w'x of the network becomes units of it: max(w'x, 0) - max(-w'x, 0).
    names = {name: stacking[name]["array"] for name in ("weight", "hidden", "threshold", "out")}
    weight, hidden, threshold, out = (found[name] for name in names.values())
    both = np.eye(weight.shape[1])
    for name, value in (
        ("hidden", np.concatenate([hidden, weight, -weight], axis=1)),
        ("threshold", np.concatenate([threshold, np.zeros(2 * weight.shape[1])])),
        ("out", np.concatenate([out, both, -both])),
    ):
        found[names[name]] = value
        stacking[name] = {**stacking[name], "dtype": str(value.dtype), "shape": list(value.shape)}
    return state, found


def _from_8(about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> State:
    layout = SensorLayout.from_dict(about["layout"])
    state = {name: about[name] for name in ("layout", "false_discovery_rate")}
    state["calibrator"] = about["weights"]
    found: dict[str, NDArray[Any]] = {name: np.asarray(value) for name, value in arrays.items()}

    def array(name: str) -> dict[str, Any]:
        value = found[name]
        return {"array": name, "dtype": str(value.dtype), "shape": list(value.shape), "finite": False}

    old = about["reference"]
    if old is None:
        return {**state, "reference": None}, found
    model = None
    if old["surest"] is not None:
        regressions = []
        for i, p_floor in enumerate(old["surest"]):
            inputs, outputs = (np.asarray(found[f"tile{i}.{name}"]) for name in ("inputs", "outputs"))
            found[f"tile{i}.place"] = np.searchsorted(inputs, outputs)
            fields = {name: array(f"tile{i}.{name}") for name in (*_REGRESSION, "place")}
            regressions.append({**fields, "p_floor": p_floor})
        living = SensorLayout(
            *layout.shape, full_scale=layout.full_scale, unit=layout.unit, rate=layout.rate,
            present=layout.present & ~layout.grid(found["dead"] > 0),
        )  # fmt: skip
        stacking = None
        if old["rim"] is not None:
            stacking = {**{name: array(f"rim.{name}") for name in _STACKING}, "events": old["rim"]}
        model = {"local_regressions": regressions, "layout": living.to_dict(), "stacking": stacking}
    rates = {name: old[name] for name in ("blinks", "blinks_count", "noise_counts", "alone")}
    state["reference"] = {
        "tolerance": old["tolerance"],
        "scale": {"baseline": array("resting"), "near": old["near"], "full_scale": layout.full_scale},
        "jumps_seen": {"log_ratio": array("onsets")},
        "least": {"reading": array("least"), "usual": "-inf" if old["usual"] is None else old["usual"]},
        "noise_loss": {"longest": array("longest"), "recording": old["recording"]},
        "offset": dict(zip(("mostly", "most"), old["offset"], strict=True)),
        "patience": old["patience"],
        "usual": {**rates, "noise": array("noise")},
        "duplicates": old["twins"],
        "model": model,
        "dead": array("dead"),
    }
    return state, found
