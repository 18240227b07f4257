"""Restores whole frames from the healthy cells, for software that reads frames. Numpy only, no
torch."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.windows import evenly, hold_missing, scale
from adaptfault.imputation.cross_fitted import CrossFitted, by_missing
from adaptfault.imputation.recalibration import two_folds
from adaptfault.imputation.tiled_statistics import LARGE, TiledStatistics
from diagnostics import FaultSet, SensorLayout
from diagnostics.faults import Cells

_MOST_FRAMES = 20_000  # of the fit; more are thinned evenly
_PLANS = 64  # fault sets whose affine maps are cached

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Map:
    """Affine map from cells ``known [h]`` to cells ``missing [m]``, and the standard deviation of
    its error ``[m]``."""

    known: NDArray[np.intp]
    missing: NDArray[np.intp]
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    deviation: NDArray[np.float32]


class Restorer:
    """Replaces missing and faulty readings by their conditional mean given the healthy cells.

    The prediction is the Gaussian conditional mean (of the whole array, or on more than 1000 cells
    of the surroundings of each cell), recalibrated on held-out recordings: where the healthy cells
    predict nothing, it is the mean of the cell, and the deviation is the deviation of the cell.

    Readings are in the unit of the layout. Restored ones are clipped to 0..full scale.

    Args:
        layout: the array.

    Attributes:
        mean_: float64 ``[D]``, mean healthy reading of each cell.

    Raises:
        ValueError: a recording or F of another number of cells, or a call before :meth:`fit`.
    """

    def __init__(self, layout: SensorLayout) -> None:
        self.layout = layout

    def fit(self, recordings: NDArray[Any] | Sequence[NDArray[Any]]) -> Restorer:
        """Estimate from healthy recordings, ``[T, D]`` or a list of them; NaN counts as the last
        reading of the cell.

        Raises:
            ValueError: fewer than 4 frames, or recordings that do not fit the layout.
        """
        frames = [
            hold_missing(
                scale(self.layout.check_recording(recording, f"recording {i}"), self.layout)
            )
            for i, recording in enumerate(self.layout.recordings(recordings))
        ]
        total = sum(map(len, frames))
        if total < 4:
            raise ValueError(f"a restorer needs at least 4 healthy frames, got {total}")
        x = np.nan_to_num(np.concatenate(frames))
        numbers = np.repeat(np.arange(len(frames)), [len(of) for of in frames])
        which = evenly(len(x), _MOST_FRAMES)
        x = x[which]
        fold = two_folds(numbers[which])
        if self.layout.n_cells > LARGE:
            self._tiled: TiledStatistics | None = TiledStatistics(x, fold, self.layout)
        else:
            self._tiled = None
            self._whole = CrossFitted(x, fold)
        self.mean_ = x.mean(axis=0, dtype=np.float64) * self.layout.full_scale
        self._plans: OrderedDict[bytes, tuple[_Map, ...]] = OrderedDict()
        return self

    @overload
    def transform(
        self,
        recording: ArrayLike,
        fault_set: Cells | None = ...,
        *,
        return_std: Literal[False] = ...,
    ) -> Floats: ...
    @overload
    def transform(
        self, recording: ArrayLike, fault_set: Cells | None = ..., *, return_std: Literal[True]
    ) -> tuple[Floats, Floats]: ...
    def transform(
        self, recording: ArrayLike, fault_set: Cells | None = None, *, return_std: bool = False
    ) -> Floats | tuple[Floats, Floats]:
        """Return ``recording [T, D]`` with the cells in F and all NaN restored.

        Args:
            recording: readings in the unit of the layout; the cells in F may hold anything.
            fault_set: F, a fault set or a list of cells; None restores NaN only.
            return_std: also return the standard deviation of each reading, ``[T, D]``: 0 where it
                is not restored.
        """
        frames = np.array(self.layout.check_recording(recording), dtype=np.float64)
        missing = self._missing(frames, fault_set)
        deviation = np.zeros_like(frames)
        for of, mask in by_missing(missing):
            for part in self._plan(mask):
                healthy = frames[np.ix_(of, part.known)].astype(np.float32)
                frames[np.ix_(of, part.missing)] = self._clip(healthy @ part.weight.T + part.bias)
                deviation[np.ix_(of, part.missing)] = part.deviation
        return (frames, deviation) if return_std else frames

    def update(self, frame: ArrayLike, fault_set: Cells | None = None) -> Floats:
        """Return one ``frame [D]`` with the cells in F and all NaN restored.

        The first frame with a new set of missing cells takes the time of a linear solve; the next
        ones take one matrix-vector product.
        """
        x = self.layout.check_frame(frame).copy()
        mask = self._missing(x, fault_set)
        if mask.any():
            known = x.astype(np.float32)
            for part in self._plan(mask):
                x[part.missing] = self._clip(part.weight @ known[part.known] + part.bias)
        return x

    def deviation(self, fault_set: Cells) -> Floats:
        """Return the standard deviation of the error of each cell with F missing, ``[D]``; 0 for
        healthy cells."""
        out = np.zeros(self.layout.n_cells)
        for part in self._plan(self._missing(out, fault_set)):
            out[part.missing] = part.deviation
        return out

    def _clip(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        clipped: NDArray[np.float32] = np.minimum(np.maximum(values, 0), self.layout.full_scale)
        return clipped

    def _missing(self, frames: Floats, fault_set: Cells | None) -> NDArray[np.bool_]:
        if not hasattr(self, "mean_"):
            raise ValueError("this restorer is not fitted: call fit with healthy recordings first")
        missing = np.isnan(frames)
        if fault_set is not None:
            missing |= FaultSet.of(fault_set, self.layout.n_cells).mask
        return missing

    def _plan(self, mask: NDArray[np.bool_]) -> tuple[_Map, ...]:
        """Return the maps for a mask ``[D]`` of missing cells, from the cache if they were used
        recently."""
        key = mask.tobytes()
        plan = self._plans.get(key)
        if plan is None:
            fault_set = FaultSet.of(mask, len(mask))
            plan = (
                self._tile_maps(fault_set) if self._tiled is not None else (self._map(fault_set),)
            )
            self._plans[key] = plan
            if len(self._plans) > _PLANS:
                self._plans.popitem(last=False)
        else:
            with suppress(KeyError):  # another thread has just dropped it
                self._plans.move_to_end(key)
        return plan

    def _map(self, fault_set: FaultSet) -> _Map:
        return self._in_unit(
            fault_set.healthy, np.flatnonzero(fault_set.mask), *self._whole.affine(fault_set)
        )

    def _tile_maps(self, fault_set: FaultSet) -> tuple[_Map, ...]:
        assert self._tiled is not None  # for the type checker
        healthy = fault_set.healthy
        missing = np.flatnonzero(fault_set.mask)
        parts, average = self._tiled.parts(fault_set)
        maps = []
        for part in parts:
            cells = part.known < len(healthy)
            known = healthy[part.known[cells]]
            weight = part.weight[:, cells]
            if not cells.all():  # the mean loads of the pads, written as sums over their cells
                dense = part.weight[:, ~cells] @ average.T
                dense[:, part.known[cells]] += weight
                known = healthy
                weight = dense
            maps.append(
                self._in_unit(known, missing[part.missing], weight, part.bias, part.deviation)
            )
        return tuple(maps)

    def _in_unit(
        self,
        known: NDArray[np.intp],
        missing: NDArray[np.intp],
        weight: NDArray[np.floating],
        bias: NDArray[np.floating],
        deviation: NDArray[np.floating],
    ) -> _Map:
        full_scale = self.layout.full_scale
        return _Map(
            known,
            missing,
            np.ascontiguousarray(weight, dtype=np.float32),
            (bias * full_scale).astype(np.float32),
            (deviation * full_scale).astype(np.float32),
        )
