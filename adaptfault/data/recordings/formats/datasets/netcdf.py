"""Opens netCDF files of versions 1 to 3; later ones are HDF5."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import foreseeing
from adaptfault.data.recordings.formats.datasets.contents import Contents, kept
from adaptfault.data.recordings.formats.text import read_bytes

_MAGIC = b"CDF"


def is_classic(path: Path) -> bool:
    """Return whether a file is of these versions."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


@kept
def opened(path: Path) -> Contents:
    """Open a file for reading; it is read whole.

    Raises:
        InputError: it is damaged.
    """
    from scipy.io import netcdf_file

    contents = Contents()
    data = BytesIO(read_bytes(path))
    damaged = "is no netCDF file, or is damaged ({}); write it again"
    with foreseeing(path, damaged), netcdf_file(data, mmap=False) as file:
        contents.attributes[""] = _attributes(file)
        for name, variable in file.variables.items():
            contents.add(name, variable.data, _attributes(variable))
    return contents


def _attributes(owner: Any) -> dict[str, Any]:
    """Return the attributes of a file or a variable: scipy gives no other way to list them."""
    return dict(owner._attributes)
