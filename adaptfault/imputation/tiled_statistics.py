"""Imputation on large arrays: each missing cell is predicted from the healthy cells within a few
rows and columns.

Array cells are grouped in tiles (:mod:`diagnostics.events.tiles`). The covariance of a tile and its
surroundings is the sum of two estimates: the second moment of the frames in which the tile is
touched, and a pooled covariance that depends on the distance between two cells only, estimated from
all tiles (a stationary Gaussian process; Cressie 1993). On a large array a tile is touched by few
contacts, so its own moments alone overfit: the R2 of broken wires was below 0.

Each prediction p is then corrected to c + a p, a within 0..1, by regression of held-out recordings
on p. So it is no worse than the mean of the cell on these recordings. Numpy only; time and memory
grow linearly with the cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.windows import Windows, evenly
from adaptfault.imputation.kernel import bandwidth
from adaptfault.imputation.recalibration import Recalibration, two_folds
from adaptfault.imputation.tile_part import TilePart
from diagnostics import FaultSet, SensorLayout
from diagnostics.events.tiles import HALO, TILE, tiles

if TYPE_CHECKING:
    from adaptfault.imputation.tiled import TiledFill

LARGE = 1000  # cells; larger arrays are imputed tile by tile
_TOUCHED = 0.004  # on the 0..1 scale: readings that far from rest count as contact
# of a tile: for its moments, and for the kernel regression
_MOST_FRAMES = 600
_REFERENCE_FRAMES = 128
_POOLED_FRAMES = 600  # of the array, for the pooled covariance
_PRIOR_FRAMES = 300  # weight of the pooled covariance; 30 to 10,000 give the same R2
# weight of gain 1 against the gain measured in a tile, which rests on few contacts
_GAIN_FRAMES = 1000
_NOISE = 1e-3  # share of the pooled variance that is independent in each cell
_REACH = TILE + 2 * HALO  # rows and columns that a tile and its surroundings span
_MOST_PADS = 16  # whose mean loads are predictors

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TiledStatistics:
    """Healthy frames of a large array, from which any F can be imputed.

    Attributes:
        frames: float32 ``[M, D]``, on the 0..1 scale.
        fold: bool ``[M]``; the frames of each fold are predicted by the other to measure the error.
        layout: the array.
    """

    frames: Floats
    fold: NDArray[np.bool_]
    layout: SensorLayout

    @classmethod
    def fit(cls, windows: Windows, layout: SensorLayout) -> TiledStatistics:
        """Use the frames of fault-free windows; they are not copied."""
        frames = windows.x.reshape(-1, windows.x.shape[2])
        return cls(frames, two_folds(np.repeat(windows.recording, windows.x.shape[1])), layout)

    def linear(self, fault_set: FaultSet) -> TiledFill:
        """Return the linear front end for F, a torch module."""
        from adaptfault.imputation.tiled import TiledFill

        return TiledFill.of(fault_set, *self.parts(fault_set))

    def nearest(self, fault_set: FaultSet) -> TiledFill:
        """Return the linear front end for F plus a kernel regression of its residuals, a torch
        module."""
        from adaptfault.imputation.tiled import TiledFill

        return TiledFill.of(fault_set, *self.parts(fault_set, references=True))

    @cached_property
    def rest(self) -> Floats:
        """Median reading of each cell, ``[D]``."""
        rest: Floats = np.median(
            self.frames[evenly(len(self.frames), _POOLED_FRAMES)], axis=0
        ).astype("f4")
        return rest

    @cached_property
    def mean(self) -> Floats:
        """Mean reading of each cell, ``[D]``."""
        mean: Floats = self.frames.mean(axis=0)
        return mean

    @cached_property
    def pooled(self) -> NDArray[np.float64]:
        """Pooled covariance about rest by distance in rows and columns,
        ``[2 * reach - 1, 2 * reach - 1]``.

        The biased autocorrelation, which is positive semidefinite, by the Wiener-Khinchin theorem.
        """
        layout = self.layout
        size = layout.rows + _REACH, layout.shape[2] + _REACH
        power = np.zeros((size[0], size[1] // 2 + 1))
        which = evenly(len(self.frames), _POOLED_FRAMES)
        for index in which:
            pads = np.where(layout.is_cell, self.frames[index] - self.rest, 0).reshape(layout.shape)
            power += (np.abs(np.fft.rfft2(pads, s=size)) ** 2).sum(axis=0)
        covariance = np.fft.irfft2(power, s=size) / (len(which) * max(1, int(layout.present.sum())))
        offsets = np.arange(1 - _REACH, _REACH)
        return np.asarray(covariance[np.ix_(offsets, offsets)])

    def prior(self, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the pooled covariance ``[n, n]`` of cells of one tile."""
        row = cells // self.layout.shape[2] % self.layout.rows
        col = cells % self.layout.shape[2]
        centre = _REACH - 1
        return np.asarray(self.pooled[row[:, None] - row + centre, col[:, None] - col + centre])

    def parts(
        self, fault_set: FaultSet, *, references: bool = False
    ) -> tuple[list[TilePart], Floats]:
        """Return the imputation of F tile by tile, and ``[D-k, pads]``, the map to the mean loads
        of the pads.

        Args:
            fault_set: F.
            references: add frames and residuals for the kernel regression.
        """
        average = _averages(fault_set, self.layout)
        if average.shape[1]:  # scaled to the variance of a cell
            some = self.frames[evenly(len(self.frames), _REFERENCE_FRAMES)][:, fault_set.healthy]
            spread = float((some @ average).std(axis=0).max())
            average *= float(np.sqrt(some.var(axis=0).mean())) / spread if spread else 1.0
        return list(self._parts(fault_set, average, references)), average

    def _parts(self, fault_set: FaultSet, average: Floats, references: bool) -> Iterator[TilePart]:
        d = self.layout.n_cells
        k = len(fault_set)
        missing = fault_set.mask
        place = np.empty(d, np.intp)  # of each cell among the healthy ones, or in F
        place[fault_set.healthy] = np.arange(d - k)
        place[missing] = np.arange(k)
        of_pads = np.arange(d - k, d - k + average.shape[1])
        means = (
            self.frames[:, fault_set.healthy] @ average
            if len(of_pads)
            else np.zeros((len(self.frames), 0), "f4")
        )
        absent = np.setdiff1d(np.flatnonzero(missing), np.flatnonzero(self.layout.present))
        for some in np.array_split(absent, -(-len(absent) // TILE**2)) if len(absent) else ():
            yield _constant(place[some], np.zeros(len(some), "f4"), np.zeros(len(some), "f4"))
        for tile in tiles(self.layout):
            gone = tile.outputs[missing[tile.outputs]]
            if len(gone):
                around = tile.inputs[~missing[tile.inputs]]
                known = np.concatenate([place[around], of_pads])
                yield self._part(known, place[gone], around, gone, means, references)

    def _part(
        self,
        known: NDArray[np.intp],
        missing: NDArray[np.intp],
        around: NDArray[np.intp],
        gone: NDArray[np.intp],
        means: Floats,
        references: bool,
    ) -> TilePart:
        if not len(known) or self.pooled[_REACH - 1, _REACH - 1] == 0:
            return _constant(missing, self.mean[gone], self.frames[:, gone].std(axis=0))
        cells = np.concatenate([around, gone])
        touched = np.flatnonzero(
            (np.abs(self.frames[:, cells] - self.rest[cells]) > _TOUCHED).any(axis=1)
        )
        which = touched[evenly(len(touched), _MOST_FRAMES)] if len(touched) else touched
        repeats = len(touched) / max(1, len(which))  # frames that each used one stands for
        centre = np.concatenate(
            [self.rest[around], np.median(means, axis=0) if means.size else np.zeros(0, "f4")]
        )
        x = np.concatenate([self.frames[which][:, around], means[which]], axis=1)
        y = self.frames[which][:, gone]
        z = np.concatenate([x - centre, y - self.rest[gone]], axis=1).astype(np.float64)
        prior = self._prior_with_pads(cells, len(around), means)
        weight, correction = self._fitted(z, len(known), self.fold[which], repeats, prior)
        weight = correction.gain[:, None] * weight
        bias = self.rest[gone] + correction.offset - weight @ centre
        chosen = (
            evenly(len(which), _REFERENCE_FRAMES)
            if references and len(which) > 1
            else np.zeros(0, np.intp)
        )
        roots = np.sqrt(np.maximum(x[chosen], 0))
        return TilePart(
            known,
            missing,
            weight.astype("f4"),
            bias.astype("f4"),
            correction.deviation.astype("f4"),
            roots,
            (y[chosen] - (x[chosen] @ weight.T + bias)).astype("f4"),
            bandwidth(roots) if len(chosen) else 1.0,
        )

    def _fitted(
        self,
        z: NDArray[np.float64],
        h: int,
        fold: NDArray[np.bool_],
        repeats: float,
        prior: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], Recalibration]:
        """Return the weights ``[m, h]`` of the first h variables of ``z [n, h + m]``, about rest,
        in the last m, and what corrects their predictions.

        Args:
            fold: bool ``[n]``, of each frame.
            repeats: frames that each of the n stands for.
            prior: covariance ``[h + m, h + m]``.
        """
        moments = [repeats * z[fold == side].T @ z[fold == side] for side in (False, True)]
        frames = [int((self.fold == side).sum()) for side in (False, True)]
        noise = _NOISE * self.pooled[_REACH - 1, _REACH - 1] * np.eye(len(prior))

        def weights(moment: NDArray[np.float64], n: int) -> NDArray[np.float64]:
            covariance = (moment + _PRIOR_FRAMES * prior) / (n + _PRIOR_FRAMES)
            return regression(covariance + noise, h)

        predicted = np.empty((len(z), z.shape[1] - h))
        for side in (0, 1):  # each fold by the moments of the other
            of = fold == bool(side)
            predicted[of] = z[of, :h] @ weights(moments[1 - side], frames[1 - side]).T
        weight = weights(moments[0] + moments[1], sum(frames))
        explained = np.maximum((weight * prior[h:, :h]).sum(axis=1), 0)
        correction = Recalibration.fit(
            predicted,
            z[:, h:],
            total=sum(frames),
            repeats=repeats,
            prior_error=np.maximum(np.diag(prior[h:, h:]) - explained, 0),
            prior_variance=explained,
            prior_frames=_GAIN_FRAMES,
        )
        return weight, correction

    def _prior_with_pads(
        self, cells: NDArray[np.intp], h: int, means: Floats
    ) -> NDArray[np.float64]:
        """Return the pooled covariance of [h cells, pad means, other cells]; pad means are
        independent a priori."""
        of_cells = self.prior(cells)
        n = means.shape[1]
        if not n:
            return of_cells
        prior = np.zeros((len(cells) + n, len(cells) + n))
        at = np.concatenate([np.arange(h), np.arange(h + n, len(prior))])
        prior[np.ix_(at, at)] = of_cells
        prior[np.arange(h, h + n), np.arange(h, h + n)] = np.maximum(
            means.var(axis=0), _NOISE * of_cells[0, 0]
        )
        return prior


def regression(covariance: NDArray[np.float64], h: int) -> NDArray[np.float64]:
    """Return the weights ``[m, h]`` of the last m variables on the first h, S_mh S_hh^-1."""
    from scipy.linalg import cho_factor, cho_solve

    return np.asarray(cho_solve(cho_factor(covariance[:h, :h]), covariance[:h, h:]).T)


def _constant(missing: NDArray[np.intp], value: Floats, deviation: Floats) -> TilePart:
    """Return the imputation of cells without predictors."""
    m = len(missing)
    nothing = np.zeros((0, 0), "f4")
    no_weight = np.zeros((m, 0), "f4")
    no_frames = np.zeros((0, m), "f4")
    return TilePart(
        np.zeros(0, np.intp), missing, no_weight, value, deviation, nothing, no_frames, 1.0
    )


def _averages(fault_set: FaultSet, layout: SensorLayout) -> Floats:
    """Return ``[D-k, pads]``, the map from healthy cells to the mean of each pad; 0 columns unless
    pads are few."""
    if not 2 <= layout.pads <= _MOST_PADS or not len(fault_set.healthy):
        return np.zeros((layout.n_cells - len(fault_set), 0), np.float32)
    pad = fault_set.healthy // (layout.rows * layout.shape[2])
    of_pad = (pad[:, None] == np.arange(layout.pads)).astype(np.float32)
    averages: Floats = of_pad / np.maximum(of_pad.sum(axis=0), 1)
    return averages
