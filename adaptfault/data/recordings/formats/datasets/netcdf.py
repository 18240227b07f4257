"""Opens netCDF files of versions 1 to 3; later ones are HDF5."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.contents import Contents
from adaptfault.data.recordings.formats.text import read_bytes

_MAGIC = b"CDF"


def is_classic(path: Path) -> bool:
    """Return whether a file is of these versions."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


@contextmanager
def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
    """Open a file for reading; it is read whole.

    Raises:
        InputError: it is damaged.
    """
    from scipy.io import netcdf_file

    contents = Contents()
    data = read_bytes(path)
    try:
        with netcdf_file(BytesIO(data), mmap=False) as file:
            contents.attributes[""] = _attributes(file)
            for name, variable in file.variables.items():
                contents.add(name, variable.data, _attributes(variable))
    # a damaged file raises any of a dozen kinds
    except Exception as error:
        what = f"is no netCDF file, or is damaged ({type(error).__name__}); write it again"
        raise InputError.at(path, what) from None
    yield contents


def _attributes(owner: Any) -> dict[str, Any]:
    """Return the attributes of a file or a variable: scipy gives no other way to list them."""
    return dict(owner._attributes)
