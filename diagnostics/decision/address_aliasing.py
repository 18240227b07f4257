"""Address aliasing: the cause of pairs of lines that read the same.

Detects a stuck address bit (pairs whose indices differ in one bit), a bridge of two neighbouring
lines, and one line read twice. A bit explains several pairs with one fault and is preferred; it is
refuted when another pair of the same bit differs later. The level of a bit follows from the log
ratio of the plausibility of the lines that it leaves intact, under the model of the array; below 3
both levels are reported. Lines that nothing loads are not detected here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import address_bits
from diagnostics.preprocessing.levels import CERTAIN_RATIO, SUSPICIOUS
from diagnostics.wiring import Line

if TYPE_CHECKING:
    from diagnostics.evidence.duplicate_lines import DuplicatePair
    from diagnostics.evidence.stream_state import StreamState

Cells = NDArray[np.intp]
LogLikelihood = Callable[[int, NDArray[np.bool_]], tuple[NDArray[np.floating], NDArray[np.bool_]]]


def find_aliasing(
    stream: StreamState, log_likelihood: LogLikelihood
) -> tuple[list[Fault], NDArray[np.bool_]]:
    """Return the causes of all lines that read the same, and the cells that are or may be misread,
    bool ``[D]``.

    Args:
        stream: the log.
        log_likelihood: of a frame and known cells (bool ``[D]``): mean log likelihood of what each
            cell did since this frame, given the known ones, and whether it was loaded, ``[D]``
            each.
    """
    pairs = stream.duplicates.duplicate_pairs(stream.reference.duplicates.most)
    if stream.crosstalk is not None:  # lines that nothing touches read the same
        pairs = []
    faults = list[Fault]()
    misread = np.zeros(stream.layout.n_cells, bool)
    for of in sorted({(pair.pad, pair.kind) for pair in pairs}):
        for fault, cells in _on_pad(
            [pair for pair in pairs if (pair.pad, pair.kind) == of], stream, log_likelihood
        ):
            faults.append(fault)
            misread[cells] = True
    return faults, misread


def _on_pad(
    pairs: list[DuplicatePair], stream: StreamState, log_likelihood: LogLikelihood
) -> Iterator[tuple[Fault, Cells]]:
    """Yield the causes of pairs of rows, or of columns, of one pad, each with the cells that it may
    misread."""
    layout = stream.layout
    pad = pairs[0].pad
    kind = pairs[0].kind
    count = layout.rows if kind == "row" else layout.cols
    for bit in range(address_bits(count)):
        joined = [
            (i, i | 1 << bit) for i in range(count) if not i & 1 << bit and (i | 1 << bit) < count
        ]
        by_bit = [pair for pair in pairs if (pair.first, pair.second) in joined]
        if not by_bit:
            continue
        onset = max(
            stream.duplicates.apart_since(pad, kind, first, second) for first, second in joined
        )
        # The bit was stuck when the first pair agreed, so no other pair of this bit may differ
        # after that.
        refuted = onset > min(pair.seen_by for pair in by_bit)
        # A single pair of neighbours is rather bridged: bit 0 would join all of them.
        if refuted or (len(by_bit) == 1 and bit == 0 and len(joined) > 1):
            continue
        pairs = [pair for pair in pairs if pair not in by_bit]
        yield _stuck_bit(
            Line(pad, "row_address" if kind == "row" else "column_address", bit),
            by_bit,
            onset,
            stream,
            log_likelihood,
        )
    for pair in pairs:
        line = Line(pad, kind, pair.first)
        other = Line(pad, kind, pair.second)
        cells = np.concatenate([layout.cells_on(line), layout.cells_on(other)])
        text = f"{line} and {kind} {other.index} are bridged: both always read the same"
        check = f"the solder and the flex cable between {kind}s {line.index} and {other.index}"
        also = (f"{line} reads {other}, or the other way round: an address fault of this one line",)
        yield (
            _fault(line, other.index, cells, pair.since, [pair], text, check, also, layout.rate),
            cells,
        )


def _stuck_bit(
    line: Line,
    pairs: list[DuplicatePair],
    onset: int,
    stream: StreamState,
    log_likelihood: LogLikelihood,
) -> tuple[Fault, Cells]:
    """Return the fault of an address bit, and the cells that it may misread: at either level if
    that is in doubt."""
    layout = stream.layout
    ratio = _level_ratio(line, onset, stream, log_likelihood)
    level = int(ratio > 0)
    cells, sources = layout.misaddressed(line, level)
    across, name = (1, "row") if line.kind == "row_address" else (2, "column")
    copies: dict[int, int] = {}  # line that is read instead, by line; -1: none is connected
    for cell, source in zip(cells.tolist(), sources.tolist(), strict=True):
        read = layout.position(source)[across] if source >= 0 else -1
        moved = layout.position(cell)[across]
        # A position without a cell reads nothing, its line is read still.
        copies[moved] = max(read, copies.get(moved, -1))
    reads = ", ".join(
        f"{name} {i} reads {f'{name} {j}' if j >= 0 else 'nothing'}"
        for i, j in sorted(copies.items())
    )
    clear = abs(ratio) >= SUSPICIOUS
    also = () if clear else (f"{line} is stuck at {1 - level}",)
    misread = cells if clear else np.union1d(cells, layout.misaddressed(line, 1 - level)[0])
    text = f"{line} is stuck at {level}: {reads}"
    check = f"the {name} multiplexer and its address wires"
    return _fault(line, level, cells, onset, pairs, text, check, also, layout.rate), misread


def _fault(
    line: Line,
    value: int,
    cells: Cells,
    onset: int,
    pairs: list[DuplicatePair],
    text: str,
    check: str,
    alternatives: tuple[str, ...],
    rate: float,
) -> Fault:
    """Return the fault with its reason: ``text``, since when, how often the lines agreed, and what
    to ``check``."""
    coincidences = sum(pair.coincidences for pair in pairs)
    by_chance = -sum(pair.coincidences * np.log2(pair.chance) for pair in pairs)  # in bits
    since = "" if onset == 0 else f" from frame {onset} on ({onset / rate:.1f} s)"
    return Fault(
        FaultKind.ALIAS,
        tuple(cells.tolist()),
        line=line,
        value=value,
        onset=onset or None,
        probability=1.0 - 0.5 ** float(min(by_chance, 30.0)),
        reason=f"{text}{since}; they agreed on {coincidences} moving loads; check {check}",
        evidence=coincidences,
        alternatives=alternatives,
    )


def _level_ratio(
    line: Line, onset: int, stream: StreamState, log_likelihood: LogLikelihood
) -> float:
    """Return the log ratio of a bit stuck at 1 against stuck at 0.

    Each level leaves other lines intact; the ratio compares their pseudo-likelihoods under the
    model of the array.
    """
    layout = stream.layout
    ratio = 0.0
    for level, sign in ((0, -1.0), (1, 1.0)):
        wrong, sources = layout.misaddressed(line, level)
        intact = np.unique(sources[sources >= 0])
        empty = wrong[sources < 0]
        predictors = stream.present.copy()
        predictors[wrong] = False
        likely, loaded = log_likelihood(onset, predictors)
        ratio += sign * float(likely[intact].sum())
        # An address without a line never reads a load.
        if loaded[empty].any():
            ratio -= sign * CERTAIN_RATIO
    return ratio
