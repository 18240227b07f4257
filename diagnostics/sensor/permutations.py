"""The permutations of the wiring that are tried, and the best of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

# of one kind on a pad, the least expected, whose exchange is tried; on large arrays: sizes
_LINES = 16
_FEW_LINES = 4
_WORK = 6400  # lines times cells, about: a size

Floats = NDArray[np.float64]
Cells = NDArray[np.intp]


class Candidate(NamedTuple):
    """A permutation that is tried; ``turned``: of a whole pad, so that symmetric loads hardly tell
    it."""

    source: Cells
    text: str
    turned: bool = False


def candidates_of(layout: SensorLayout, surplus: Floats, source: Cells) -> Iterator[Candidate]:
    """Yield the permutations that are tried, each on top of ``source``; with declared wiring only
    exchanged pads."""
    grid, score = layout.grid(np.arange(layout.n_cells)), layout.grid(surplus)
    # fewer on large arrays, where each costs more
    most = int(np.clip(_WORK // layout.n_cells, _FEW_LINES, _LINES))
    for pad in range(layout.pads) if layout.is_matrix else ():
        for axis, kind in enumerate(("row", "column")):
            size = grid.shape[axis + 1]
            worst = np.sort(np.argsort(score[pad].sum(axis=1 - axis))[:most]).tolist()
            orders = [
                (_exchanged(size, a, b), f"{kind}s {a} and {b} of pad {pad} are exchanged")
                for a, b in combinations(worst, 2)
            ]
            every = np.arange(size)
            if size > 2:
                orders.append((every[::-1], f"the {kind}s of pad {pad} are in reverse order"))
            for by in (1, -1) if size > 3 else ():
                text = f"the {kind}s of pad {pad} are shifted by {by:+d}"
                orders.append((np.roll(every, -by), text))
            for order, text in orders:
                changed = grid.copy()
                changed[pad] = np.take(grid[pad], order, axis=axis)
                yield Candidate(source[changed.ravel()], text, turned="reverse" in text)
        for order, text in _orientations(*grid[pad].shape):
            changed = grid.copy()
            changed[pad] = grid[pad].ravel()[order]
            yield Candidate(source[changed.ravel()], f"pad {pad} is {text}", turned=True)
    for a, b in combinations(range(layout.pads), 2):
        yield Candidate(
            source[grid[_exchanged(layout.pads, a, b)].ravel()], f"pads {a} and {b} are exchanged"
        )


def _orientations(rows: int, columns: int) -> Iterator[tuple[Cells, str]]:
    """Yield the orders of a pad that is turned or read in the other order, ``[rows, columns]``, and
    their names."""
    if min(rows, columns) < 2:
        return
    by_column = np.arange(rows * columns).reshape(columns, rows).T
    yield by_column, "transposed: read column by column"
    yield by_column[::-1], "transposed: read column by column, the rows in reverse order"
    yield by_column[:, ::-1], "transposed: read column by column, the columns in reverse order"
    yield by_column[::-1, ::-1], "transposed: read column by column, both in reverse order"
    yield np.arange(rows * columns)[::-1].reshape(rows, columns), "turned by half a turn"


def _exchanged(size: int, a: int, b: int) -> Cells:
    """Return the order of ``size`` lines or pads with two of them exchanged."""
    order = np.arange(size)
    order[[a, b]] = b, a
    return order


def best_of(
    candidates: Sequence[Candidate], totals: Floats, source: Cells, least: float = -np.inf
) -> tuple[int, float]:
    """Return the number of the candidate with the largest of ``totals``, and by how much it exceeds
    those of others that move some of the same cells.

    Where it was exchanged, two lines elsewhere may be exchanged as well.

    Args:
        candidates: on top of ``source``.
        totals: of each of them.
        source: int ``[D]``, where each cell answers now.
        least: what it exceeds where there is no such other.
    """
    best = int(totals.argmax())
    moves = candidates[best].source != source
    rivals = [
        total
        for i, total in enumerate(totals.tolist())
        if i != best and (moves & (candidates[i].source != source)).any()
    ]
    return best, totals[best] - max(rivals, default=least)
