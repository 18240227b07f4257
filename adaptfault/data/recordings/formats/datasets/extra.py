"""Imports packages of extras where they are used."""

from __future__ import annotations

from importlib import import_module
from os import PathLike
from typing import Any

from adaptfault.data.recordings.errors import InputError


def imported(package: str, path: str | PathLike[str], what: str = "") -> Any:
    """Return a package.

    Args:
        package: its name, or that of a module in it.
        path: the file that it is needed for.
        what: the error where it is not installed; "": that it comes with the extra "datasets".

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(package)
    except ImportError:
        missing = f"needs {package}, which is not installed; pip install 'adaptfault[datasets]'"
        raise InputError.at(path, what or missing) from None
