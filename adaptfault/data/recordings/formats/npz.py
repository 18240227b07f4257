"""Reads and writes recordings as NumPy archives (.npz). Nothing is ever unpickled."""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.printable import printable
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.sizes import check_archive, check_array
from adaptfault.data.recordings.formats.datasets.axes import time_first
from adaptfault.data.recordings.formats.text import read_bytes, read_json_object, shown
from adaptfault.data.recordings.recording import (
    DECLARED,
    Block,
    Facts,
    Recording,
    Shape,
    cut,
    grid_shape,
)

SUFFIXES = (".npz",)

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
    "layout",
    "device",
)
_RATES = ("sampling_hz", "rate", "rate_hz", "rate_Hz")  # in the JSON file beside an archive
_BITS = re.compile(r"\s*(\d{1,2})[ -]?bits?\b", re.ASCII)

_SHOWN = 8  # arrays in a message

_EXPECTED = (
    "expected [n, T, pads, rows, cols], [n, T, rows, cols] (one pad) or [n, T, D], or one recording"
    " [T, D]"
)


def open(path: Path, *, shape: Shape | None = None, **stated: Any) -> list[Recording]:
    """Return the recordings of an archive.

    Its arrays: ``frames`` ``[n, T, pads, rows, cols]``, ``[n, T, rows, cols]`` (one pad) or
    ``[n, T, D]``; optional ``lengths`` ``[n]`` (frames after them are padding; or the frames of all
    recordings stand one behind the other, ``[sum of lengths, D]``), ``labels`` ``[n]`` (numbers or
    text), ``class_names``, ``names`` ``[n]``, ``present`` or ``factory_mask`` (bool
    ``[pads, rows, cols]``, True = a real cell), and the scalars ``full_scale``, ``rate``, ``unit``,
    ``device`` and ``layout`` (JSON as uint8, with ``wiring``, ``groups``, ``axes``, ``rest`` and
    ``device`` as in a layout file). A JSON file of the same stem may give ``class_names`` (or
    ``classes``), ``sampling_hz`` (or ``rate``), ``full_scale`` (a number, or "12 bit") and
    ``unit``; the archive itself takes precedence.

    Args:
        path: the archive.
        shape: ``(pads, rows, cols)`` where the user states it.
        stated: what other readers ask for.

    Raises:
        InputError: the file is damaged, or an array is missing, of a wrong kind or a wrong size.
    """
    _read.cache_clear()  # the file may have changed since
    archive = _read(path, shape)

    def blocks(i: int) -> Callable[[], Iterator[Block]]:
        return lambda: cut(_read(path, shape).frames[i])

    return [
        Recording(
            archive.facts,
            blocks(i),
            archive.names[i] if archive.names else None,
            None if archive.labels is None else archive.labels[i],
        )
        for i in range(len(archive.frames))
    ]


@dataclass(frozen=True, eq=False)
class _Archive:
    """The recordings of an archive, in memory."""

    facts: Facts
    frames: tuple[NDArray[Any], ...]
    names: tuple[str, ...]
    labels: tuple[str, ...] | None


@lru_cache(maxsize=1)
def _read(path: Path, given: Shape | None) -> _Archive:
    """Return the recordings of an archive; the last one stays in memory."""
    arrays = _open_archive(path)
    if "frames" not in arrays:
        what = f"holds no array 'frames'; {_others(path)}"
        raise InputError.at(path, f"{what}; save the recordings as frames=[n, T, pads, rows, cols]")
    beside, problems = _read_sibling(path)
    mask = arrays.get("present", arrays.get("factory_mask"))
    if (
        mask is not None
        and mask.ndim == 3
        and mask.shape[0] > 1
        and arrays["frames"].shape[1:] == mask.shape
    ):
        # one recording [T, pads, rows, cols]: the mask shows the pads
        arrays["frames"] = arrays["frames"][None]
    lengths = arrays.get("lengths")
    if lengths is None and (given is not None or arrays["frames"].ndim < 4):
        arrays["frames"], turned = time_first(path, "frames", arrays["frames"], given)
        problems = (*problems, *turned)
    frames, shape = as_recordings(
        path, arrays["frames"], lengths, given if lengths is None else None
    )
    present = _present(path, arrays, shape, int(frames[0].shape[1]) if frames else 0)
    shape = shape or (
        None if present is None else (present.shape[0], present.shape[1], present.shape[2])
    )
    class_names = _texts(path, arrays, "class_names") or _class_names_beside(path, beside)
    if len(set(class_names)) < len(class_names):
        raise InputError.at(path, "a class name occurs twice; give each class a name of its own")
    labels = _labels(path, arrays, class_names, len(frames))
    numbered = labels is not None and not class_names and arrays["labels"].dtype.kind in "iu"
    if numbered:
        class_names = tuple(str(i) for i in range(int(arrays["labels"].max()) + 1))
    names = _texts(path, arrays, "names")
    if names and len(names) != len(frames):
        raise InputError.at(
            path,
            f"array 'names' has {len(names)} entries for {len(frames)} recordings; give one each",
        )
    unit = (
        str(arrays["unit"].item())
        if "unit" in arrays and arrays["unit"].size == 1
        else _unit_beside(beside)
    )
    full_scale = _in_counts(beside.get("full_scale"))
    rate = next((beside[key] for key in _RATES if key in beside), None)
    for key, value in (("full_scale", full_scale), ("rate", rate)):
        if isinstance(value, str):
            what = f"{key} is {shown(value)}, no number: ignored"
            problems = (*problems, Problem("warning", located(path.with_suffix(".json"), what)))
    facts = Facts(
        path,
        counts=arrays["frames"].dtype.kind in "iu",
        class_names=class_names,
        numbered=numbered,
        shape=shape,
        present=present,
        full_scale=_scalar(path, arrays, "full_scale", full_scale),
        rate=_scalar(path, arrays, "rate", rate),
        unit=unit or None,
        declared=_declared(arrays.get("layout")) | _device(arrays.get("device")),
        stored=arrays["frames"].shape,
        problems=problems,
    )
    return _Archive(facts, frames, names, labels)


def _declared(layout: NDArray[Any] | None) -> dict[str, Any]:
    """Return what the archive declares of the wiring; an array of another kind declares nothing."""
    if layout is None or layout.dtype != np.uint8:
        return {}
    try:
        fields = json.loads(layout.tobytes())
    except (ValueError, RecursionError):
        return {}
    if not isinstance(fields, dict):
        return {}
    return {name: fields[name] for name in DECLARED if name in fields}


def _device(array: NDArray[Any] | None) -> dict[str, Any]:
    """Return the device that an archive states, if it does."""
    return {} if array is None or array.size != 1 else {"device": array.item()}


def save_npz(path: str | PathLike[str], recordings: Recordings) -> None:
    """Write recordings so that ``load`` gives the same back: frames padded with 0 to
    ``[n, T, pads, rows, cols]``.

    The file appears whole or not at all.

    Raises:
        InputError: the name does not end in .npz, or there is nothing to write.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError.at(
            path, "recordings are saved as NumPy archives; let the name end in .npz"
        )
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
    written = layout.to_dict()
    declared = {name: written[name] for name in DECLARED if name in written}
    if declared:
        arrays["layout"] = np.frombuffer(json.dumps(declared).encode(), np.uint8)
    if recordings.labels is not None:
        arrays |= {
            "labels": recordings.labels,
            "class_names": np.array(recordings.class_names, dtype=np.str_),
        }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    atomic_write(path, buffer.getvalue())


def open_numpy(path: Path) -> Any:
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
    # a damaged file raises any of a dozen kinds: zipfile's, zlib's, struct's, numpy's
    except Exception as error:
        raise _damaged(path, error) from None


def _open_archive(path: Path) -> dict[str, NDArray[Any]]:
    opened = open_numpy(path)
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


def _others(path: Path) -> str:
    """Return which arrays an archive holds."""
    with open_numpy(path) as archive:
        names = [printable(name) for name in archive.files[:_SHOWN]]
    more = ", ..." if len(archive.files) > _SHOWN else ""
    return f"it holds {', '.join(names)}{more}" if names else "it is empty"


def _damaged(path: Path, error: Exception, key: str = "") -> InputError:
    array = f"array {key!r} " if key else ""
    if "Object arrays" in str(error):
        what = (
            f"{array}holds Python objects; save numbers, or text as numpy.array(names, dtype=str)"
        )
    else:
        what = f"{array}is damaged or cut off ({type(error).__name__}); write the file again"
    return InputError.at(path, what)


def as_recordings(
    path: Path, frames: NDArray[Any], lengths: NDArray[Any] | None, given: Shape | None = None
) -> tuple[tuple[NDArray[Any], ...], Shape | None]:
    """Return one array ``[T, D]`` a recording, and ``(pads, rows, cols)`` where the frames have
    these axes.

    Args:
        path: the file, for messages.
        frames: the array in it.
        lengths: of the recordings, ``[n]``; None: they fill the array.
        given: ``(pads, rows, cols)`` where the user states it; it may tell that the array is one
            recording.

    Raises:
        InputError: an array of another kind or shape.
    """
    if frames.dtype.kind not in "iuf":
        raise InputError.at(
            path, f"frames are of type {frames.dtype}; save whole or decimal numbers"
        )
    if not 2 <= frames.ndim <= 5:
        raise InputError.at(path, f"frames have shape {list(frames.shape)}; {_EXPECTED}")
    if frames.size == 0:
        raise InputError.at(
            path, f"frames have shape {list(frames.shape)} and hold no reading; record again"
        )
    if frames.dtype.kind == "f":
        with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is missing
            frames = frames.astype(np.float32)
    if lengths is not None and _is_joined(frames, lengths):
        return _parted(frames, lengths), grid_shape((1, *frames.shape))
    shape = grid_shape(frames.shape, given)
    is_one = frames.ndim == 2 or (frames.ndim == 4 and frames.shape[1] == 1)
    if is_one or shape != grid_shape(frames.shape):
        frames = frames[None]
    frames = frames.reshape(*frames.shape[:2], -1)  # [n, T, D]
    if lengths is None:
        return tuple(frames), shape
    n, longest = frames.shape[:2]
    if lengths.dtype.kind not in "iu" or lengths.shape != (n,):
        what = (
            f"array 'lengths' is {lengths.dtype} {list(lengths.shape)}; expected whole numbers"
            f" [{n}], one a recording, or any number of them whose sum is that of all frames"
        )
        raise InputError.at(path, what)
    for i, length in enumerate(lengths.tolist()):
        if not 0 <= length <= longest:
            what = f"length {length}, but 'frames' has room for {longest}; correct 'lengths'"
            raise InputError.at(path, what, f"recording {i}")
    return tuple(one[:length] for one, length in zip(frames, lengths.tolist(), strict=True)), shape


def _is_joined(frames: NDArray[Any], lengths: NDArray[Any]) -> bool:
    """Return whether the frames of all recordings stand one behind the other."""
    if lengths.dtype.kind not in "iu" or lengths.ndim != 1 or (lengths < 0).any():
        return False
    is_padded = frames.ndim > 2 and len(lengths) == len(frames)
    return not is_padded and int(lengths.sum()) == len(frames)


def _parted(frames: NDArray[Any], lengths: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    flat = frames.reshape(len(frames), -1)
    return tuple(np.split(flat, np.cumsum(lengths)[:-1]))


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
        ()
        if expected is None
        else (expected, expected[1:] if expected[0] == 1 else expected, (math.prod(expected),))
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
            path,
            f"labels have shape {list(labels.shape)} for {n} recordings; give one label a"
            " recording",
        )
    if labels.dtype.kind in "US":
        names = _decoded(labels)
        for i, name in enumerate(names):
            if class_names and name not in class_names:
                raise InputError.at(
                    path, f"label {name!r} is not among the class names; add it", f"recording {i}"
                )
        return names
    highest = len(class_names) - 1 if class_names else 9999
    for i, label in enumerate(labels.tolist()):
        if not 0 <= label <= highest:
            known = f"the {len(class_names)} class names allow" if class_names else "labels are"
            raise InputError.at(
                path, f"label {label}; {known} 0 to {highest}: correct it", f"recording {i}"
            )
    return tuple(class_names[label] if class_names else str(label) for label in labels.tolist())


def _texts(path: Path, arrays: Mapping[str, NDArray[Any]], key: str) -> tuple[str, ...]:
    if key not in arrays:
        return ()
    if arrays[key].dtype.kind not in "US" or arrays[key].ndim != 1:
        what = (
            f"array {key!r} is {arrays[key].dtype} {list(arrays[key].shape)}; expected a list of"
            " text"
        )
        raise InputError.at(path, what)
    return _decoded(arrays[key])


def _decoded(array: NDArray[Any]) -> tuple[str, ...]:
    return tuple(
        text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
        for text in array.tolist()
    )


def _scalar(
    path: Path, arrays: Mapping[str, NDArray[Any]], key: str, beside: object
) -> float | None:
    """Return a positive number that the archive or else its JSON file gives."""
    value = (
        arrays[key].item() if key in arrays and arrays[key].size == 1 else arrays.get(key, beside)
    )
    if value is None or isinstance(value, str):
        return None
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not (math.isfinite(value) and value > 0)
    ):
        source = path if key in arrays else path.with_suffix(".json")
        raise InputError.at(source, f"{key} is {value!r}; expected one number above 0")
    return float(value)


def _read_sibling(path: Path) -> tuple[dict[str, Any], tuple[Problem, ...]]:
    """Return the JSON object beside an archive; a file that cannot be read is a warning, because it
    is optional."""
    beside = path.with_suffix(".json")
    if not beside.is_file():
        return {}, ()
    try:
        return read_json_object(beside), ()
    except InputError as error:
        return {}, (
            Problem("warning", f"{error}; ignored, class names and sampling rate may be missing"),
        )


def _in_counts(value: object) -> object:
    """Return the full scale of a converter that is described as "12 bit"; anything else as it
    is."""
    bits = _BITS.match(value) if isinstance(value, str) else None
    return value if bits is None else 2 ** int(bits[1]) - 1


def _class_names_beside(path: Path, beside: Mapping[str, Any]) -> tuple[str, ...]:
    names = beside.get("class_names", beside.get("classes", []))
    if not isinstance(names, list) or not all(isinstance(name, str | int) for name in names):
        raise InputError.at(
            path.with_suffix(".json"), "class_names: expected a list of text; correct it"
        )
    return tuple(str(name) for name in names)


def _unit_beside(beside: Mapping[str, Any]) -> str | None:
    """Return the unit of a JSON file, if it is one word: longer text describes more than a unit."""
    unit = beside.get("unit", beside.get("units"))
    return unit if isinstance(unit, str) and len(unit.split()) == 1 and len(unit) <= 16 else None
