"""From lines that read alike to their cause: a stuck address bit, a bridge of neighbours, or one line read twice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import Line, LineKind, address_bits

if TYPE_CHECKING:
    from diagnostics.evidence.duplicate_lines import DuplicatePair
    from diagnostics.evidence.stream_state import StreamState
    from diagnostics.healthy.prediction import Prediction

_CLEAR = 3.0  # log ratio: below it the data cannot tell which level a bit is stuck at


@dataclass(frozen=True)
class Aliasing:
    """Lines that read each other.

    Attributes:
        line: the address bit, or the first of two lines.
        value: the bit's level, or the number of the other line.
        cells: those that do not read themselves.
        onset: number of the first frame of it; 0: from the first on.
        witnesses: how often two lines agreed on a moving load.
        copies: pairs (line, line that it reads instead; -1: none is connected).
        doubtful: cells that may be the misread ones instead.
        alternatives: what else the data allow.
    """

    line: Line
    value: int
    cells: tuple[int, ...]
    onset: int
    witnesses: int
    copies: tuple[tuple[int, int], ...]
    alternatives: tuple[str, ...]
    doubtful: tuple[int, ...] = ()


def find_aliasing(stream: StreamState) -> tuple[Aliasing, ...]:
    """Name the causes of all lines that read alike."""
    pairs = stream.duplicates.duplicate_pairs(stream.reference.duplicates)
    found: list[Aliasing] = []
    for pad, kind in sorted({(j.pad, j.kind) for j in pairs}):
        found += _on_pad([j for j in pairs if (j.pad, j.kind) == (pad, kind)], stream)
    return tuple(found)


def _on_pad(pairs: list[DuplicatePair], stream: StreamState) -> list[Aliasing]:
    layout, pad, kind = stream.layout, pairs[0].pad, pairs[0].kind
    count = layout.rows if kind == "row" else layout.cols
    found = []
    left = list(pairs)
    for bit in range(address_bits(count)):
        by_bit = [j for j in left if j.second - j.first == 1 << bit and not j.first & 1 << bit]
        if not by_bit:
            continue
        others = [(i, i | 1 << bit) for i in range(count) if not i & 1 << bit and (i | 1 << bit) < count]
        differ_since = [stream.duplicates.apart_since(pad, kind, a, b) for a, b in others]
        # The bit was stuck when the first two lines were seen to agree, so no two lines of its may differ after that.
        refuted = max(differ_since) > min(j.seen_by for j in by_bit)
        # One pair of neighbours may as well be bridged: a bit joins more of them, wherever there are more.
        if refuted or (len(by_bit) == 1 and bit == 0 and len(others) > 1):
            continue
        left = [j for j in left if j not in by_bit]
        found.append(_stuck_bit(Line(pad, _address(kind), bit), by_bit, max(differ_since), stream))
    for j in left:
        line = Line(pad, kind, j.first)
        other = Line(pad, kind, j.second)
        cells = np.concatenate([layout.cells_on(line), layout.cells_on(other)])
        also = (f"{line} reads {other}, or the other way round: an address fault of this one line",)
        found.append(
            Aliasing(line, j.second, tuple(cells.tolist()), j.since, j.witnesses, ((j.first, j.second),), also)
        )
    return found


def _address(kind: LineKind) -> LineKind:
    return "row_address" if kind == "row" else "column_address"


def _stuck_bit(line: Line, pairs: list[DuplicatePair], onset: int, stream: StreamState) -> Aliasing:
    layout = stream.layout
    ratio = _level_ratio(line, onset, stream)
    level = int(ratio > 0)
    cells, sources = layout.misaddressed(line, level)
    across = 1 if line.kind == "row_address" else 2
    copies: dict[int, int] = {}
    for cell, source in zip(cells.tolist(), sources.tolist(), strict=True):
        read = layout.position(source)[across] if source >= 0 else -1
        moved = layout.position(cell)[across]
        copies[moved] = max(read, copies.get(moved, -1))  # a masked position reads nothing, the line still is read
    clear = abs(ratio) >= _CLEAR
    return Aliasing(
        line,
        level,
        tuple(cells.tolist()),
        onset,
        sum(j.witnesses for j in pairs),
        tuple(sorted(copies.items())),
        () if clear else (f"{line} is stuck at {1 - level}",),
        () if clear else tuple(layout.misaddressed(line, 1 - level)[0].tolist()),
    )


def _level_ratio(line: Line, onset: int, stream: StreamState) -> float:
    """Return the log ratio of a bit stuck at 1 against stuck at 0.

    Under each level other lines are read truly: which of the two sets makes sense, each cell given all the others?
    """
    layout = stream.layout
    ratio = 0.0
    for level, sign in ((0, -1.0), (1, 1.0)):
        wrong, sources = layout.misaddressed(line, level)
        true, empty = np.unique(sources[sources >= 0]), wrong[sources < 0]
        predictors = stream.present.copy()
        predictors[wrong] = False
        loaded = False
        for features, cells, judged, model in stream.views(onset):
            those = judged[np.isin(cells[judged], true)]
            if len(those):
                ratio += sign * _plausible(features, model.predict(features, predictors[cells]), those)
            loaded |= bool((features[:, 2, np.isin(cells, empty)] > 0).any())
        # What nothing is connected to never reads a load.
        if loaded:
            ratio -= sign * 10.0
    return ratio


def _plausible(features: NDArray[np.float32], expected: Prediction, cells: NDArray[np.intp]) -> float:
    """Return how well it fits what is expected whether the cells are loaded, and how hard, a log likelihood."""
    loaded = features[:, 2, cells] > 0
    p = np.where(loaded, 1 - expected.never[:, cells], expected.never[:, cells])
    # Student's t with 4 degrees of freedom, from its top; nothing where it is unknown how a cell reads under load.
    z = np.where(loaded, (features[:, 1, cells] - expected.mean[:, cells]) / expected.spread[cells], 0.0)
    hard = -2.5 * np.log1p(np.nan_to_num(z) ** 2 / 4)
    return float((np.log(np.maximum(p, 1e-3)) + hard).mean(axis=0).sum())
