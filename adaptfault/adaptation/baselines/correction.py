"""Online correction (Section V): readings at a rail become a neutral value; nobody has to know
which cells are faulty.

A rail is also where a healthy cell ends up: at 0 where nothing touches it, at full scale under a
hard press. The rule overcorrects. What that costs, on the test grasps of a real hand (36 classes,
81 % of the readings true zeros, none at full scale; mean accuracy of 3 networks)::

    what becomes of abnormal readings         healthy    5 cells short    hard presses
    nothing is corrected                        0.680            0.203           0.676
    0 and full scale: 0 (the default)           0.680            0.627           0.547
    0 and full scale: half of it                0.028            0.022
    0 and full scale: the cell's median         0.674            0.634
    0 and full scale: what the others say       0.518            0.514
    full scale alone: what the others say       0.680            0.681           0.676

"Hard presses": the same readings cut off at half of the scale, as if they saturated there; 0.6 % of
them do, in 45 % of the windows. So the paper's neutral 2.5 N must never stand for 0, and full scale
is best replaced by what the other cells say, which undoes true saturation as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.windows import CONVERTER_STEP
from adaptfault.imputation.statistics import CellStatistics
from diagnostics.preprocessing.array_likes import plain_array

TOLERANCE = 1.5 * CONVERTER_STEP  # a cell at the rail may vary by one converter step

Neutral = float | ArrayLike | CellStatistics


def correct(
    x: ArrayLike,
    *,
    abnormal: Sequence[float] = (0.0, 1.0),
    neutral: Neutral = 0.0,
    tolerance: float = TOLERANCE,
) -> NDArray[Any]:
    """Return scaled readings ``[..., D]`` in which abnormal ones are replaced by a neutral value
    (Section V).

    Frames are corrected independently, so windows, recordings and single frames are all valid
    input.

    Args:
        x: on the 0..1 scale. NaN is left as it is.
        abnormal: values that count as faults. The paper's 0 and 5 N are 0 and 1 on this scale.
        neutral: the replacement: one value; an array ``[D]``, one for each cell (as its median); or
            :class:`~adaptfault.imputation.statistics.CellStatistics`: the conditional mean of the
            abnormal cells given the others, within 0..1. It needs ``abnormal=(1.0,)`` where healthy
            cells read exactly 0.
        tolerance: how far from an abnormal value a reading may be. The default is 1.5 steps of a
            12-bit converter; for b bits use ``1.5 / (2**b - 1)``. Exact equality, as the paper has
            it, fails on calibrated readings.

    Returns:
        A new array of the same shape, float32 or float64 as ``x`` was.

    Raises:
        ValueError: no abnormal value, a tolerance below 0, a neutral value that does not fit the D
            cells.
    """
    x = _readings(x)
    return _replaced(x, at_rail(x, abnormal, tolerance), neutral)


def at_rail(x: NDArray[Any], abnormal: Sequence[float], tolerance: float) -> NDArray[np.bool_]:
    """Return which readings ``[...]`` lie within ``tolerance`` of an abnormal value, bool of the
    same shape."""
    if not len(abnormal) or not tolerance >= 0:
        raise ValueError(
            f"expected abnormal values and a tolerance >= 0, got {list(abnormal)} and {tolerance}"
        )
    hit = np.abs(x - abnormal[0]) <= tolerance
    for value in abnormal[1:]:
        hit |= np.abs(x - value) <= tolerance
    return hit


class CausalCorrection:
    """Frame-by-frame correction with a delay: a cell is abnormal after ``wait`` frames at one rail.

    Contact that saturates a cell for fewer than ``wait`` frames passes unchanged, and so do the
    first ``wait - 1`` frames of a fault. A cell that leaves the rail is used again at once.

    Args:
        wait: frames; 1 corrects at once, as :func:`correct` does.
        abnormal, neutral, tolerance: as in :func:`correct`.

    Raises:
        ValueError: ``wait`` below 1, no abnormal value, a tolerance below 0.
    """

    def __init__(
        self,
        *,
        wait: int = 10,
        abnormal: Sequence[float] = (0.0, 1.0),
        neutral: Neutral = 0.0,
        tolerance: float = TOLERANCE,
    ) -> None:
        if wait < 1:
            raise ValueError(f"wait is a number of frames, at least 1; got {wait}")
        at_rail(np.zeros(1), abnormal, tolerance)
        self.wait = wait
        self.abnormal = tuple(abnormal)
        self.neutral = neutral
        self.tolerance = tolerance
        self.reset()

    def reset(self) -> None:
        """Clear the state, as at the start of a recording."""
        self._stayed: NDArray[np.int64] | None = None  # [rails, D], frames in a row at each rail

    def update(self, frame: ArrayLike) -> NDArray[Any]:
        """Return the next frame ``[D]``, corrected."""
        x = self._frames(_readings(frame)[None])
        hit = np.stack([at_rail(x[0], [value], self.tolerance) for value in self.abnormal])
        self._stayed = np.where(hit, self._before(x) + 1, 0)
        return _replaced(x[0], self._stayed.max(axis=0) >= self.wait, self.neutral)

    def correct(self, frames: ArrayLike) -> NDArray[Any]:
        """Return the next frames ``[T, D]``, corrected as :meth:`update` would one by one.

        Raises:
            ValueError: another number of dimensions, or of cells than before.
        """
        x = self._frames(_readings(frames))
        rails = zip(self.abnormal, self._before(x), strict=True)
        runs = np.stack(
            [_runs(at_rail(x, [value], self.tolerance), before) for value, before in rails]
        )
        if len(x):
            self._stayed = runs[:, -1]
        return _replaced(x, runs.max(axis=0) >= self.wait, self.neutral)

    def _frames(self, x: NDArray[Any]) -> NDArray[Any]:
        if x.ndim != 2 or (self._stayed is not None and self._stayed.shape[1] != x.shape[1]):
            expected = "D" if self._stayed is None else self._stayed.shape[1]
            raise ValueError(
                f"expected frames [T, {expected}], got {list(x.shape)}; reset() before another"
                " array"
            )
        return x

    def _before(self, x: NDArray[Any]) -> NDArray[np.int64]:
        return (
            np.zeros((len(self.abnormal), x.shape[1]), np.int64)
            if self._stayed is None
            else self._stayed
        )


def _runs(hit: NDArray[np.bool_], before: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each frame how many in a row were hit up to it, ``[T, D]``; ``before [D]`` were
    hit earlier."""
    frame = np.arange(len(hit))[:, None]
    missed = np.maximum.accumulate(np.where(hit, -1, frame), axis=0)  # last frame that was not hit
    return np.where(missed < 0, frame + 1 + before, frame - missed)


def _readings(x: ArrayLike) -> NDArray[Any]:
    x = plain_array(x)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float64)


def _replaced(x: NDArray[Any], hit: NDArray[np.bool_], neutral: Neutral) -> NDArray[Any]:
    if isinstance(neutral, CellStatistics):
        return _expected(x, hit, neutral)
    value = np.asarray(neutral, dtype=x.dtype)
    if value.ndim and value.shape != x.shape[-1:]:
        raise ValueError(
            f"neutral is one value, or one for each of the {x.shape[-1]} cells; got shape"
            f" {list(value.shape)}"
        )
    return np.where(hit, value, x)


def _expected(x: NDArray[Any], hit: NDArray[np.bool_], statistics: CellStatistics) -> NDArray[Any]:
    """Replace by the conditional mean given the other cells; one solve for each set of abnormal
    cells."""
    d = len(statistics.mean)
    if x.shape[-1] != d:
        raise ValueError(
            f"the statistics have {d} cells, the readings {x.shape[-1]}: {list(x.shape)}"
        )
    out = x.reshape(-1, d).copy()
    hit = hit.reshape(-1, d)
    unknown = hit | np.isnan(out)
    which = np.flatnonzero(hit.any(axis=1))
    for rows, missing in _alike(which, unknown[which]):
        out[np.ix_(rows, missing)] = np.clip(statistics.expected(out[rows], missing), 0.0, 1.0)
    return np.where(hit, out, x.reshape(-1, d)).reshape(x.shape)


def _alike(
    rows: NDArray[np.intp], masks: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
    """Yield the rows that share a mask ``[D]``, and the mask."""
    if len(rows) < 2:
        yield from zip(rows[None], masks, strict=False)
        return
    _, first, group = np.unique(
        np.packbits(masks, axis=1), axis=0, return_index=True, return_inverse=True
    )
    for i, mask in enumerate(masks[first]):
        yield rows[group.ravel() == i], mask
