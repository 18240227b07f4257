"""Writes the monitor for the microcontroller as one file of C99, from its limits."""

from __future__ import annotations

from importlib.resources import files
from string import Template

import numpy as np
from numpy.typing import NDArray

from adaptfault.firmware.counting import AWAY, PREDICTORS, SETTLED, TELL, Limits
from diagnostics import SensorLayout

_IN_A_LINE = 16


def monitor_source(limits: Limits, layout: SensorLayout) -> str:
    """Return ``monitor.c``.

    Args:
        limits: of the array.
        layout: of the array, for the comment.
    """
    template = files(__package__).joinpath("monitor.c.template").read_text("utf-8")
    return Template(template).substitute(
        about=_plain(f"Array: {layout}."),
        unit=_plain(layout.unit),
        cells=layout.n_cells,
        per_unit=f"{limits.per_unit:.6g}",
        dither=limits.dither,
        near=limits.near,
        patience=limits.patience,
        silent_after=limits.silent_after,
        n_predictors=PREDICTORS,
        tell=TELL,
        settled=SETTLED,
        away=AWAY,
        rest=_table(limits.rest),
        lowest=_table(limits.lowest),
        highest=_table(limits.highest),
        stuck_after=_table(limits.stuck_after),
        predictors=_table(limits.predictors),
    )


def _table(values: NDArray[np.integer]) -> str:
    """Return the entries of a table, 16 in a line."""
    numbers = [f"{value}," for value in values.ravel().tolist()]
    lines = (numbers[i : i + _IN_A_LINE] for i in range(0, len(numbers), _IN_A_LINE))
    return "".join(f"    {' '.join(line)}\n" for line in lines)


def _plain(text: str) -> str:
    """Return text that ends no comment of C."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in text).replace("*/", "* /")
