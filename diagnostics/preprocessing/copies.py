"""Recordings that are copies of others count once: they hold no new observation.

A copy has the readings of another recording, with noise of a step of the converter, cut at its
ends, or shifted by some frames. The frame of largest load and others are looked up among all
frames, by 8 random projections in a k-d tree. Where one is found again, the recordings are laid on
each other there and compared: in a copy, the cells that move differ by a small share of how they
move. Two recordings of one motion differ by more, as noise and contact are new.

Recordings in which nothing moves are no copies: healthy cells at rest read the same every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PROJECTIONS = 8
_LOOKED_UP = 8  # frames of a recording
_FOUND = 24  # places at most, for each of them
_PLACED = 3  # ways in which two recordings are laid on each other, at most
_TOLERANCE = 1e-3  # of the range of all readings
_LOADED = 8.0  # tolerances away from rest: readings that two recordings do not share by chance
_AGREE = 0.9  # share of the loaded readings of a frame that agree in a copy
# standard deviation of the difference, of that of the readings: at most in a copy
_DIFFERS = 0.2
_DIFFERS_SHORT = 0.1  # in fewer frames than that: short recordings are like each other by chance
_SHORT = 30
_KEPT = 50_000_000  # readings whose distance from rest is kept in memory: a size
_FEWEST = 64  # loaded readings, in so many frames at least:
_FRAMES = 4
_OVERLAP = 0.5  # of the shorter recording
_ODD = 50  # one frame of so many, and always one, tells nothing: it may be corrupt

Floats = NDArray[np.floating[Any]]


def find_copies(
    recordings: Sequence[Floats], present: NDArray[np.bool_] | None = None
) -> NDArray[np.intp]:
    """Return for each recording the longest one that it is a copy of, or itself, int ``[n]``.

    Args:
        recordings: ``[T, D]`` each; NaN = missing.
        present: bool ``[D]``, where there is a cell; None: everywhere.
    """
    n = len(recordings)
    own = np.arange(n)
    kept = [i for i in range(n) if len(recordings[i]) >= _FRAMES]
    if len(kept) < 2:
        return own
    # what no converter sends is like nothing else
    with np.errstate(over="ignore", invalid="ignore"):
        loads = _Loads(recordings, kept, present)
        links = _identical(loads, kept)
        for i, j, shift in _pairs(loads, kept):
            if _same(loads.of(i), loads.of(j), shift, loads.tolerance):
                links.append((i, j))
    if not links:
        return own
    from scipy.sparse import coo_array  # slow to import, and rarely needed
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(links))
    graph = coo_array((ones, np.array(links).T), shape=(n, n))
    _, group = connected_components(graph, directed=False)
    lengths = np.array([len(one) for one in recordings])
    order = np.lexsort((own, -lengths))  # the longest first, the first of equal ones
    _, first = np.unique(group[order], return_index=True)
    return np.asarray(order[first][group], np.intp)


class _Loads:
    """Readings of recordings away from rest; those of a large data set, which may fill half of the
    memory, are computed again each time.

    Args:
        recordings: ``[T, D]`` each.
        kept: numbers of those with frames.
        present: bool ``[D]``, where there is a cell; None: everywhere.
    """

    def __init__(
        self,
        recordings: Sequence[Floats],
        kept: Sequence[int],
        present: NDArray[np.bool_] | None,
    ) -> None:
        self._recordings = recordings
        self._absent = None if present is None or present.all() else ~present
        some = [recordings[i][:: max(1, len(recordings[i]) // 16)] for i in kept]
        self._rest = _rest(some)
        readings = sum(recordings[i].size for i in kept)
        self._kept: dict[int, NDArray[np.float32]] | None = {} if readings < _KEPT else None
        self.tolerance = _tolerance(np.concatenate([self._away(one) for one in some]).ravel())

    def of(self, i: int) -> NDArray[np.float32]:
        """Return those of a recording, ``[T, D]``; 0 where a reading is missing."""
        if self._kept is None:
            return self._away(self._recordings[i])
        if i not in self._kept:
            self._kept[i] = self._away(self._recordings[i])
        return self._kept[i]

    def frame(self, i: int, t: int) -> NDArray[np.float32]:
        """Return those of a frame, ``[D]``."""
        return self._away(self._recordings[i][t]) if self._kept is None else self.of(i)[t]

    def _away(self, readings: Floats) -> NDArray[np.float32]:
        away = (readings - self._rest).astype(np.float32)
        if self._absent is not None:
            away[..., self._absent] = 0  # such a position may read anything
        return np.nan_to_num(away, posinf=0, neginf=0)


def _tolerance(some: NDArray[np.float32]) -> float:
    """Return by how much a reading of a copy differs: a share of the range, or the step of the
    converter."""
    values = np.unique(some)
    if len(values) < 2:
        return 1.0  # nothing moves, whatever the tolerance
    low, high = np.quantile(some, (0.001, 0.999))
    few = len(values) < 0.1 * len(some)  # of decimal numbers no two are equal
    step = float(np.median(np.diff(values))) if few else 0.0
    return max(_TOLERANCE * float(high - low), step, 1e-12)


def _rest(some: Sequence[Floats]) -> NDArray[np.float64]:
    """Return the median reading of each cell, ``[D]``, over some frames of all recordings."""
    frames = np.concatenate(some).astype(np.float64)
    frames[~np.isfinite(frames)] = np.nan
    unread = np.isnan(frames).all(axis=0)
    frames[:, unread] = 0.0
    return np.asarray(np.nanmedian(frames, axis=0))


def _identical(loads: _Loads, kept: Sequence[int]) -> list[tuple[int, int]]:
    """Return each recording that moves with an earlier one that has the same readings."""
    first: dict[bytes, int] = {}
    links = []
    for i in kept:
        load = loads.of(i)
        if (load != load[:1]).any():
            links.append((i, first.setdefault(sha256(load.tobytes()).digest(), i)))
    return links


def _pairs(loads: _Loads, kept: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return (i, j, shift) where a frame t of recording i reads nearly as frame t + shift of j."""
    from scipy.spatial import cKDTree  # slow to import, and not needed to read recordings

    width = loads.of(kept[0]).shape[1]
    rng = np.random.default_rng(0)
    directions = rng.choice([-1.0, 1.0], (width, _PROJECTIONS)) / np.sqrt(width)
    projected = [loads.of(i) @ directions.astype(np.float32) for i in kept]
    owner = np.repeat(np.arange(len(kept)), [len(one) for one in projected])
    place = np.concatenate([np.arange(len(one)) for one in projected])
    tree = cKDTree(np.concatenate(projected))
    found: dict[tuple[int, int], set[int]] = {}
    for k, i in enumerate(kept):
        frames = _looked_up(loads.of(i), loads.tolerance)
        if not len(frames):
            continue
        near = 4 * loads.tolerance * np.sqrt(_PROJECTIONS)
        _, at = tree.query(
            projected[k][frames], k=min(_FOUND, len(owner)), distance_upper_bound=near
        )
        for t, places in zip(frames.tolist(), at.reshape(len(frames), -1), strict=True):
            hits = places[places < len(owner)]
            for hit in hits[owner[hits] != k].tolist():
                j = kept[owner[hit]]
                shifts = found.setdefault((i, j), set())
                if len(shifts) == _PLACED:
                    continue
                if _agree(loads.frame(i, t), loads.frame(j, place[hit]), loads.tolerance):
                    shifts.add(int(place[hit]) - t)
    return [(i, j, shift) for (i, j), shifts in found.items() for shift in sorted(shifts)]


def _looked_up(load: NDArray[np.float32], tolerance: float) -> NDArray[np.intp]:
    """Return some loaded frames, the one of largest load and others evenly over the rest."""
    total = np.abs(load).sum(axis=1)
    loaded = np.flatnonzero((np.abs(load) > _LOADED * tolerance).any(axis=1))
    if not len(loaded):
        return loaded
    evenly = loaded[np.linspace(0, len(loaded) - 1, _LOOKED_UP).astype(np.intp)]
    return np.unique([*evenly, int(total.argmax())])


def _same(
    one: NDArray[np.float32], other: NDArray[np.float32], shift: int, tolerance: float
) -> bool:
    """Return whether frame t of ``one`` reads as frame t + ``shift`` of the other."""
    begin = max(0, -shift)
    end = min(len(one), len(other) - shift)
    if end - begin < _OVERLAP * min(len(one), len(other)):
        return False
    a = one[begin:end]
    b = other[begin + shift : end + shift]
    range_a = np.ptp(a, axis=0)
    moving = np.maximum(range_a, np.ptp(b, axis=0)) > _LOADED * tolerance
    a = a[:, moving]
    b = b[:, moving]
    # one frame of full scale, which is corrupt, would be all that moves
    difference = _without_odd(np.square(a - b))
    most = _DIFFERS_SHORT if end - begin < _SHORT else _DIFFERS
    if difference > most**2 * float(np.square(range_a[moving]).sum()):
        return False  # more than any recording of this range moves: most pairs end here
    loaded = np.maximum(np.abs(a), np.abs(b)) > _LOADED * tolerance
    if loaded.sum() < _FEWEST or loaded.any(axis=1).sum() < _FRAMES:
        return False
    usual = _without_odd(np.square(a - np.median(a, axis=0)))
    return difference <= most**2 * usual


def _without_odd(squares: NDArray[np.float32]) -> float:
    """Return the sum over the cells of the mean over the frames, ``[T, D]``, without the largest
    frames."""
    frames = np.sort(squares.sum(axis=1))
    return float(frames[: -max(1, len(frames) // _ODD)].mean())


def _agree(a: NDArray[np.float32], b: NDArray[np.float32], tolerance: float) -> bool:
    """Return whether the readings of two frames that are away from rest in one are the same."""
    loaded = np.maximum(np.abs(a), np.abs(b)) > _LOADED * tolerance
    return bool(loaded.any()) and bool((np.abs(a - b)[loaded] <= 4 * tolerance).mean() >= _AGREE)
