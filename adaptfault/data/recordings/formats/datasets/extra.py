"""Imports the packages of the extra "datasets" where they are used."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError


def imported(package: str, path: Path) -> Any:
    """Return a package.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(package)
    except ImportError:
        what = f"needs {package}, which is not installed; pip install 'adaptfault[datasets]'"
        raise InputError.at(path, what) from None
