"""Address aliasing: the cause of pairs of lines that read the same.

Detects a stuck address bit (pairs whose indices differ in one bit), a bridge of two neighbouring lines, and one line
read twice. A bit explains several pairs with one fault and is preferred; it is refuted when another pair of the same
bit differs later. The level of a bit follows from the log ratio of the plausibility of the lines that it leaves intact,
under the healthy model; below 3 both levels are reported. Lines that nothing loads are not detected here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.model import MIN_P_FLOOR
from diagnostics.healthy.prediction import OUTLIERS, log_student_t
from diagnostics.layout import Line, LineKind, address_bits
from diagnostics.preprocessing.levels import CERTAIN_RATIO, SUSPICIOUS

if TYPE_CHECKING:
    from diagnostics.evidence.duplicate_lines import DuplicatePair
    from diagnostics.evidence.stream_state import StreamState
    from diagnostics.healthy.prediction import Prediction


@dataclass(frozen=True)
class Aliasing:
    """Lines that read the same.

    Attributes:
        line: the address bit, or the first of two lines.
        value: the level of the bit, or the index of the other line.
        cells: indices of the cells that are misread.
        onset: number of the first frame; 0: from the start.
        coincidences: number of moving loads on which the lines agreed.
        copies: pairs (line, line that is read instead; -1: none is connected).
        alternatives: other causes that the data permit.
        doubtful: indices of the cells that may be the misread ones instead.
    """

    line: Line
    value: int
    cells: tuple[int, ...]
    onset: int
    coincidences: int
    copies: tuple[tuple[int, int], ...]
    alternatives: tuple[str, ...]
    doubtful: tuple[int, ...] = ()


def find_aliasing(stream: StreamState) -> tuple[Aliasing, ...]:
    """Return the causes of all lines that read the same."""
    pairs = stream.duplicates.duplicate_pairs(stream.reference.duplicates)
    found: list[Aliasing] = []
    for pad, kind in sorted({(pair.pad, pair.kind) for pair in pairs}):
        found += _on_pad([pair for pair in pairs if (pair.pad, pair.kind) == (pad, kind)], stream)
    return tuple(found)


def _on_pad(pairs: list[DuplicatePair], stream: StreamState) -> list[Aliasing]:
    layout, pad, kind = stream.layout, pairs[0].pad, pairs[0].kind
    count = layout.rows if kind == "row" else layout.cols
    found = []
    remaining = list(pairs)
    for bit in range(address_bits(count)):
        by_bit = [pair for pair in remaining if pair.second - pair.first == 1 << bit and not pair.first & 1 << bit]
        if not by_bit:
            continue
        others = [(i, i | 1 << bit) for i in range(count) if not i & 1 << bit and (i | 1 << bit) < count]
        differ_since = [stream.duplicates.apart_since(pad, kind, a, b) for a, b in others]
        # The bit was stuck when the first pair agreed, so no other pair of this bit may differ after that.
        refuted = max(differ_since) > min(pair.seen_by for pair in by_bit)
        # A single pair of neighbours is rather bridged: bit 0 would join all of them.
        if refuted or (len(by_bit) == 1 and bit == 0 and len(others) > 1):
            continue
        remaining = [pair for pair in remaining if pair not in by_bit]
        found.append(_stuck_bit(Line(pad, _address(kind), bit), by_bit, max(differ_since), stream))
    for pair in remaining:
        line = Line(pad, kind, pair.first)
        other = Line(pad, kind, pair.second)
        cells = np.concatenate([layout.cells_on(line), layout.cells_on(other)])
        also = (f"{line} reads {other}, or the other way round: an address fault of this one line",)
        found.append(
            Aliasing(
                line,
                pair.second,
                tuple(cells.tolist()),
                pair.since,
                pair.coincidences,
                ((pair.first, pair.second),),
                also,
            )
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
        copies[moved] = max(
            read, copies.get(moved, -1)
        )  # a position without a cell reads nothing, its line is read still
    clear = abs(ratio) >= SUSPICIOUS
    return Aliasing(
        line,
        level,
        tuple(cells.tolist()),
        onset,
        sum(pair.coincidences for pair in pairs),
        tuple(sorted(copies.items())),
        () if clear else (f"{line} is stuck at {1 - level}",),
        () if clear else tuple(layout.misaddressed(line, 1 - level)[0].tolist()),
    )


def _level_ratio(line: Line, onset: int, stream: StreamState) -> float:
    """Return the log ratio of a bit stuck at 1 against stuck at 0.

    Each level leaves other lines intact; the ratio compares their pseudo-likelihoods under the healthy model.
    """
    layout = stream.layout
    ratio = 0.0
    for level, sign in ((0, -1.0), (1, 1.0)):
        wrong, sources = layout.misaddressed(line, level)
        intact, empty = np.unique(sources[sources >= 0]), wrong[sources < 0]
        predictors = stream.present.copy()
        predictors[wrong] = False
        loaded = False
        for features, cells, modelled, model in stream.views(onset):
            scored = modelled[np.isin(cells[modelled], intact)]
            if len(scored):
                ratio += sign * _plausible(features, model(features, predictors[cells]), scored)
            loaded |= bool((features[:, 2, np.isin(cells, empty)] > 0).any())
        # An address without a line never reads a load.
        if loaded:
            ratio -= sign * CERTAIN_RATIO
    return ratio


def _plausible(features: NDArray[np.float32], expected: Prediction, cells: NDArray[np.intp]) -> float:
    """Return the log likelihood of being loaded, and of the load, summed over cells and averaged over events."""
    loaded = features[:, 2, cells] > 0
    p = np.where(loaded, 1 - expected.never[:, cells], expected.never[:, cells])
    # 0 where the spread is unknown.
    error = np.where(loaded, (features[:, 1, cells] - expected.mean[:, cells]) / expected.spread[cells], 0.0)
    load = log_student_t(np.nan_to_num(error), OUTLIERS)
    return float((np.log(np.maximum(p, MIN_P_FLOOR)) + load).mean(axis=0).sum())
