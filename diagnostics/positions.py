"""Where the cells of an array are: their indices, positions and neighbours, and frames in any of
its shapes."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.array_likes import is_array, plain_array


class Positions:
    """Cells by index and by position; see :class:`~diagnostics.layout.SensorLayout`."""

    pads: int
    rows: int
    cols: int
    axes: int
    present: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(pads, rows, cols * axes)``: how cells are laid out as a grid."""
        return self.pads, self.rows, self.cols * self.axes

    @property
    def n_cells(self) -> int:
        """D, the number of positions times axes: ``pads * rows * cols * axes``."""
        return self.pads * self.rows * self.cols * self.axes

    @property
    def is_cell(self) -> NDArray[np.bool_]:
        """Whether there is a cell at each position, bool ``[D]``."""
        return self.present.ravel()

    def cell(self, pad: int, row: int, col: int, axis: int = 0) -> int:
        """Return the index of the cell at a position; IndexError names what is out of range."""
        sizes = self.pads, self.rows, self.cols, self.axes
        for name, value, size in zip(
            ("pad", "row", "col", "axis"), (pad, row, col, axis), sizes, strict=True
        ):
            if not 0 <= value < size:
                raise IndexError(f"{name} {value} is outside this layout: use 0 to {size - 1}")
        return int(((pad * self.rows + row) * self.cols + col) * self.axes + axis)

    def position(self, cell: int) -> tuple[int, int, int]:
        """Return ``(pad, row, col)`` of a cell; IndexError if the layout has no such cell."""
        if not 0 <= cell < self.n_cells:
            raise IndexError(
                f"cell {cell} is outside this layout: it has {self.n_cells} cells, numbered from 0"
            )
        pad, rest = divmod(int(cell) // self.axes, self.rows * self.cols)
        return (pad, *divmod(rest, self.cols))

    @cached_property
    def _grid(self) -> NDArray[np.intp]:
        return np.arange(self.n_cells).reshape(self.shape)

    @cached_property
    def pad_of(self) -> NDArray[np.intp]:
        """The pad of each cell, int ``[D]``."""
        return np.arange(self.n_cells) // (self.n_cells // self.pads)

    @cached_property
    def beside(self) -> NDArray[np.intp]:
        """The eight neighbours of each cell, of its axis and on its pad, row by row, int
        ``[D, 8]``; -1: none."""
        index = np.full((self.pads, self.rows + 2, self.cols + 2, self.axes), -1, dtype=np.intp)
        index[:, 1:-1, 1:-1] = np.where(self.present, self._grid, -1).reshape(
            self.pads, self.rows, self.cols, -1
        )
        steps = [
            (down, across) for down in range(3) for across in range(3) if (down, across) != (1, 1)
        ]
        around = [
            index[:, down : down + self.rows, across : across + self.cols] for down, across in steps
        ]
        return np.stack(around, axis=-1).reshape(self.n_cells, len(steps))

    def connected(self, cells: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the number of the group of neighbouring ``cells`` (bool ``[D]``) of each, int
        ``[D]``; 0: none."""
        from scipy.ndimage import label

        # diagonal neighbours included
        of_pad = np.pad(np.ones((1, 3, 3)), ((1, 1), (0, 0), (0, 0)))
        return np.asarray(label(self.grid(cells), of_pad)[0].ravel(), dtype=np.intp)

    def with_neighbours(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return ``cells`` (bool ``[D]``) and their neighbours on the same pad, bool ``[D]``."""
        every = cells.copy()
        near = self.beside[cells]
        every[near[near >= 0]] = True
        return every

    def grid(self, values: ArrayLike) -> NDArray[Any]:
        """View values ``[..., D]`` as ``[..., pads, rows, cols]``."""
        values = np.asarray(values)
        return values.reshape(*values.shape[:-1], *self.shape)

    @property
    def _grids(self) -> tuple[tuple[int, ...], ...]:
        """The shapes of a frame that is not flat."""
        every = (
            [self.shape]
            if self.axes == 1
            else [self.shape, (self.pads, self.rows, self.cols, self.axes)]
        )
        return (*every, *(grid[1:] for grid in every)) if self.pads == 1 else tuple(every)

    def recordings(self, given: Any) -> list[Any]:
        """Return one or several recordings as a list; nothing is checked or converted.

        Args:
            given: one array ``[T, D]``, ``[T, pads, rows, cols]`` or, of a layout with one pad,
                ``[T, rows, cols]``; or a sequence of such arrays; or recordings of one length in an
                array with one axis more, ``[n, T, ...]``. An array may be one of torch, pandas or
                xarray, or a masked one.
        """
        if not is_array(given):
            return [plain_array(one) if is_array(one) else one for one in given]
        array = plain_array(given)
        one = array.ndim <= 2 or array.shape[1:] in self._grids
        return [array] if one else list(array)

    def check_frame(self, frame: ArrayLike) -> NDArray[np.float64]:
        """Return one frame as float64 ``[D]``; ``[pads, rows, cols]`` and, of one pad,
        ``[rows, cols]`` are flattened.

        Raises:
            ValueError: another shape.
        """
        values = np.asarray(plain_array(frame), dtype=np.float64)
        if values.shape not in ((self.n_cells,), *self._grids):
            grid = list(self._grids[-1])
            raise ValueError(
                f"expected a frame [{self.n_cells}] or {grid}, got {list(values.shape)}"
            )
        return values.reshape(-1)

    def check_recording(self, recording: ArrayLike, name: str = "recording") -> NDArray[np.float64]:
        """Return a recording as float64 ``[T, D]``.

        ``[T, pads, rows, cols]`` is flattened, for a layout of one pad ``[T, rows, cols]`` as well.

        Raises:
            ValueError: not numbers, or the shape does not fit this layout.
        """
        try:
            frames = np.asarray(plain_array(recording), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: expected numbers [T, {self.n_cells}] ({error})") from None
        if frames.shape[1:] in self._grids:
            frames = frames.reshape(len(frames), -1)
        if frames.ndim != 2 or frames.shape[1] != self.n_cells:
            grid = ", ".join(map(str, self._grids[-1]))
            raise ValueError(
                f"{name}: expected [T, {self.n_cells}] or [T, {grid}], got {list(frames.shape)};"
                " check the layout, and that masked positions are kept in the columns"
            )
        return frames
