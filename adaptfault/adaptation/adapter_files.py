"""The adapter on disk, small enough for a robot: weights and quantised fault-free windows. No
pickle."""

from __future__ import annotations

import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from adaptfault.adaptation.adapter import Adapter
from adaptfault.data.windows import CONVERTER_STEP, Windows, evenly
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.models.any_model import network_from_config
from adaptfault.models.network import tensors_of
from adaptfault.models.store import Place, check_rebuildable, load_tensors, save_tensors, undamaged

SCHEMA = "adaptfault.adapter/1"
WINDOWS_SCHEMA = "adaptfault.windows/1"
LIMIT = 20_000_000  # bytes of an adapter, unless its network alone is larger

_SHARE = 0.5  # of the limit: the most that windows take
_MOST_STEPS = 65_535
_COARSEST = 1e-3  # largest error of a 16-bit float, in units of the largest of its tensor
_EXTRA = "extra."  # before the name of what a policy sees beside touch
_OVERHEAD = 100_000  # bytes for names, labels and JSON


def save_adapter(path: Place, adapter: Adapter, *, limit: int | None = None) -> None:
    """Write everything an adaptation needs into a folder of at most ``limit`` bytes.

    Without a limit these are 20,000,000 bytes, or what a network of a large array needs with 8-bit
    weights and as many bytes of windows.

    Readings that are whole converter steps are stored exactly, others with 12 bits. The values of a
    regression are stored exactly. Windows that need more than half of the limit are thinned
    evenly. The weights use the first format that fits
    the rest: 32-bit floats, 16-bit floats, or 8-bit integers with a scale for each row.
    ``manifest.json`` records the choices.

    Raises:
        ValueError: the smallest format does not fit, or the model can not be rebuilt (a module
            without builder).
    """
    check_rebuildable(adapter.model.config)
    statistics = adapter.statistics
    upper = np.triu_indices(len(statistics.mean))
    tensors: dict[str, Tensor] = {
        "statistics.mean": torch.from_numpy(statistics.mean),
        "statistics.covariance": torch.from_numpy(statistics.covariance[upper].astype(np.float32)),
    }
    if limit is None:
        weights_only = _bytes(_eighth(adapter.model.state_dict()))
        limit = max(LIMIT, _OVERHEAD + _bytes(tensors) + int(weights_only / (1 - _SHARE)) + 1)
    room = limit - _OVERHEAD - _bytes(tensors)
    about: dict[str, Any] = {"network": adapter.model.config, "task": adapter.task}
    parts = {
        "train": (adapter.train, adapter.targets),
        "validation": (adapter.validation, adapter.validation_targets),
    }
    values = adapter.task == "regression"  # y has them
    n = sum(len(windows) for windows, _ in parts.values())
    for name, (windows, targets) in parts.items():
        packed, packing = _pack_thinned(
            windows, None if values else targets, int(_SHARE * room * len(windows) / n)
        )
        tensors |= {f"{name}.{key}": value for key, value in packed.items()}
        about[name] = packing
    room = limit - _OVERHEAD - _bytes(tensors)
    choices = {"float32": _whole, "float16": _half, "int8": _eighth}
    for about["weights_as"], shrink in choices.items():
        weights = shrink(adapter.model.state_dict())
        if _bytes(weights) <= room:
            break
    else:
        raise ValueError(
            f"the adapter does not fit into {limit:,} bytes: the weights alone take"
            f" {_bytes(weights):,} of 8 bits; raise limit"
        )
    save_tensors(path, SCHEMA, about, {**tensors, **{f"model.{k}": v for k, v in weights.items()}})


def save_windows(path: Place, windows: Windows, *, limit: int = LIMIT // 4) -> None:
    """Write windows into a folder as :func:`save_adapter` does, thinned evenly to ``limit``
    bytes."""
    packed, packing = _pack_thinned(windows, None, limit)
    save_tensors(
        path,
        WINDOWS_SCHEMA,
        {"windows": packing},
        {f"windows.{key}": value for key, value in packed.items()},
    )


def load_windows(path: Place) -> Windows:
    """Read windows written by :func:`save_windows`; raises the errors of :func:`load_adapter`."""
    about, tensors = load_tensors(path, WINDOWS_SCHEMA)
    with undamaged("windows", path):
        return _unpack(about["windows"], tensors, "windows")


def load_adapter(path: Place) -> Adapter:
    """Read an adapter written by :func:`save_adapter`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged or of another kind.
    """
    about, tensors = load_tensors(path, SCHEMA)
    with undamaged("adapter", path):
        model = network_from_config(about["network"])
        model.load_state_dict(
            _restore({k.removeprefix("model."): v for k, v in tensors.items() if k[:6] == "model."})
        )
        task = about.get("task", "classification")
        parts = [_unpack(about[name], tensors, name) for name in ("train", "validation")]
        if task == "regression":  # actions are stored as values
            shape = getattr(model, "shape", (model.n_classes,))
            parts = [replace(part, y=part.y.reshape(-1, *shape)) for part in parts]
        adapter = Adapter(model.eval(), *parts, task=task)
        if task == "classification":
            adapter.targets = tensors["train.targets"].float().numpy()
            adapter.validation_targets = tensors["validation.targets"].float().numpy()
        d = model.layout.n_cells
        covariance = np.zeros((d, d))
        covariance[np.triu_indices(d)] = tensors["statistics.covariance"].numpy()
        covariance = np.triu(covariance) + np.triu(covariance, 1).T
        frames = CellStatistics.reference(adapter.train)
        adapter.statistics = CellStatistics(tensors["statistics.mean"].numpy(), covariance, frames)
    return adapter


def load_recordings(path: Place) -> list[NDArray[np.float32]] | None:
    """Return the recordings of the windows that :func:`save_adapter` wrote, ``[T, D]`` each on the
    0..1 scale: the windows of each, one behind the other; None: some windows were left out.

    Raises:
        FileNotFoundError, ValueError: as :func:`load_adapter`.
    """
    about, tensors = load_tensors(path, SCHEMA)
    found = []
    for name in ("train", "validation"):
        windows = _unpack(about[name], tensors, name)
        if len(windows) < about[name].get("of", len(windows)):
            return None
        numbers = np.unique(windows.recording)
        found += [np.concatenate(windows.x[windows.recording == i]) for i in numbers]
    return found


def _bytes(tensors: dict[str, Tensor]) -> int:
    return sum(t.numel() * t.element_size() for t in tensors.values())


def _pack_thinned(
    windows: Windows, targets: NDArray[Any] | None, room: int
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Pack as many windows as fit; return them and the packing parameters."""
    keep = len(windows)
    while True:
        which = evenly(len(windows), keep)
        packed, packing = _pack(windows.select(which), None if targets is None else targets[which])
        if (size := _bytes(packed)) <= room or keep == 1:
            return packed, {**packing, "of": len(windows)}
        keep = max(1, min(keep - 1, int(keep * room / size)))


def _pack(
    windows: Windows, targets: NDArray[Any] | None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    low, step = _steps(windows.x)
    counts = np.rint((windows.x.astype(np.float64) - low) / step).astype(np.uint16)
    # Differences between frames and then all low bytes before all high ones: mostly zeros, which
    # deflate well.
    counts[:, 1:] -= counts[:, :-1].copy()  # modulo 2^16, undone by a cumulative sum modulo 2^16
    data = zlib.compress(counts.view(np.uint8).reshape(-1, 2).T.tobytes(), 6)
    packed = {
        "x": torch.frombuffer(bytearray(data), dtype=torch.uint8),
        "y": torch.from_numpy(windows.y),
        "recording": torch.from_numpy(windows.recording),
    }
    packed |= {f"{_EXTRA}{name}": of for name, of in tensors_of(windows.extra).items()}
    if targets is not None:
        packed["targets"] = torch.from_numpy(targets).half()
    return packed, {"shape": list(windows.x.shape), "low": low, "step": step}


def _unpack(packing: dict[str, Any], tensors: dict[str, Tensor], name: str) -> Windows:
    n, t, d = packing["shape"]
    size = 2 * n * t * d
    # at most the expected size
    data = zlib.decompressobj().decompress(tensors[f"{name}.x"].numpy().tobytes(), size)
    counts = np.frombuffer(data, np.uint8).reshape(2, -1).T.copy().view(np.uint16).reshape(n, t, d)
    counts = np.cumsum(counts, axis=1, dtype=np.uint16)
    x = (packing["low"] + counts * packing["step"]).astype(np.float32)
    others = f"{name}.{_EXTRA}"
    extra = {
        key.removeprefix(others): of.numpy()
        for key, of in tensors.items()
        if key.startswith(others)
    }
    y = tensors[f"{name}.y"].numpy()
    return Windows(x, y, tensors[f"{name}.recording"].numpy(), extra)


def _steps(x: NDArray[np.float32]) -> tuple[float, float]:
    """Return the lowest reading and the converter step, or a 12-bit step if the readings show
    none."""
    values = np.unique(x).astype(np.float64)
    low = float(values[0])
    width = float(values[-1] - values[0])
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-6]  # below that, single precision
    if not len(gaps):
        return low, 1.0
    steps = max(1, round(width / gaps.min()))
    if steps <= _MOST_STEPS:
        step = width / steps
        off = (values - low) / step
        if np.abs(off - np.rint(off)).max() < 0.01:
            return low, step
    return low, max(CONVERTER_STEP, width / _MOST_STEPS)


def _whole(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return dict(state)


def _half(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: _short(tensor) for name, tensor in state.items()}


def _short(tensor: Tensor) -> Tensor:
    """Return a tensor as 16-bit floats; as it is where they are too coarse or too small for it."""
    half = tensor.half()
    error = (half.to(tensor.dtype) - tensor).abs()
    # not true where a value became infinite
    fits = bool((error <= _COARSEST * tensor.abs().amax()).all()) if tensor.numel() else True
    return half if fits else tensor


def _eighth(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return matrices as int8 with a scale for each row, the rest as :func:`_half`."""
    small: dict[str, Tensor] = {}
    for name, tensor in state.items():
        if tensor.dim() < 2:
            small[name] = _short(tensor)
            continue
        rows = tensor.flatten(1)
        scale = (rows.abs().amax(1, keepdim=True) / 127).clamp_min(torch.finfo(torch.float32).tiny)
        small[name] = (rows / scale).round().to(torch.int8).view_as(tensor)
        small[f"{name}{_SCALE}"] = scale.flatten()
    return small


_SCALE = ":scale"


def _restore(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Undo :func:`_half` or :func:`_eighth`, up to rounding."""
    whole = {}
    for name, tensor in state.items():
        if name.endswith(_SCALE):
            continue
        scale = state.get(name + _SCALE)
        whole[name] = (
            tensor.float() if scale is None else tensor * scale.view(-1, *[1] * (tensor.dim() - 1))
        )
    return whole
