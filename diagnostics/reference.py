"""What healthy looks like: how a cell reads when the other cells look as they do now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from diagnostics.idle import IdleModel
from diagnostics.layout import SensorLayout

# Healthy frames kept: enough to hold every kind of touch, few enough that a search is one small matrix product.
_KEPT_FRAMES = 6000
_NEIGHBOURS = 20
_PRIOR_WEIGHT = 1.0  # neighbours that the share over all frames counts for: few neighbours prove little
_BAND = 0.05  # of full scale: how far around a value its frequency is smoothed
_IDLE_COUNTS = 0.5  # of the model of idleness, against the nearest frames, where all cells are heard
_MOST_CELLS = 320  # for which the model of idleness is fitted
_BATCH = 2048  # frames searched at once: bounds the memory of a long log


class Expectation(Protocol):
    """Knows how likely a healthy cell is to read a value, given what the trusted cells read."""

    def share_at(
        self,
        frames: NDArray[np.float64],
        trusted: NDArray[np.bool_],
        cells: NDArray[np.intp],
        values: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        """Return P(|reading - value| <= tolerance) for each frame and cell, ``[T, len(cells)]``.

        Args:
            frames: ``[T, D]``; NaN = missing.
            trusted: bool ``[D]``: the cells that may be asked.
            cells: which cells to judge.
            values: what each of them reads.
            tolerance: how near counts as the same value.
        """


@dataclass(frozen=True)
class NearestFrames:
    """A cell's readings in the healthy frames that most resemble the present one on the trusted cells.

    Contact is thresholded and objects have edges, so a linear model errs where it matters; real frames do not. The
    distance is Euclidean after a square root, because noise grows with load. Where a cell rests, the sharper question
    is whether anything touches it, and ``idle`` answers that.

    Attributes:
        frames: float32 ``[R, D]`` healthy frames, thinned evenly.
        idle: P(a cell is idle | the others); None for arrays of more than 320 cells, which take minutes to fit.
        full_scale: of the layout.
    """

    frames: NDArray[np.float32]
    idle: IdleModel | None
    full_scale: float

    @classmethod
    def fit(cls, recordings: Sequence[NDArray[np.float64]], full_scale: float, tolerance: float) -> NearestFrames:
        """Keep the frames of fault-free recordings, ``[T, D]`` each; frames with missing readings are left out."""
        frames = np.concatenate([r[~np.isnan(r).any(axis=1)] for r in recordings])
        if not len(frames):
            raise ValueError("the fault-free recordings hold no complete frame: every one has missing readings")
        thin = np.linspace(0, len(frames) - 1, min(len(frames), _KEPT_FRAMES)).astype(int)
        kept = frames[thin].astype(np.float32)
        idle = IdleModel.fit(kept, tolerance) if kept.shape[1] <= _MOST_CELLS else None
        return cls(kept, idle, full_scale)

    def share_at(
        self,
        frames: NDArray[np.float64],
        trusted: NDArray[np.bool_],
        cells: NDArray[np.intp],
        values: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        """See :class:`Expectation`. Where no cell can be trusted, any healthy frame is as near as any other."""
        overall = _overall_share(self.frames[:, cells], values, tolerance, self.full_scale)
        if not trusted.any():
            return np.broadcast_to(overall, (len(frames), len(cells)))
        near = (np.abs(self.frames[:, cells] - values) <= tolerance).astype(np.float32)  # (R, C)
        reference = _stabilised(self.frames)[:, trusted]
        energy = (reference**2).sum(axis=1)
        neighbours = min(_NEIGHBOURS, len(self.frames))
        counts = _IDLE_COUNTS * self.idle.heard(trusted) ** 2 if self.idle is not None else 0.0
        shares = np.empty((len(frames), len(cells)))
        for first in range(0, len(frames), _BATCH):
            # A missing reading is taken for an untouched cell.
            batch = np.nan_to_num(frames[first : first + _BATCH]).astype(np.float32)
            distance = energy - 2 * _stabilised(batch[:, trusted]) @ reference.T  # (B, R), up to a constant
            nearest = np.argpartition(distance, neighbours - 1, axis=1)[:, :neighbours]
            share = _shrunk(near[nearest].mean(axis=1), neighbours, overall)
            if self.idle is not None:
                # Cells that cannot be trusted count as what they read in the nearest frames.
                batch[:, ~trusted] = self.frames[:, ~trusted][nearest].mean(axis=1)
                resting = np.abs(values - self.idle.resting[cells]) <= tolerance
                # Both know something that the other does not: a geometric mean. The model wants to hear every cell,
                # so it counts for less the fewer there are.
                likely = self.idle.probability(batch, cells[resting])
                share[:, resting] = share[:, resting] ** (1 - counts) * likely**counts
            shares[first : first + _BATCH] = share
        return shares


def _shrunk(share: NDArray[np.float64], neighbours: int, overall: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pull the share among neighbours towards the share among all samples."""
    return (share * neighbours + overall * _PRIOR_WEIGHT) / (neighbours + _PRIOR_WEIGHT)


def _overall_share(
    readings: NDArray[Any], values: NDArray[np.float64], tolerance: float, full_scale: float
) -> NDArray[np.float64]:
    """Return how often each column of ``readings`` ``[R, C]`` lies near its value, never quite 0.

    A cell held under a constant load reads some value that it may never have read before, and is no stranger for it:
    around a value in mid-range the count goes over a wide band, in proportion.
    """

    def share(width: float) -> NDArray[np.float64]:
        near: NDArray[np.intp] = (np.abs(readings - values) <= width).sum(axis=0)
        return (near + 0.5) / (len(readings) + 1)

    band = max(_BAND * full_scale, tolerance)
    return np.maximum(share(tolerance), share(band) * tolerance / band)


def _stabilised(frames: NDArray[np.float32]) -> NDArray[np.float32]:
    root: NDArray[np.float32] = np.sqrt(np.maximum(frames, 0))
    return root


@dataclass(frozen=True)
class PooledNeighbourhood:
    """A cold start's expectation: what cells of this skin read when the cells around them look like this.

    Without a fault-free reference each cell is judged by all trusted cells together: from the mean of its four nearest
    trusted neighbours, of the four diagonal ones, and from how well they enclose it: the smaller reading of two
    opposite neighbours, the best pair counting. Built from the log itself. It interpolates, never extrapolates: a cell
    at the rim of the contact is rightly still, however loaded its neighbours on one side are.
    """

    layout: SensorLayout
    log: NDArray[np.float64]

    def share_at(
        self,
        frames: NDArray[np.float64],
        trusted: NDArray[np.bool_],
        cells: NDArray[np.intp],
        values: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        """See :class:`Expectation`. A cell between no two trusted neighbours is not judged: its share is 1."""
        from scipy.spatial import cKDTree

        present = self.layout.present.ravel()
        rng = np.random.default_rng(0)  # which samples are kept; any choice will do, but always the same
        known = _surroundings(self.log, trusted, self.layout)
        usable = np.flatnonzero(trusted & present & np.isfinite(known).all(axis=(0, 2)))
        shares = np.ones((len(frames), len(cells)))
        if not len(usable):
            return shares
        samples, readings = known[:, usable].reshape(-1, known.shape[2]), np.nan_to_num(self.log[:, usable]).ravel()
        kept = rng.choice(len(samples), min(len(samples), 4 * _KEPT_FRAMES), replace=False)
        tree, readings = cKDTree(samples[kept]), readings[kept]
        asked = _surroundings(frames, trusted, self.layout)[:, cells]  # (T, C, 3)
        judged = np.isfinite(asked).all(axis=(0, 2))
        neighbours = min(_NEIGHBOURS, len(readings))
        _, nearest = tree.query(asked[:, judged], k=neighbours)  # (T, C', neighbours)
        nearest = nearest.reshape(len(frames), int(judged.sum()), -1)
        share = (np.abs(readings[nearest] - values[judged][:, None]) <= tolerance).mean(axis=2)
        overall = _overall_share(readings[:, None], values[judged], tolerance, self.layout.full_scale)
        shares[:, judged] = _shrunk(share, neighbours, overall)
        return shares


def _surroundings(frames: NDArray[np.float64], trusted: NDArray[np.bool_], layout: SensorLayout) -> NDArray[np.float64]:
    """Return what surrounds each cell in each frame, ``[T, D, 3]``; NaN where no two opposite cells are trusted."""
    grid = layout.grid(np.where(trusted & layout.present.ravel(), np.sqrt(np.maximum(frames, 0)), np.nan))
    padded = np.pad(grid, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    rows, cols = layout.rows, layout.cols

    def shifted(*offsets: tuple[int, int]) -> NDArray[np.float64]:
        return np.stack([padded[:, :, 1 + r : 1 + r + rows, 1 + c : 1 + c + cols] for r, c in offsets])

    beside, opposite = shifted((-1, 0), (0, -1)), shifted((1, 0), (0, 1))
    diagonal, across = shifted((-1, -1), (-1, 1)), shifted((1, 1), (1, -1))
    near, far = _mean(np.concatenate([beside, opposite])), _mean(np.concatenate([diagonal, across]))
    # A cell that has one kind of neighbour only is described by that kind.
    near, far = np.where(np.isnan(near), far, near), np.where(np.isnan(far), near, far)
    pairs = np.minimum(np.concatenate([beside, diagonal]), np.concatenate([opposite, across]))
    enclosed = np.fmax.reduce(pairs)
    return np.stack([near, far, enclosed], axis=-1).reshape(len(frames), layout.n_cells, 3)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over the first axis without the NaN, NaN where nothing else is there."""
    count = (~np.isnan(values)).sum(axis=0)
    total = np.nansum(values, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
