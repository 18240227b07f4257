"""Figures of pads: the verdict map, and force maps with the dead cells marked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.faults import FaultKind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diagnostics.faults import Fault
    from diagnostics.layout import SensorLayout

PAGE = 10.0
"""Width of the maps, in inches; pads that do not fit go below."""

_WIDE = 5.0
"""Width of a map whose legend fits on one line, in inches."""

_ALIVE = "#8fbf8f"
_FAULTY = "#c0392b"
_UNTESTED = "#d9d9d9"
_ABSENT = "#ffffff"


def draw(
    layout: SensorLayout,
    verdicts: NDArray[np.object_],
    faults: Sequence[Fault],
    page: float,
    count_from: int = 0,
) -> Figure:
    """Draw each pad: green alive, red faulty, grey untested; the legend explains the letters that
    are on the map.

    Args:
        layout: the array.
        verdicts: of its cells, ``[D]``.
        faults: in it.
        page: width of the page, in inches.
        count_from: number of the first pad, row and column.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure, ((*axes,),) = pads_figure(layout, n_rows=1, scale=False, page=page)
    colours = np.where(layout.is_cell, verdicts.astype(np.intp), 3)
    palette = ListedColormap([_ALIVE, _FAULTY, _UNTESTED, _ABSENT])
    cell_points = 72 * _cell(layout, page)
    for pad, ax in enumerate(axes):
        ax.imshow(layout.grid(colours)[pad], cmap=palette, vmin=-0.5, vmax=3.5)
        ax.set_title(f"pad {pad + count_from}", fontsize=10)
        _ticks(ax, layout, count_from)
        if layout.is_matrix:
            ax.set_xlabel("column", fontsize=8)
            ax.set_ylabel("row", fontsize=8)
        ax.set_xticks(np.arange(0.5, layout.shape[2] - 1), minor=True)
        ax.set_yticks(np.arange(0.5, layout.rows - 1), minor=True)
        ax.grid(which="minor", color="white", linewidth=min(1.5, 0.1 * cell_points))
        ax.tick_params(which="minor", length=0)
        ax.spines[:].set_visible(False)
    kind_of = {cell: fault.kind for fault in faults for cell in fault.cells}
    size = min(8.0, 0.6 * cell_points)
    for cell, kind in kind_of.items():
        pad, row, col = (int(i) for i in np.unravel_index(cell, layout.shape))
        axes[pad].text(
            col, row, kind.letter, ha="center", va="center", color="white", fontsize=size
        )
    shown = legend_of(faults)
    legend = {
        "alive": _ALIVE,
        f"faulty: {shown}" if shown else "faulty": _FAULTY,
        "untested": _UNTESTED,
    }
    figure.legend(
        handles=[Patch(color=colour, label=name) for name, colour in legend.items()],
        loc="outside lower center",
        ncols=3 if figure.get_figwidth() > _WIDE else 1,
        fontsize=8,
    )
    return figure


def legend_of(faults: Iterable[Fault]) -> str:
    """Return the letters of the kinds of faults that there are, as "O open, S short"."""
    there = {fault.kind for fault in faults}
    return ", ".join(f"{kind.letter} {kind}" for kind in FaultKind if kind in there)


def draw_forces(
    ax: Axes, values: ArrayLike, layout: SensorLayout, dead: Iterable[int] = (), **imshow: Any
) -> Any:
    """Draw one pad's values ``[rows, cols]`` as a heatmap, a cross on each of the ``dead`` (row,
    col) flat positions.

    Returns the image, for a colour bar.
    """
    image = ax.imshow(np.asarray(values), **imshow)
    for position in dead:
        row, col = divmod(position, layout.shape[2])
        ax.plot(col, row, "x", color="#e74c3c", markersize=6, markeredgewidth=1.6)
    _ticks(ax, layout)
    return image


def draw_row(
    axes: Sequence[Axes],
    values: ArrayLike,
    layout: SensorLayout,
    title: str = "",
    dead: Iterable[int] = (),
    *,
    top: float,
    cmap: str = "viridis",
    **bar: Any,
) -> None:
    """Draw values ``[D]`` as a heatmap of each pad with one colour bar, a cross on each of the
    ``dead`` cells.

    Args:
        axes: one a pad.
        values, layout: of the array.
        title: before the name of the pad.
        dead: cells.
        top: value at the end of the scale, which begins at 0.
        cmap: of the scale.
        bar: of the colour bar.
    """
    size = layout.n_cells // layout.pads
    shown = layout.grid(np.where(layout.is_cell, values, np.nan))
    marked = list(dead)
    for pad, ax in enumerate(axes):
        on_pad = [int(cell) % size for cell in marked if cell // size == pad]
        image = draw_forces(ax, shown[pad], layout, on_pad, vmin=0, vmax=top, cmap=cmap)
        ax.set_title(f"{title}pad {pad}", fontsize=9)
    axes[0].figure.colorbar(image, ax=list(axes), **bar)


def pads_figure(
    layout: SensorLayout, *, n_rows: int, scale: bool = True, page: float = PAGE
) -> tuple[Figure, Any]:
    """Return a figure and its axes ``[n_rows, pads]``, sized to the pads; pads that do not fit a
    page go below.

    Args:
        layout: the array.
        n_rows: number of maps of each pad.
        scale: leave room for a colour scale beside the maps; otherwise for a legend below them.
        page: width of the maps, in inches.
    """
    from matplotlib.figure import Figure

    cell = _cell(layout, page)
    beside = 1.2 if scale else 0.0
    named = 0.0 if scale else 0.35  # room for the names of the axes
    height = layout.rows * cell + 0.7 + named
    width = max(layout.shape[2] * cell, 1.8) + 0.5 + named
    columns = max(1, min(layout.pads, int(page // width)))
    rows = -(-layout.pads // columns)
    across = max(columns * width, 3.0) + beside
    below = 0.6 if scale else 0.5 if across > _WIDE else 0.9
    figure = Figure(figsize=(across, n_rows * rows * height + below))
    # inches: the first layout lets titles stick out a little
    figure.set_layout_engine("constrained", h_pad=0.14)
    axes = figure.subplots(n_rows * rows, columns, squeeze=False).reshape(n_rows, rows * columns)
    for ax in axes[:, layout.pads :].ravel():
        ax.set_visible(False)
    return figure, axes[:, : layout.pads]


def _cell(layout: SensorLayout, page: float) -> float:
    """Return the size of a cell on the verdict map, in inches: less where the pad would not fit a
    page."""
    return min(0.28, 0.8 * page / layout.shape[2], 0.8 * PAGE / layout.rows)


def _ticks(ax: Axes, layout: SensorLayout, count_from: int = 0) -> None:
    columns = range(0, layout.shape[2], max(1, layout.shape[2] // 8))
    rows = range(0, layout.rows, max(1, layout.rows // 8))
    ax.set_xticks(columns, [str(column + count_from) for column in columns])
    ax.set_yticks(rows, [str(row + count_from) for row in rows])
    ax.tick_params(length=0, labelsize=7)
