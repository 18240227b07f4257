"""The fills of large arrays: each missing cell is expected from the healthy ones around it, not from all of them.

The same two fills as in ``fills`` (the Gaussian conditional mean, and what it got wrong on the healthy frames most
alike), each for one tile of cells from those within a few rows and columns. Where there are a few pads, used together,
the mean load of each pad is asked as well. Time and memory grow with the cells, a covariance of all with their square.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import Windows, evenly
from adaptfault.imputation.linear import near_distance
from diagnostics import FaultSet, SensorLayout
from diagnostics.events.tiles import TILE, tiles

LARGE = 1000  # cells; with more, an array is filled tile by tile
_TOUCHED = 0.004  # on the 0..1 scale: a tile without such a reading has nothing to tell
_MOST_FRAMES, _REFERENCE_FRAMES = 600, 128  # of a tile: for its covariance, and to compare with
_MOST_PADS = 16  # of which the means are asked
_WIDTH = 0.05  # of the kernel, see fills.NearestFill
_VALUES = 1 << 24  # worked on at once
_NEVER = 1e9  # squared distance of a frame that is none

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class _Part:
    """The fill of one tile: ``known`` are places among the healthy cells and the pads, ``missing`` among F.

    ``weight [m, h]``, ``bias [m]``; ``roots [M, h]``, ``residuals [M, m]`` and ``width`` of the kernel.
    """

    known: NDArray[np.intp]
    missing: NDArray[np.intp]
    weight: Floats
    bias: Floats
    roots: Floats
    residuals: Floats
    width: float


@dataclass(frozen=True, eq=False)
class TiledStatistics:
    """What the fills of any F need to know of the healthy frames of a large array: the frames, and where cells lie.

    Attributes:
        frames: float32 ``[M, D]``, on the 0..1 scale.
        layout: the array.
    """

    frames: Floats
    layout: SensorLayout

    @classmethod
    def fit(cls, windows: Windows, layout: SensorLayout) -> TiledStatistics:
        """Take the frames of fault-free windows; they are not copied."""
        return cls(windows.x.reshape(-1, windows.x.shape[2]), layout)

    def linear(self, fault_set: FaultSet) -> TiledFill:
        """Return the linear fill for F."""
        return self._fill(fault_set, 0)

    def nearest(self, fault_set: FaultSet) -> TiledFill:
        """Return the linear fill for F with the nearest frames' residuals added."""
        return self._fill(fault_set, _REFERENCE_FRAMES)

    def _fill(self, fault_set: FaultSet, references: int) -> TiledFill:
        average = _averages(fault_set, self.layout)
        if average.shape[1]:  # means vary little: they are to weigh as much as a cell does
            some = self.frames[evenly(len(self.frames), _REFERENCE_FRAMES)][:, fault_set.healthy]
            spread = float((some @ average).std(axis=0).max())
            average *= float(np.sqrt(some.var(axis=0).mean())) / spread if spread else 1.0
        parts = list(self._parts(fault_set, average, references))
        sizes = len(parts), *(max((len(of) for of in each), default=0) for each in _lists(parts)), average.shape[1]
        fill = TiledFill(fault_set, sizes)
        fill.learn(parts, average)
        return fill

    def _parts(self, fault_set: FaultSet, average: Floats, references: int) -> Iterator[_Part]:
        d, k, missing = self.layout.n_cells, len(fault_set), fault_set.mask
        place = np.empty(d, np.intp)  # of each cell among the healthy ones, or among F
        place[fault_set.healthy], place[missing] = np.arange(d - k), np.arange(k)
        of_pads = np.arange(d - k, d - k + average.shape[1])
        means = self.frames[:, fault_set.healthy] @ average if len(of_pads) else np.zeros((len(self.frames), 0), "f4")
        absent = np.setdiff1d(np.flatnonzero(missing), np.flatnonzero(self.layout.present))
        for some in np.array_split(absent, -(-len(absent) // TILE**2)) if len(absent) else ():
            yield _constant(place[some])  # positions without a cell read nothing
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
        references: int,
    ) -> _Part:
        from scipy.linalg import cho_factor, cho_solve
        from sklearn.covariance import LedoitWolf

        here = self.frames[:, np.concatenate([around, gone])]
        touched = (here > _TOUCHED).any(axis=1)
        which = np.flatnonzero(touched)
        which = which[evenly(len(which), _MOST_FRAMES)] if len(which) else which
        which = np.concatenate([np.flatnonzero(~touched)[:1], which])  # and one in which nothing is
        x = np.concatenate([here[which, : len(around)], means[which]], axis=1)
        y = here[which, len(around) :]
        if len(which) < 3 or not len(known):
            return _constant(missing, here[:, len(around) :].mean(axis=0))
        estimate = LedoitWolf(store_precision=False).fit(np.concatenate([x, y], axis=1).astype(np.float64))
        h, covariance, mean = x.shape[1], estimate.covariance_, estimate.location_
        still = np.finfo(float).tiny ** 0.25  # as in fills
        within = covariance[:h, :h] + still * np.eye(h)
        weight = cho_solve(cho_factor(within), covariance[:h, h:]).T
        bias = mean[h:] - weight @ mean[:h]
        chosen = evenly(len(which), references) if references else np.zeros(0, np.intp)
        roots = np.sqrt(np.maximum(x[chosen], 0))
        residuals = y[chosen] - (x[chosen] @ weight.T + bias).astype(np.float32)
        width = _WIDTH * near_distance(roots) if references else 1.0
        return _Part(known, missing, weight.astype("f4"), bias.astype("f4"), roots, residuals, width)


def _constant(missing: NDArray[np.intp], value: Floats | None = None) -> _Part:
    """Return the fill of cells of which nothing is known but what they read on average."""
    m = len(missing)
    bias = np.zeros(m, "f4") if value is None else value
    nothing = np.zeros((0, 0), "f4")
    return _Part(np.zeros(0, np.intp), missing, np.zeros((m, 0), "f4"), bias, nothing, np.zeros((0, m), "f4"), 1.0)


def _averages(fault_set: FaultSet, layout: SensorLayout) -> Floats:
    """Return ``[D-k, pads]``: what the healthy cells are multiplied by to give the mean of each pad; few pads only."""
    if not 2 <= layout.pads <= _MOST_PADS:
        return np.zeros((layout.n_cells - len(fault_set), 0), np.float32)
    pad = fault_set.healthy // (layout.rows * layout.cols)
    of_pad = (pad[:, None] == np.arange(layout.pads)).astype(np.float32)
    averages: Floats = of_pad / np.maximum(of_pad.sum(axis=0), 1)
    return averages


def _lists(parts: Sequence[_Part]) -> tuple[list[Any], list[Any], list[Any]]:
    return [p.known for p in parts], [p.missing for p in parts], [p.roots for p in parts]


class TiledFill(nn.Module):
    """Front end from the healthy cells to all, tile by tile; healthy ones pass unchanged.

    Args:
        fault_set: F.
        sizes: tiles, and the most healthy cells, missing cells and frames to compare with of one; pads asked.
    """

    index: Tensor
    valid: Tensor
    slot: Tensor
    order: Tensor
    average: Tensor
    roots: Tensor
    squares: Tensor
    residuals: Tensor
    width: Tensor

    def __init__(self, fault_set: FaultSet, sizes: Sequence[int]) -> None:
        super().__init__()
        p, h, m, n, pads = self.sizes = tuple(int(size) for size in sizes)
        self.weight, self.bias = nn.Parameter(torch.zeros(p, m, h)), nn.Parameter(torch.zeros(p, m))
        self.register_buffer("index", torch.zeros(p, h, dtype=torch.long))
        self.register_buffer("valid", torch.zeros(p, h))
        self.register_buffer("slot", torch.zeros(len(fault_set), dtype=torch.long))
        self.register_buffer("average", torch.zeros(fault_set.n_cells - len(fault_set), pads))
        self.register_buffer("roots", torch.zeros(p, n, h))
        self.register_buffer("squares", torch.full((p, n), _NEVER))
        self.register_buffer("residuals", torch.zeros(p, n, m))
        self.register_buffer("width", torch.ones(p))
        # Position of each cell in [healthy, missing].
        order = np.argsort(np.concatenate([fault_set.healthy, np.flatnonzero(fault_set.mask)]))
        self.register_buffer("order", torch.from_numpy(order), persistent=False)

    def learn(self, parts: Sequence[_Part], average: Floats) -> None:
        """Take over the fills of all tiles."""
        _, _, m, _, _ = self.sizes
        with torch.no_grad():
            self.average.copy_(torch.from_numpy(average))
            for i, part in enumerate(parts):
                h, k, n = len(part.known), len(part.missing), len(part.roots)
                self.weight[i, :k, :h], self.bias[i, :k] = torch.from_numpy(part.weight), torch.from_numpy(part.bias)
                self.index[i, :h], self.valid[i, :h] = torch.from_numpy(part.known), 1.0
                self.slot[torch.from_numpy(part.missing)] = i * m + torch.arange(k)
                self.roots[i, :n, :h] = torch.from_numpy(part.roots)
                self.squares[i, :n] = self.roots[i, :n].square().sum(1)
                self.residuals[i, :n, :k] = torch.from_numpy(part.residuals)
                self.width[i] = part.width

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; what is filled in lies within 0..1, as a sensor would read."""
        p, h, m, n, _ = self.sizes
        frames = x.reshape(-1, x.shape[-1])
        at_once = max(1, _VALUES // max(1, p * (h + n + m)))
        filled = torch.cat([self._missing(some) for some in torch.split(frames, at_once)])
        return torch.cat([frames, filled.clamp(0.0, 1.0)], dim=-1)[:, self.order].reshape(*x.shape[:-1], -1)

    def _missing(self, x: Tensor) -> Tensor:
        """Map ``[B, D-k]`` to what the missing cells would read, ``[B, k]``."""
        around = (torch.cat([x, x @ self.average], dim=1)[:, self.index] * self.valid).transpose(0, 1)  # (P, B, h)
        filled = torch.baddbmm(self.bias[:, None], around, self.weight.transpose(1, 2))  # (P, B, m)
        if self.sizes[3]:
            loads, width = around.clamp_min(0.0), self.width[:, None, None]
            nearness = 2 * loads.sqrt() @ self.roots.transpose(1, 2) - self.squares[:, None]  # (P, B, M)
            # One more, as far as near neighbours usually lie, for which the linear fill is right.
            usual = loads.sum(-1, keepdim=True) - width / _WIDTH
            weights = torch.softmax(torch.cat([nearness, usual], dim=-1) / width, dim=-1)[..., :-1]
            filled = filled + weights @ self.residuals
        return filled.transpose(0, 1).reshape(len(x), -1)[:, self.slot]
