"""Reads and writes recordings as NumPy archives (.npz). Nothing is ever unpickled."""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.printable import printable
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.roles import SCAN
from adaptfault.data.recordings.facts.sizes import check_archive, check_array
from adaptfault.data.recordings.formats.datasets.beside import Stated
from adaptfault.data.recordings.formats.datasets.contents import Contents, Opened, texts
from adaptfault.data.recordings.formats.datasets.features import Pads
from adaptfault.data.recordings.formats.datasets.reader import recordings_of
from adaptfault.data.recordings.formats.text import read_bytes, read_json_object, shown
from adaptfault.data.recordings.recording import DECLARED, Facts, Recording, Shape
from adaptfault.data.recordings.scans import levels_of, with_levels

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
    "scan",
)
_RATES = ("sampling_hz", "rate", "rate_hz", "rate_Hz")  # in the JSON file beside an archive
_BITS = re.compile(r"\s*(\d{1,2})[ -]?bits?\b", re.ASCII)

_FRAMES = "frames"
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

    An array ``scan`` says which frames are of a scan of the read-out
    (:mod:`adaptfault.data.recordings.scans`).

    Args:
        path: the archive.
        shape: ``(pads, rows, cols)`` where the user states it.
        stated: what other readers ask for.

    Raises:
        InputError: the file is damaged, or an array is missing, of a wrong kind or a wrong size.
    """
    _arrays.cache_clear()  # the file may have changed since
    arrays = _arrays(path)
    recordings = array_recordings(path, partial(_opened, path), shape)
    facts = recordings[0].facts
    beside, problems = _read_sibling(path)
    class_names = _texts(path, arrays, "class_names") or _class_names_beside(path, beside)
    if len(set(class_names)) < len(class_names):
        raise InputError.at(path, "a class name occurs twice; give each class a name of its own")
    labels = _labels(path, arrays, class_names, len(recordings))
    numbered = labels is not None and not class_names and arrays["labels"].dtype.kind in "iu"
    if numbered:
        class_names = tuple(str(i) for i in range(int(arrays["labels"].max()) + 1))
    names = _texts(path, arrays, "names") or [None] * len(recordings)
    if len(names) != len(recordings):
        what = f"array 'names' has {len(names)} entries for {len(recordings)} recordings"
        raise InputError.at(path, f"{what}; give one each")
    present = _present(path, arrays, facts)
    facts = replace(
        facts,
        class_names=class_names,
        numbered=numbered,
        shape=facts.shape if present is None else present.shape,
        present=present,
        full_scale=_scalar(path, arrays, "full_scale", beside),
        rate=_scalar(path, arrays, "rate", beside),
        unit=_unit(arrays, beside),
        declared=_declared(arrays.get("layout")) | _device(arrays.get("device")),
        problems=(*problems, *facts.problems),
    )
    classes = labels or [None] * len(recordings)
    each = zip(recordings, names, classes, strict=True)
    found = [replace(one, facts=facts, name=name, label=label) for one, name, label in each]
    return _with_scan(path, arrays, found)


def _with_scan(
    path: Path, arrays: Mapping[str, NDArray[Any]], recordings: list[Recording]
) -> list[Recording]:
    """Return the recordings with the levels of their frames, where the archive has an array
    ``scan``: ``[n, T]``, or ``[T]`` or ``[sum of lengths]``, NaN where a frame is a reading."""
    if SCAN not in arrays:
        return recordings
    scan = arrays[SCAN]
    frames = arrays[_FRAMES]
    stacked = scan.ndim == 2 and scan.shape == frames.shape[:2]
    if scan.dtype.kind not in "iuf" or not (stacked or scan.shape == frames.shape[:1]):
        what = f"array 'scan' is {scan.dtype} {list(scan.shape)}; expected one number a frame"
        raise InputError.at(path, f"{what} of {list(frames.shape)}, NaN where it is a reading")
    lengths = arrays["lengths"].tolist() if "lengths" in arrays else None
    levels = scan.astype(np.float64)
    return [with_levels(one, levels_of(levels, lengths, i)) for i, one in enumerate(recordings)]


def array_recordings(path: Path, opened: Opened, shape: Shape | None) -> list[Recording]:
    """Return the recordings of an array ``frames``; it has no name that a mask could be called by,
    and the shape that its axes show."""
    found = recordings_of(path, opened, shape=shape, key=_FRAMES, stated=Stated())
    facts = found[0].facts
    facts = replace(facts, shape=Pads.of(facts.sizes).shape)
    return [replace(one, facts=facts, arrays=()) for one in found]


def frames_of(path: Path, frames: Any) -> Contents:
    """Return an array ``frames`` as the contents of a file.

    Raises:
        InputError: an array of another kind or shape.
    """
    shape = list(frames.shape)
    if frames.dtype.kind not in "iuf":
        what = f"frames are of type {frames.dtype}; save whole or decimal numbers"
        raise InputError.at(path, what)
    if not 2 <= len(shape) <= 5:
        raise InputError.at(path, f"frames have shape {shape}; {_EXPECTED}")
    if 0 in shape:
        what = f"frames have shape {shape} and hold no reading; record again"
        raise InputError.at(path, what)
    return Contents({_FRAMES: frames})


@contextmanager
def _opened(path: Path, names: Sequence[str] | None) -> Iterator[Contents]:
    """Open what divides an archive into recordings."""
    arrays = _arrays(path)
    if _FRAMES not in arrays:
        what = f"holds no array 'frames'; {_others(path)}"
        raise InputError.at(path, f"{what}; save the recordings as frames=[n, T, pads, rows, cols]")
    frames = arrays[_FRAMES]
    mask = arrays.get("present", arrays.get("factory_mask"))
    if mask is not None and mask.ndim == 3 and frames.shape[1:] == mask.shape and len(mask) > 1:
        frames = frames[None]  # one recording [T, pads, rows, cols]: the mask shows the pads
    contents = frames_of(path, frames)
    if "lengths" in arrays:
        contents.arrays["lengths"] = arrays["lengths"]
    yield contents


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


@lru_cache(maxsize=1)
def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive; those of the last one stay in memory."""
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


def _present(
    path: Path, arrays: Mapping[str, NDArray[Any]], facts: Facts
) -> NDArray[np.bool_] | None:
    key = next((key for key in ("present", "factory_mask") if key in arrays), None)
    if key is None:
        return None
    present = arrays[key]
    expected = facts.shape
    if expected is None and present.ndim == 3 and present.size == math.prod(facts.sizes[0]):
        expected = present.shape
    # In another order of axes the mask would name other cells.
    fitting: tuple[tuple[int, ...], ...] = ()
    if expected is not None:
        flat = (math.prod(expected),)
        fitting = (expected, expected[1:] if expected[0] == 1 else expected, flat)
    if present.dtype.kind not in "biu" or present.shape not in fitting:
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
        names = tuple(texts(labels))
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
    return tuple(texts(arrays[key]))


def _scalar(
    path: Path, arrays: Mapping[str, NDArray[Any]], key: str, beside: Mapping[str, Any]
) -> float | None:
    """Return a positive number that the archive or else its JSON file gives."""
    value = arrays.get(key, beside.get(key))
    if key in arrays and arrays[key].size == 1:
        value = arrays[key].item()
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


def _read_sibling(path: Path) -> tuple[dict[str, Any], list[Problem]]:
    """Return the JSON object beside an archive, with ``rate`` under this name; a file that cannot
    be read is a warning, because it is optional, and so is a number that is none."""
    path = path.with_suffix(".json")
    if not path.is_file():
        return {}, []
    try:
        beside = read_json_object(path)
    except InputError as error:
        what = f"{error}; ignored, class names and sampling rate may be missing"
        return {}, [Problem("warning", what)]
    beside["full_scale"] = _in_counts(beside.get("full_scale"))
    beside["rate"] = next((beside[key] for key in _RATES if key in beside), None)
    return beside, [
        Problem.warning(path, f"{key} is {shown(beside[key])}, no number: ignored")
        for key in ("full_scale", "rate")
        if isinstance(beside[key], str)
    ]


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


def _unit(arrays: Mapping[str, NDArray[Any]], beside: Mapping[str, Any]) -> str | None:
    """Return the unit of an archive, or else of its JSON file, if it is one word: longer text
    describes more than a unit."""
    if "unit" in arrays and arrays["unit"].size == 1:
        return str(arrays["unit"].item()) or None
    unit = beside.get("unit", beside.get("units"))
    return unit if isinstance(unit, str) and len(unit.split()) == 1 and len(unit) <= 16 else None
