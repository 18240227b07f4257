"""Reads HDF5 files (ACT, robomimic, laboratories), netCDF 4 and MAT files of version 7.3; needs the
extra "datasets".

What lies in another file is not read: an external link, a virtual array or external storage could
bring any file of the computer among the readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, foreseeing
from adaptfault.data.recordings.facts.declared import too_large, too_much
from adaptfault.data.recordings.formats.datasets import netcdf
from adaptfault.data.recordings.formats.datasets.contents import Contents, element
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import VALID
from adaptfault.data.recordings.formats.datasets.never_written import Written
from adaptfault.data.recordings.formats.datasets.reader import reader

SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4", ".cdf")

_MATLAB = "MATLAB_class"  # attribute of every array that MATLAB wrote
_EMPTY = "MATLAB_empty"  # attribute of one that stores its sizes, because it holds nothing
_HIDDEN = "#"  # begins the names of MATLAB's own groups


@contextmanager
def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
    """Open a file for reading; ``names``: of the arrays that are wanted, None: all it holds.

    Raises:
        InputError: h5py is not installed, the file is damaged or being written.
    """
    if netcdf.is_classic(path):
        with netcdf.opened(path, names) as contents:
            yield contents
        return
    h5py = imported("h5py", path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError.at(path, _unreadable(str(error))) from None
    with file:
        contents = Contents()
        if names is not None:
            for name in names:
                if not name.endswith(VALID) or name in file:  # others come with their arrays
                    _add_array(contents, name, _found(file, name))
        else:
            with foreseeing(path, "is damaged ({}); copy it again"):
                contents.attributes[""] = dict(file.attrs)
                _collect(file, contents)
        yield contents


open = reader(opened)


def _collect(file: Any, contents: Contents) -> None:
    """Take in all groups and arrays of a file, each group once: links may lead in circles."""
    h5py = imported("h5py", file.filename)
    groups = [("", file)]
    seen = set()
    while groups:
        above, group = groups.pop()
        place = h5py.h5o.get_info(group.id).addr
        if place in seen:
            continue
        seen.add(place)
        for last in group:
            name = f"{above}/{last}" if above else last
            link = group.get(last, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                what = f"is a link into another file, {link.filename}; copy what it leads to into"
                contents.left_out[name] = f"{what} one, with h5copy"
            elif isinstance(link, h5py.HardLink) and not last.startswith(_HIDDEN):
                found = group[last]
                if isinstance(found, h5py.Group):
                    contents.note(name, dict(found.attrs))
                    groups.append((name, found))
                elif isinstance(found, h5py.Dataset):
                    _collect_array(h5py, file, contents, name, found)


def _collect_array(h5py: Any, file: Any, contents: Contents, name: str, found: Any) -> None:
    """Take in an array, or why it is not read."""
    why = _refused(found)
    is_list = h5py.check_vlen_dtype(found.dtype) is not None
    if why is not None:
        contents.left_out[name] = why
    elif h5py.check_ref_dtype(found.dtype) is not None:
        _add_cells(file, contents, name, found)
    elif is_list and h5py.check_string_dtype(found.dtype) is None:
        contents.left_out[name] = "holds a list a frame; save all frames as one array"
    elif found.shape is not None:
        _add(contents, name, found, dict(found.attrs))


def _add(contents: Contents, name: str, found: Any, attributes: dict[str, Any]) -> None:
    text = _matlab_text(found)
    if text is not None:
        contents.add(name, np.array(text))
    elif _EMPTY in attributes:
        contents.add(name, np.zeros(tuple(map(int, found[:].ravel()[::-1]))))
    else:
        _add_array(contents, name, found, attributes)


def _add_array(
    contents: Contents, name: str, found: Any, attributes: dict[str, Any] | None = None
) -> None:
    """Take in an array, and which of its readings were written; a mask of the file says more."""
    contents.add(name, _array(found), attributes)
    written = Written.of(found)
    if written is not None:
        contents.valid.setdefault(name, _as_seen(found, written))
        ends = written.ends
        contents.written[name] = ends[::-1] if _MATLAB in found.attrs else ends


def _add_cells(file: Any, contents: Contents, name: str, found: Any) -> None:
    """Take in a cell array, or a field of an array of structures, of MATLAB: its elements are
    references."""
    held = [file[reference] for reference in found[...].ravel() if reference]
    arrays = [one for one in held if hasattr(one, "shape") and _refused(one) is None]
    texts = [_matlab_text(one) for one in arrays]
    if texts and all(isinstance(text, str) for text in texts):
        contents.add(name, np.array(texts))
        return
    for place, one in enumerate(arrays):
        _add(contents, element(name, place), one, dict(one.attrs))


def _refused(found: Any) -> str | None:
    """Return why an array is not read; None where it is."""
    if found.external:
        return "lies in another file (external storage); copy it into this one with h5repack"
    if found.is_virtual:
        sources = {source.file_name for source in found.virtual_sources()}
        if sources - {"."}:
            return "is made of other files (virtual); copy it into this one with h5repack"
    size = math.prod(found.shape or ()) * found.dtype.itemsize
    if found.chunks is not None and (why := too_large(found.chunks, found.dtype.itemsize)):
        return why
    stored = size if found.is_virtual else found.id.get_storage_size()
    why = too_much(size, stored)
    if why is None and size and not stored:
        why = "was never written, though it has a place in the file"
    return why


def _unreadable(error: str) -> str:
    """Return what a message of HDF5 means, and what to do."""
    if "unable to lock" in error:
        return "is being written by another program; wait until it has closed the file"
    if "consistency flags" in error:
        what = "is being written, or its writer was killed"
        return f"{what}; wait until it is closed, or run h5clear -s on a copy"
    return "is no HDF5 file, or is cut off; copy it again"


def _found(file: Any, name: str) -> Any:
    """Return an array of a file by the name that it has among the contents."""
    with suppress(KeyError):
        return file[name]
    group, number, last = name.rsplit("/", 2)
    holder = file[f"{group}/{last}"] if f"{group}/{last}" in file else file[group]
    return file[holder[...].ravel()[int(number)]]


def _array(stored: Any) -> Any:
    """Return an array of a file, with its axes as its writer saw them."""
    return _as_seen(stored, stored)


def _as_seen(stored: Any, array: Any) -> Any:
    """Return what has the sizes of a stored array, with the axes as its writer has them."""
    return Reversed(array) if _MATLAB in stored.attrs else array


def _matlab_text(stored: Any) -> str | list[str] | None:
    """Return the text of an array of characters that MATLAB wrote; None where it is none."""
    if stored.attrs.get(_MATLAB) not in (b"char", "char") or _EMPTY in stored.attrs:
        return None
    rows = np.atleast_2d(np.asarray(stored[...], dtype="<u2").T)
    texts = [row.tobytes().decode("utf-16-le", "replace").rstrip() for row in rows]
    return texts[0] if len(texts) == 1 else texts


class Reversed:
    """An array that MATLAB wrote: its axes are stored in reverse order."""

    def __init__(self, stored: Any) -> None:
        self._stored = stored

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes as MATLAB shows them."""
        return tuple(reversed(self._stored.shape))

    @property
    def chunks(self) -> tuple[int, ...] | None:
        """Sizes of the chunks in the same order; None: it has none."""
        sizes = self._stored.chunks
        return None if sizes is None else tuple(reversed(sizes))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""
        kind: np.dtype[Any] = self._stored.dtype
        return kind

    def __getitem__(self, part: Any) -> NDArray[Any]:
        if isinstance(part, tuple):  # of the last axis, which is stored as the first
            return np.asarray(self._stored[part[-1]]).T
        return np.asarray(self._stored[..., part]).T
