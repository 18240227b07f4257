"""Figures of pads: the verdict map, and force maps with the dead cells marked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from diagnostics.layout import SensorLayout

_ALIVE, _FAULTY, _UNTESTED, _ABSENT = "#8fbf8f", "#c0392b", "#d9d9d9", "#ffffff"


def draw(layout: SensorLayout, verdicts: NDArray[np.intp], letters: Mapping[int, str]) -> Figure:
    """Draw each pad: green alive, red faulty, grey untested.

    Args:
        layout: the array.
        verdicts: int ``[D]``, 0 alive, 1 faulty, 2 untested, as :class:`~diagnostics.Verdict` counts.
        letters: letter of the fault kind, by cell.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure, axes = pads_figure(layout, n_rows=1)
    colours = np.where(layout.present.ravel(), verdicts, 3)
    palette = ListedColormap([_ALIVE, _FAULTY, _UNTESTED, _ABSENT])
    for pad, ax in enumerate(axes[0]):
        ax.imshow(layout.grid(colours)[pad], cmap=palette, vmin=-0.5, vmax=3.5)
        ax.set_title(f"pad {pad}")
        _ticks(ax, layout)
    for cell, letter in letters.items():
        pad, row, col = (int(i) for i in np.unravel_index(cell, layout.shape))
        axes[0, pad].text(col, row, letter, ha="center", va="center", color="white", fontsize=8)
    legend = {"alive": _ALIVE, "faulty": _FAULTY, "untested": _UNTESTED}
    figure.legend(
        handles=[Patch(color=c, label=name) for name, c in legend.items()], loc="outside lower center", ncols=3
    )
    return figure


def draw_forces(ax: Axes, values: ArrayLike, layout: SensorLayout, dead: Iterable[int] = (), **imshow: Any) -> Any:
    """Draw one pad's values ``[rows, cols]`` as a heatmap, a cross on each of the ``dead`` (row, col) flat positions.

    Returns the image, for a colour bar.
    """
    image = ax.imshow(np.asarray(values), **imshow)
    for position in dead:
        row, col = divmod(position, layout.shape[2])
        ax.plot(col, row, "x", color="#e74c3c", markersize=6, markeredgewidth=1.6)
    _ticks(ax, layout)
    return image


def pads_figure(layout: SensorLayout, *, n_rows: int) -> tuple[Figure, Any]:
    """Return a figure with ``n_rows`` rows of axes, one for each pad, sized to the pads' shape."""
    from matplotlib.figure import Figure

    height = float(np.clip(layout.rows * 0.28, 1.8, 8.0))
    width = float(np.clip(layout.shape[2] * 0.28, 1.8, 8.0))
    figure = Figure(figsize=(layout.pads * (width + 0.5) + 1.2, n_rows * (height + 0.5) + 0.6), layout="constrained")
    return figure, figure.subplots(n_rows, layout.pads, squeeze=False)


def _ticks(ax: Axes, layout: SensorLayout) -> None:
    ax.set_xticks(range(0, layout.shape[2], max(1, layout.shape[2] // 8)))
    ax.set_yticks(range(0, layout.rows, max(1, layout.rows // 8)))
    ax.tick_params(length=0, labelsize=7)
