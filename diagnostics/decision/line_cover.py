"""Wiring evidence: the cheapest set of wires and cells that explains what is seen.

Costs are negative log probabilities. A broken wire costs ``log 200`` (one wire in two hundred), one broken in its
middle ``log 2`` more, a single cell the log of how rare single faults are on this pad, and each cell behind a wire that
contradicts it ``log 1000``. A cell that is not faulty beyond doubt counts with

    w - log(1 - q + q exp w)

what a broken wire explains better than a single fault of chance q, or none; w is its log likelihood ratio. Many
doubtful cells on one wire may convict it together, but not each for a full one: at the edge of a contact neighbours are
wrong together. The set of least cost is found by trying all, or by integer programming; how rare single faults are is
then read off the solution, and the set sought again until it no longer changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import Line, SensorLayout

_LINE_COST = np.log(200.0)
_CUT_COST = np.log(2.0)
_CONTRADICTION_COST = np.log(1000.0)
_MOST_CONTRADICTIONS = 1  # of a wire that is still suspected
_RAREST, _MOST_COMMON = 0.005, 0.5  # bounds on the share of single faults, which few cells cannot tell exactly
# Cells with evidence against them that a wire must serve before it is blamed: so many, and this share of those on it
# that were put to the test at all.
_FEWEST_WITNESSES, _WITNESS_SHARE = 2, 1 / 3
_WITNESS = 2.5  # log ratio of a cell that counts as one
_TRIED = 0.3  # log ratio of a cell that was put to the test
# Correlation of what doubtful cells on one wire say, for each cell of its line, and at most: at the edge of a contact
# they are wrong together, and the longer the line the more of them lie along one edge.
_ALIKE, _MOST_ALIKE = 0.0125, 0.3
_LEAST = -1.0  # log ratio that one doubtful cell can bring
_LEADERLESS_COST = np.log(10.0)  # more, where each cell may as well be healthy: at an edge many are wrongly suspected
_PROVEN = np.log(9.0)  # log odds from which on a wire is named: single cells are the safer guess
_ROUNDS = 5
_WIRES = "row", "column", "converter"  # that may be broken; address wires: see ``addresses``
_FEW = 8  # wires of which all sets are tried

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Cause:
    """What explains some faulty cells: a wire, or nothing but themselves.

    Attributes:
        line: the wire; None for a single cell.
        cells: the cells it makes faulty, ascending.
        seen: those of them with evidence of their own; the others are inferred.
        probability: of the wire being at fault rather than all of ``seen`` by chance; 1 for single cells.
        whole: False where the wire is broken in its middle.
    """

    line: Line | None
    cells: tuple[int, ...]
    seen: tuple[int, ...]
    probability: float
    whole: bool = True


@dataclass(frozen=True)
class _Candidate:
    line: Line
    cells: NDArray[np.intp]  # behind the break
    cost: float
    whole: bool
    on_line: int  # cells on the wire, on either side of the break


def solve(
    faulty: NDArray[np.bool_],
    matching: NDArray[np.bool_],
    contradicting: NDArray[np.bool_],
    weight: NDArray[np.float64],
    doubt: NDArray[np.float64],
    layout: SensorLayout,
    common: float = 0.0,
) -> tuple[Cause, ...]:
    """Explain cells that misbehave *in the same way* (same kind, same value).

    Args:
        faulty: bool ``[D]``, those that are faulty beyond doubt.
        alike: bool ``[D]``, all that could be faulty in that way; holds ``faulty``.
        against: bool ``[D]``, the cells that contradict a broken wire. Cells that are neither may be inferred faulty.
        weight: float ``[D]``, log likelihood ratio faulty : healthy of each cell that is alike.
        doubt: float ``[D]``, how far a cell that is alike is from being faulty beyond doubt, 0 to 1; the least on a
            wire counts for all of it.
        layout: the array.
        common: how common single faults of one kind are at least.
    """
    if matching.sum() < 2:  # no wire serves so few
        return tuple(Cause(None, (cell,), (cell,), 1.0) for cell in np.flatnonzero(faulty).tolist())
    causes: list[Cause] = []
    pads = layout.grid(matching).any(axis=(1, 2))
    for pad in np.flatnonzero(pads).tolist():
        own = _one_pad(layout.rows, layout.cols, layout.present[pad].tobytes())
        first = pad * own.n_cells
        on = slice(first, first + own.n_cells)
        of_pad = _explain_pad(faulty[on], matching[on], contradicting[on], weight[on], doubt[on], own, common)
        causes += [_moved(cause, pad, first) for cause in of_pad]
    return tuple(causes)


def candidate_groups(
    matching: NDArray[np.bool_], contradicting: NDArray[np.bool_], weight: NDArray[np.float64], layout: SensorLayout
) -> list[NDArray[np.intp]]:
    """Return the cells that one fault would explain, where enough of them may bear witness.

    A wire that is broken, whole or at one end, or an address wire that is stuck: what it moves may read lines at rest.

    Args:
        alike, against: as for :func:`solve`.
        weight: float ``[D]``, a log likelihood ratio that is rather too high.
        layout: the array.
    """
    working, groups = matching & (weight >= _WITNESS), []
    pads = set(np.flatnonzero(layout.grid(working).sum(axis=(1, 2)) >= _FEWEST_WITNESSES).tolist())
    for line in layout.lines if pads else ():
        if line.pad in pads:
            groups += [
                cells[matching[cells]]
                for cells in _silenced(line, contradicting, layout)
                if working[cells].sum() >= _FEWEST_WITNESSES
            ]
    return groups


def _silenced(line: Line, contradicting: Mask, layout: SensorLayout) -> Sequence[NDArray[np.intp]]:
    """Return the cells of which none would live, and none does, for each way in which a wire may be at fault."""
    if line.kind in _WIRES:
        cells = layout.cells_on(line)
        return _ends(line, cells, contradicting) if contradicting[cells].any() else (cells,)
    moved = [layout.misaddressed(line, level)[0] for level in (0, 1)]
    return [cells for cells in moved if not contradicting[cells].any()]


def _ends(line: Line, cells: NDArray[np.intp], contradicting: Mask) -> tuple[NDArray[np.intp], ...]:
    """Return the cells of a wire beyond the last live one seen from either end, from there on; none if none lives.

    A converter has no middle to be broken in.
    """
    live = np.flatnonzero(contradicting[cells])
    if line.kind == "converter" or not len(live):
        return ()
    return cells[live[-1] + 1 :], cells[: live[0]][::-1]


@lru_cache(maxsize=64)
def _one_pad(rows: int, cols: int, present: bytes) -> SensorLayout:
    """Return one pad as an array of its own: most pads of a skin are alike, and none costs more for the others."""
    return SensorLayout(1, rows, cols, present=np.frombuffer(present, bool))


def _moved(cause: Cause, pad: int, first: int) -> Cause:
    """Return a cause on the only pad as one on ``pad``, whose first cell is ``first``."""
    cells, seen = (tuple(first + cell for cell in those) for those in (cause.cells, cause.seen))
    line = None if cause.line is None else replace(cause.line, pad=pad)
    return replace(cause, line=line, cells=cells, seen=seen)


def _explain_pad(
    faulty: NDArray[np.bool_],
    matching: NDArray[np.bool_],
    contradicting: NDArray[np.bool_],
    weight: NDArray[np.float64],
    doubt: NDArray[np.float64],
    layout: SensorLayout,
    common: float,
) -> list[Cause]:
    weight = np.where(matching, np.maximum(weight, _LEAST), 0.0)
    working = matching & (faulty | (weight >= _WITNESS))
    tried = matching & (faulty | (weight > _TRIED))
    doubt = np.where(faulty, 0.0, np.where(matching, doubt, 1.0))
    candidates = []
    lines = layout.lines if working.sum() >= 2 else ()
    for line in lines:
        if line.kind in _WIRES:
            candidates += _candidates(line, layout.cells_on(line), contradicting, working, tried, doubt)
    present = layout.present.ravel()
    found = np.flatnonzero(faulty & present)
    tested = int((contradicting & present).sum()) + len(found)
    blamed: list[_Candidate] = []
    counts = _counting(candidates, tried & ~faulty)
    support, cell_cost = weight, float(-np.log(_RAREST))
    singles = 0
    for _ in range(_ROUNDS if candidates else 0):
        cell_cost = float(-np.log(np.clip(max(singles / max(tested, 1), common), _RAREST, _MOST_COMMON)))
        support = counts * (weight - np.logaddexp(np.log1p(-np.exp(-cell_cost)), weight - cell_cost))
        blamed = _cheapest(candidates, found, faulty, support, cell_cost)
        behind = np.zeros(layout.n_cells, bool)
        for candidate in blamed:
            behind[candidate.cells] = True
        singles, before = int((~behind[found]).sum()), singles
        if singles == before:
            break
    causes: list[Cause] = []
    explained = np.zeros(layout.n_cells, bool)
    for c in blamed:
        cells = c.cells[~contradicting[c.cells]]
        gain = _gain(c, faulty, support, cell_cost)
        seen = cells[working[cells]]
        probability = float(1 / (1 + np.exp(-gain)))
        causes.append(Cause(c.line, tuple(cells.tolist()), tuple(seen.tolist()), probability, c.whole))
        explained[cells] = True
    causes += [Cause(None, (cell,), (cell,), 1.0) for cell in found.tolist() if not explained[cell]]
    return causes


def _candidates(
    line: Line,
    cells: NDArray[np.intp],
    contradicting: NDArray[np.bool_],
    working: NDArray[np.bool_],
    tried: NDArray[np.bool_],
    doubt: NDArray[np.float64],
) -> list[_Candidate]:
    """Return the wire as a whole, and broken in its middle with either end alive, as far as cells bear witness."""

    def proven(behind: NDArray[np.intp]) -> bool:
        return bool(working[behind].sum() >= max(_FEWEST_WITNESSES, _WITNESS_SHARE * float(tried[behind].sum())))

    def cost(behind: NDArray[np.intp]) -> float:
        return float(_LINE_COST + _LEADERLESS_COST * doubt[behind].min())

    contradictions = int(contradicting[cells].sum())
    found = []
    if contradictions <= _MOST_CONTRADICTIONS and proven(cells):
        found.append(_Candidate(line, cells, cost(cells) + _CONTRADICTION_COST * contradictions, True, len(cells)))
    for behind in _ends(line, cells, contradicting):  # from the first cell with evidence on
        seen = np.flatnonzero(working[behind])
        if len(seen):
            dead = np.sort(behind[seen[0] :])
            if proven(dead):
                found.append(_Candidate(line, dead, cost(dead) + _CUT_COST, False, len(cells)))
    return found


def _counting(candidates: Sequence[_Candidate], doubtful: Mask) -> NDArray[np.float64]:
    """Return what share of a doubtful cell's evidence counts, ``[D]``: the less, the more of them a wire serves.

    So many cells whose evidence correlates are worth as much as fewer independent ones (Kish's design effect).
    """
    counts = np.ones(len(doubtful))
    for c in candidates:
        n = int(doubtful[c.cells].sum())
        matching = min(_ALIKE * c.on_line, _MOST_ALIKE)
        counts[c.cells] = np.minimum(counts[c.cells], 1 / (1 + matching * max(n - 1, 0)))
    return counts


def _gain(c: _Candidate, faulty: NDArray[np.bool_], support: NDArray[np.float64], cell_cost: float) -> float:
    doubtful = c.cells[~faulty[c.cells]]
    return float(faulty[c.cells].sum()) * cell_cost + float(support[doubtful].sum()) - c.cost


def _cheapest(
    candidates: Sequence[_Candidate],
    found: NDArray[np.intp],
    faulty: NDArray[np.bool_],
    support: NDArray[np.float64],
    cell_cost: float,
) -> list[_Candidate]:
    """Return the wires of the cheapest set of wires and single cells that covers every faulty cell."""
    # A wire that costs more than it could save is in no cheapest set.
    candidates = [c for c in candidates if _gain(c, faulty, np.maximum(support, 0), cell_cost) > _PROVEN]
    if candidates:
        on_any = np.concatenate([c.cells for c in candidates])
        doubtful = np.unique(on_any[~faulty[on_any]])
        found = found[np.isin(found, on_any)]  # a cell on none of them explains itself, whatever they cost
        covers = np.array([np.isin(np.r_[found, doubtful], c.cells) for c in candidates])
        # What it saves if a wire through a cell is blamed.
        saves = np.r_[np.full(len(found), cell_cost), support[doubtful]]
        cheapest = cheapest_of_few if len(candidates) <= _FEW else cheapest_of_many
        chosen = cheapest(np.array([c.cost for c in candidates]), covers, saves)
        candidates = [c for c, is_chosen in zip(candidates, chosen, strict=True) if is_chosen]
    return [c for c in candidates if _gain(c, faulty, support, cell_cost) > _PROVEN]


def cheapest_of_few(cost: NDArray[np.float64], covers: NDArray[np.bool_], saves: NDArray[np.float64]) -> Mask:
    """Return the set of wires that saves most, bool ``[wires]``, by trying all sets.

    Args:
        cost: float ``[wires]``.
        covers: bool ``[wires, cells]``.
        saves: float ``[cells]``, each once, if a wire that covers it is in the set; may be negative.
    """
    sets = (np.arange(1 << len(cost))[:, None] >> np.arange(len(cost)) & 1).astype(np.float64)
    net = ((sets @ covers) > 0) @ saves - sets @ cost
    best: Mask = sets[int(net.argmax())] > 0
    return best


def cheapest_of_many(cost: NDArray[np.float64], covers: NDArray[np.bool_], saves: NDArray[np.float64]) -> Mask:
    """Return the same by integer programming: a hundred times slower for two wires, but as fast for fifty."""
    from scipy import sparse
    from scipy.optimize import Bounds, LinearConstraint, milp

    n, cells = covers.shape
    wires = sparse.csr_array(covers.T.astype(float))
    which, cell = sparse.csr_array(covers.astype(float)).nonzero()
    of_wire = sparse.csr_array((np.ones(len(which)), (np.arange(len(which)), which)), (len(which), n))
    of_cell = sparse.csr_array((np.ones(len(cell)), (np.arange(len(cell)), cell)), (len(cell), cells))
    # A cell counts if, and only if, a wire through it is blamed.
    only_if = LinearConstraint(sparse.hstack([wires, -sparse.eye_array(cells)]), lb=0)
    if_ = LinearConstraint(sparse.hstack([-of_wire, of_cell]), lb=0)
    objective = np.concatenate([cost, -saves])
    integral = np.ones(len(objective), dtype=int)
    solution = milp(objective, constraints=[only_if, if_], integrality=integral, bounds=Bounds(0, 1))
    chosen: Mask = np.asarray(solution.x)[:n] > 0.5  # feasible by construction: no wire at all is a solution
    return chosen
