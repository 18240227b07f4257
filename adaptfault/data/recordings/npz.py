"""Reads and writes recordings as NumPy archives (.npz), and reads single arrays (.npy). Nothing is ever unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.content import Content, Shape, grid_shape
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.sizes import check_archive, check_array
from adaptfault.data.recordings.text import read_bytes, read_json_object

_KEYS = (
    "frames",
    "lengths",
    "labels",
    "class_names",
    "names",
    "present",
    "factory_mask",
    "full_scale",
    "rate",
    "unit",
)
_EXPECTED = "expected [n, T, pads, rows, cols], [n, T, rows, cols] (one pad) or [n, T, D], or one recording [T, D]"


def read_npz(path: Path) -> Content:
    """Read an archive of recordings.

    Its arrays: ``frames`` ``[n, T, pads, rows, cols]``, ``[n, T, rows, cols]`` (one pad) or ``[n, T, D]``; optional
    ``lengths`` ``[n]`` (frames after them are padding), ``labels`` ``[n]`` (numbers or text), ``class_names``,
    ``names`` ``[n]``, ``present`` or ``factory_mask`` (bool ``[pads, rows, cols]``, True = a real cell), and the
    scalars ``full_scale``, ``rate``, ``unit``. A JSON file of the same stem may give ``class_names``, ``sampling_hz``
    (or ``rate``), ``full_scale`` and ``unit``; the archive itself takes precedence.

    Raises:
        InputError: the file is damaged, or an array is missing, of a wrong kind or a wrong size.
    """
    arrays = _open_archive(path)
    if "frames" not in arrays:
        raise InputError.at(path, "holds no array 'frames'; save the recordings as frames=[n, T, pads, rows, cols]")
    beside, problems = _read_sibling(path)
    mask = arrays.get("present", arrays.get("factory_mask"))
    if mask is not None and mask.ndim == 3 and mask.shape[0] > 1 and arrays["frames"].shape[1:] == mask.shape:
        arrays["frames"] = arrays["frames"][None]  # one recording [T, pads, rows, cols]: the mask shows the pads
    frames, shape = _recordings(path, arrays["frames"], arrays.get("lengths"))
    present = _present(path, arrays, shape, int(frames[0].shape[1]) if frames else 0)
    shape = shape or (None if present is None else (present.shape[0], present.shape[1], present.shape[2]))
    class_names = _texts(path, arrays, "class_names") or _class_names_beside(path, beside)
    if len(set(class_names)) < len(class_names):
        raise InputError.at(path, "a class name occurs twice; give each class a name of its own")
    labels = _labels(path, arrays, class_names, len(frames))
    numbered = labels is not None and not class_names and arrays["labels"].dtype.kind in "iu"
    if numbered:
        class_names = tuple(str(i) for i in range(int(arrays["labels"].max()) + 1))
    names = _texts(path, arrays, "names")
    if names and len(names) != len(frames):
        raise InputError.at(path, f"array 'names' has {len(names)} entries for {len(frames)} recordings; give one each")
    unit = str(arrays["unit"].item()) if "unit" in arrays and arrays["unit"].size == 1 else _unit_beside(beside)
    return Content(
        path,
        frames,
        counts=arrays["frames"].dtype.kind in "iu",
        labels=labels,
        class_names=class_names,
        numbered=numbered,
        names=names or None,
        shape=shape,
        present=present,
        full_scale=_scalar(path, arrays, "full_scale", beside.get("full_scale")),
        rate=_scalar(path, arrays, "rate", beside.get("sampling_hz", beside.get("rate"))),
        unit=unit or None,
        stored=arrays["frames"].shape,
        problems=problems,
    )


def read_npy(path: Path) -> Content:
    """Read one array with the axes of ``frames`` in :func:`read_npz`, or one recording ``[T, D]``.

    Raises:
        InputError: the file is damaged, or the array is of another kind or shape.
    """
    array = _open(path)
    if isinstance(array, NpzFile):
        array.close()
        raise InputError.at(path, "is an archive; name it .npz")
    frames, shape = _recordings(path, array, None)
    return Content(path, frames, counts=array.dtype.kind in "iu", shape=shape, stored=array.shape)


def save_npz(path: str | PathLike[str], recordings: Recordings) -> None:
    """Write recordings so that ``load`` gives the same back: frames padded with 0 to ``[n, T, pads, rows, cols]``.

    The file appears whole or not at all.

    Raises:
        InputError: the name does not end in .npz, or there is nothing to write.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError.at(path, "recordings are saved as NumPy archives; let the name end in .npz")
    if not len(recordings):
        raise InputError.at(path, "there are no recordings to save; give at least one")
    layout = recordings.layout
    lengths = np.array([len(frames) for frames in recordings], dtype=np.int64)
    padded = np.zeros((len(recordings), int(lengths.max()), layout.n_cells), dtype=np.float32)
    for i, frames in enumerate(recordings):
        padded[i, : len(frames)] = frames
    arrays: dict[str, NDArray[Any]] = {
        "frames": padded.reshape(*padded.shape[:2], *layout.shape),
        "lengths": lengths,
        "names": np.array(recordings.names, dtype=np.str_),
        "present": np.asarray(layout.present),
        "full_scale": np.array(layout.full_scale),
        "rate": np.array(layout.rate),
        "unit": np.array(layout.unit),
    }
    if recordings.labels is not None:
        arrays |= {"labels": recordings.labels, "class_names": np.array(recordings.class_names, dtype=np.str_)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    atomic_write(path, buffer.getvalue())


def _open(path: Path) -> Any:
    """Return the result of np.load for a file that exists and is not empty."""
    data = read_bytes(path)
    if not data.startswith((b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY")):
        raise InputError.at(path, "is no NumPy file; write it again with numpy.savez or numpy.save")
    try:
        if data.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                check_archive(path, archive, _KEYS)
        else:
            check_array(path, data)
        return np.load(io.BytesIO(data), allow_pickle=False)
    except InputError:
        raise
    except Exception as error:  # a damaged file raises any of a dozen kinds: zipfile's, zlib's, struct's, numpy's
        raise _damaged(path, error) from None


def _open_archive(path: Path) -> dict[str, NDArray[Any]]:
    opened = _open(path)
    if not isinstance(opened, NpzFile):
        raise InputError.at(path, "is a single array; name it .npy")
    arrays = {}
    with opened as archive:
        for key in _KEYS:
            if key not in archive.files:
                continue
            try:
                arrays[key] = np.asarray(archive[key])
            except Exception as error:  # as above
                raise _damaged(path, error, key) from None
    return arrays


def _damaged(path: Path, error: Exception, key: str = "") -> InputError:
    array = f"array {key!r} " if key else ""
    if "Object arrays" in str(error):
        what = f"{array}holds Python objects; save numbers, or text as numpy.array(names, dtype=str)"
    else:
        what = f"{array}is damaged or cut off ({type(error).__name__}); write the file again"
    return InputError.at(path, what)


def _recordings(
    path: Path, frames: NDArray[Any], lengths: NDArray[Any] | None
) -> tuple[tuple[NDArray[Any], ...], Shape | None]:
    """Return one array ``[T, D]`` a recording, and ``(pads, rows, cols)`` where the frames have these axes."""
    if frames.dtype.kind not in "iuf":
        raise InputError.at(path, f"frames are of type {frames.dtype}; save whole or decimal numbers")
    if not 2 <= frames.ndim <= 5:
        raise InputError.at(path, f"frames have shape {list(frames.shape)}; {_EXPECTED}")
    if frames.size == 0:
        raise InputError.at(path, f"frames have shape {list(frames.shape)} and hold no reading; record again")
    shape = grid_shape(frames.shape)
    if frames.dtype.kind == "f":
        with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is missing
            frames = frames.astype(np.float32)
    if frames.ndim == 2 or (frames.ndim == 4 and frames.shape[1] == 1):
        frames = frames[None]
    frames = frames.reshape(*frames.shape[:2], -1)  # [n, T, D]
    if lengths is None:
        return tuple(frames), shape
    n, longest = frames.shape[:2]
    if lengths.dtype.kind not in "iu" or lengths.shape != (n,):
        what = (
            f"array 'lengths' is {lengths.dtype} {list(lengths.shape)}; expected whole numbers [{n}], one a recording"
        )
        raise InputError.at(path, what)
    for i, length in enumerate(lengths.tolist()):
        if not 0 <= length <= longest:
            what = f"length {length}, but 'frames' has room for {longest}; correct 'lengths'"
            raise InputError.at(path, what, f"recording {i}")
    return tuple(one[:length] for one, length in zip(frames, lengths.tolist(), strict=True)), shape


def _present(
    path: Path, arrays: Mapping[str, NDArray[Any]], shape: Shape | None, width: int
) -> NDArray[np.bool_] | None:
    key = next((key for key in ("present", "factory_mask") if key in arrays), None)
    if key is None:
        return None
    present = arrays[key]
    expected = shape or (present.shape if present.ndim == 3 and present.size == width else None)
    # In another order of axes the mask would name other cells.
    fitting = (
        () if expected is None else (expected, expected[1:] if expected[0] == 1 else expected, (math.prod(expected),))
    )
    if present.dtype.kind not in "biu" or expected is None or present.shape not in fitting:
        size = list(expected) if expected else "[pads, rows, cols]"
        what = f"array {key!r} is {present.dtype} {list(present.shape)}; expected bool {size}"
        raise InputError.at(path, what)
    present = present.astype(bool).reshape(expected)
    if not present.any():
        raise InputError.at(path, f"array {key!r} is False everywhere; True marks a real cell")
    return present


def _labels(
    path: Path, arrays: Mapping[str, NDArray[Any]], class_names: tuple[str, ...], n: int
) -> tuple[str, ...] | None:
    """Return the class name of each recording."""
    if "labels" not in arrays:
        return None
    labels = arrays["labels"]
    if labels.dtype.kind not in "iuUS":
        raise InputError.at(path, f"labels are of type {labels.dtype}; save whole numbers or text")
    if labels.shape != (n,):
        raise InputError.at(
            path, f"labels have shape {list(labels.shape)} for {n} recordings; give one label a recording"
        )
    if labels.dtype.kind in "US":
        names = _decoded(labels)
        for i, name in enumerate(names):
            if class_names and name not in class_names:
                raise InputError.at(path, f"label {name!r} is not among the class names; add it", f"recording {i}")
        return names
    highest = len(class_names) - 1 if class_names else 9999
    for i, label in enumerate(labels.tolist()):
        if not 0 <= label <= highest:
            known = f"the {len(class_names)} class names allow" if class_names else "labels are"
            raise InputError.at(path, f"label {label}; {known} 0 to {highest}: correct it", f"recording {i}")
    return tuple(class_names[label] if class_names else str(label) for label in labels.tolist())


def _texts(path: Path, arrays: Mapping[str, NDArray[Any]], key: str) -> tuple[str, ...]:
    if key not in arrays:
        return ()
    if arrays[key].dtype.kind not in "US" or arrays[key].ndim != 1:
        what = f"array {key!r} is {arrays[key].dtype} {list(arrays[key].shape)}; expected a list of text"
        raise InputError.at(path, what)
    return _decoded(arrays[key])


def _decoded(array: NDArray[Any]) -> tuple[str, ...]:
    return tuple(text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in array.tolist())


def _scalar(path: Path, arrays: Mapping[str, NDArray[Any]], key: str, beside: object) -> float | None:
    """Return a positive number that the archive or else its JSON file gives."""
    value = arrays[key].item() if key in arrays and arrays[key].size == 1 else arrays.get(key, beside)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        source = path if key in arrays else path.with_suffix(".json")
        raise InputError.at(source, f"{key} is {value!r}; expected one number above 0")
    return float(value)


def _read_sibling(path: Path) -> tuple[dict[str, Any], tuple[Problem, ...]]:
    """Return the JSON object beside an archive; a file that cannot be read is a warning, because it is optional."""
    beside = path.with_suffix(".json")
    if not beside.is_file():
        return {}, ()
    try:
        return read_json_object(beside), ()
    except InputError as error:
        return {}, (Problem("warning", f"{error}; ignored, class names and sampling rate may be missing"),)


def _class_names_beside(path: Path, beside: Mapping[str, Any]) -> tuple[str, ...]:
    names = beside.get("class_names", [])
    if not isinstance(names, list) or not all(isinstance(name, str | int) for name in names):
        raise InputError.at(path.with_suffix(".json"), "class_names: expected a list of text; correct it")
    return tuple(str(name) for name in names)


def _unit_beside(beside: Mapping[str, Any]) -> str | None:
    """Return the unit of a JSON file, if it is one word: longer text describes more than a unit."""
    unit = beside.get("unit", beside.get("units"))
    return unit if isinstance(unit, str) and len(unit.split()) == 1 and len(unit) <= 16 else None
