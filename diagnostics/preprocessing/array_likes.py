"""Arrays of other libraries as NumPy's: tensors, tables, labelled and masked arrays."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray


def is_array(given: Any) -> bool:
    """Return whether something is one array of some library, and no list of arrays."""
    return hasattr(given, "__array__")


def plain_array(given: Any) -> NDArray[Any]:
    """Return an array, or nested lists, as NumPy's; what is masked or not available is NaN.

    Raises:
        ValueError: complex numbers, or what is no array of numbers.
    """
    if hasattr(given, "detach"):  # a tensor of torch may need a gradient, or lie on a GPU
        given = given.detach().cpu()
    if isinstance(given, np.ma.MaskedArray):
        _refuse_complex(given)
        if not np.ma.is_masked(given):
            return np.asarray(given.data)
        return np.where(np.ma.getmaskarray(given), np.nan, given.data)
    values = np.asarray(given)
    if values.dtype.kind == "O" and hasattr(given, "to_numpy"):  # pandas' missing numbers
        with suppress(TypeError, ValueError):
            values = np.asarray(given.to_numpy(dtype=np.float64, na_value=np.nan))
    _refuse_complex(values)
    return values


def _refuse_complex(values: NDArray[Any]) -> None:
    if values.dtype.kind == "c":
        raise ValueError("complex numbers: give their real part, or their amplitude (abs)")
