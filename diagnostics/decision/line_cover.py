"""Line cover: the most probable set of broken wires and single faulty cells that explains the
findings.

Costs are negative log probabilities: log 200 for a broken wire, -log q for a single fault of
prevalence q, and log 1000 for each working cell on a broken wire. A cell that is not certainly
faulty supports its wire with

    c (w - log(1 - q + q exp w)),        c = 1 / (1 + rho (n - 1))

the log ratio of "broken wire" against "single fault or none", where w is its log likelihood ratio
and c discounts the correlation rho of the n uncertain cells on the wire (design effect, Kish 1965):
neighbours at the edge of a contact err together. Minimum weight set cover, solved by enumeration or
by ``scipy.optimize.milp``; q is re-estimated from the solution until it no longer changes, between
1 in 200 and one half. Wires with fewer than three tested cells, or two thirds of those behind the
break, are not found. Wires that are more likely broken than not, at odds below 9, are returned as
possible: one more contact tells.

With declared wiring the wires are buses and nested groups (``SensorLayout.groups``), which are
broken as a whole. Of those that explain the same cells the innermost is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import EXPECTED_LATE, MAJORITY, RARE, SUSPICIOUS, TESTED
from diagnostics.wiring import Line

# of a broken wire, and of the rarest single fault: few cells cannot estimate it
_LINE_COST = -np.log(EXPECTED_LATE)
_MOST_CONTRADICTIONS = 1  # working cells on a wire that can still be broken
_MIN_OF_GROUP = 2  # supporting cells of a group that is tested again as a whole
_MIN_SUPPORT = 3  # supporting cells of a broken wire, or two thirds of those behind the break
# rho per cell on the line (long lines run along edges), and at most
_CORRELATION = 0.0125
_MAX_CORRELATION = 0.3
PROVEN = np.log(
    9.0
    # log odds from which on a wire is reported, without a certain cell twice that: edges err
    # together
)
_ROUNDS = 5  # of re-estimating q, at most: a size
# Wires that may be broken; address wires: see ``address_aliasing``.
_WIRES = "row", "column", "converter", "position", "bus", "group"
_IN_MIDDLE = "row", "column"  # wires that may be broken in their middle
_FEW = 8  # wires up to which all sets are enumerated: a size

Cells = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Cause:
    """The cause of some faulty cells: a wire, or a single fault.

    Attributes:
        line: the wire; None for a single cell.
        cells: the cells it makes faulty, ascending.
        seen: those of them with evidence of their own; the others are inferred.
        probability: P(the wire is broken rather than all of ``seen`` by chance); 1 for single
            cells.
        whole: False where the wire is broken in its middle.
        proven: False for a wire that is only possible; its cells are single faults too, or work.
    """

    line: Line | None
    cells: tuple[int, ...]
    seen: tuple[int, ...]
    probability: float
    whole: bool = True
    proven: bool = True


@dataclass(frozen=True)
class _Candidate:
    line: Line
    cells: Cells  # behind the break
    cost: float
    whole: bool
    on_line: int  # cells on the wire, on either side of the break


def solve(
    faulty: Mask,
    consistent: Mask,
    contradicting: Mask,
    weight: Floats,
    layout: SensorLayout,
    common: float = 0.0,
) -> tuple[Cause, ...]:
    """Return the causes of cells with *the same* fault (same kind, same value).

    Args:
        faulty: bool ``[D]``, certainly faulty cells.
        consistent: bool ``[D]``, cells that could have this fault; includes ``faulty``.
        contradicting: bool ``[D]``, cells that contradict a broken wire. Cells that are neither may
            be inferred faulty.
        weight: float ``[D]``, log likelihood ratio faulty : healthy of each consistent cell.
        layout: the array.
        common: lower limit of the prevalence of single faults of one kind.
    """
    causes: list[Cause] = []
    # Pads are independent of each other; a group may extend over several.
    part = layout.pad_of if layout.is_matrix else np.zeros(layout.n_cells, np.intp)
    for i in np.unique(part[consistent]).tolist():
        on = layout.is_cell & (part == i)
        lines = [line for line in layout.lines if line.pad == i or not layout.is_matrix]
        causes += _explain(
            faulty & on, consistent & on, contradicting & on, weight, layout, lines, common
        )
    return tuple(causes)


def _least_support(behind: int) -> int:
    """Return how many cells must support a break with so many cells behind it."""
    return max(_MIN_OF_GROUP, min(_MIN_SUPPORT, -(-2 * behind // 3)))


def _ends(line: Line, cells: Cells, contradicting: Mask) -> tuple[Cells, ...]:
    """Return the cells beyond the last working one, seen from either end of a wire; none if none
    works.

    A converter, bus or group cannot be broken in its middle.
    """
    alive = np.flatnonzero(contradicting[cells])
    if line.kind not in _IN_MIDDLE or not len(alive):
        return ()
    return cells[alive[-1] + 1 :], cells[: alive[0]][::-1]


def _explain(
    faulty: Mask,
    consistent: Mask,
    contradicting: Mask,
    weight: Floats,
    layout: SensorLayout,
    lines: Sequence[Line],
    common: float,
) -> list[Cause]:
    """Return the causes of cells served by ``lines``; see :func:`solve`."""
    weight = np.where(consistent, weight, 0.0)
    supporting = consistent & (faulty | (weight >= SUSPICIOUS))
    tested_cells = consistent & (faulty | (weight > TESTED))
    candidates = []
    for line in lines if supporting.any() else ():
        if line.kind in _WIRES:
            candidates += _candidates(
                line, layout.cells_on(line), contradicting, supporting, faulty
            )
    if not layout.is_matrix:  # of groups that explain the same cells, the innermost: it comes first
        candidates = list(
            {tuple(c.cells[supporting[c.cells]].tolist()): c for c in candidates[::-1]}.values()
        )
    found = np.flatnonzero(faulty)
    tested = int(contradicting.sum()) + len(found)
    chosen_wires: list[_Candidate] = []
    discount = _discount(candidates, tested_cells & ~faulty)
    support = weight
    cell_cost = float(_LINE_COST)
    singles = 0
    for _ in range(_ROUNDS if candidates else 0):
        prevalence = np.clip(max(singles / max(tested, 1), common), np.exp(-_LINE_COST), MAJORITY)
        cell_cost = float(-np.log(prevalence))
        support = discount * (
            weight - np.logaddexp(np.log1p(-np.exp(-cell_cost)), weight - cell_cost)
        )
        chosen_wires = _cheapest(candidates, found, faulty, support, cell_cost)
        behind = np.zeros(layout.n_cells, bool)
        for candidate in chosen_wires:
            behind[candidate.cells] = True
        singles, before = int((~behind[found]).sum()), singles
        if singles == before:
            break

    def cause(c: _Candidate, faulty: Mask, proven: bool) -> Cause:
        cells = c.cells[~contradicting[c.cells]]
        seen = cells[supporting[cells]]
        broken = float(expit(_gain(c, faulty, support, cell_cost)))
        return Cause(c.line, tuple(cells.tolist()), tuple(seen.tolist()), broken, c.whole, proven)

    causes = [cause(c, faulty, True) for c in chosen_wires]
    explained = np.zeros(layout.n_cells, bool)
    explained[[cell for one in causes for cell in one.cells]] = True
    left = faulty & ~explained
    causes += [Cause(None, (cell,), (cell,), 1.0) for cell in np.flatnonzero(left).tolist()]
    support = np.where(explained, 0.0, support)
    more = _cheapest(candidates, np.flatnonzero(left), left, support, cell_cost, 0.0)
    return causes + [cause(c, left, False) for c in more]


def _candidates(
    line: Line,
    cells: Cells,
    contradicting: Mask,
    supporting: Mask,
    faulty: Mask,
) -> list[_Candidate]:
    """Return the wire broken as a whole, and in its middle with either end working, where enough
    cells support it."""

    def proven(behind: Cells) -> bool:
        return bool(supporting[behind].sum() >= _least_support(len(behind)))

    def cost(behind: Cells) -> float:
        return float(_LINE_COST + (0.0 if faulty[behind].any() else PROVEN))

    contradictions = int(contradicting[cells].sum())
    found = []
    if contradictions <= _MOST_CONTRADICTIONS and proven(cells):
        found.append(
            _Candidate(
                line, cells, cost(cells) + np.log(1 / RARE) * contradictions, True, len(cells)
            )
        )
    for behind in _ends(line, cells, contradicting):  # from the first supporting cell on
        seen = np.flatnonzero(supporting[behind])
        if len(seen):
            dead = np.sort(behind[seen[0] :])
            if proven(dead):
                found.append(_Candidate(line, dead, cost(dead), False, len(cells)))
    return found


def _discount(candidates: Sequence[_Candidate], uncertain: Mask) -> Floats:
    """Return the discount c of the evidence of each uncertain cell, ``[D]``: the inverse of Kish's
    design effect."""
    discount = np.ones(len(uncertain))
    for c in candidates:
        n = int(uncertain[c.cells].sum())
        correlation = min(_CORRELATION * c.on_line, _MAX_CORRELATION)
        discount[c.cells] = np.minimum(discount[c.cells], 1 / (1 + correlation * max(n - 1, 0)))
    return discount


def _gain(c: _Candidate, faulty: Mask, support: Floats, cell_cost: float) -> float:
    uncertain = c.cells[~faulty[c.cells]]
    return float(faulty[c.cells].sum()) * cell_cost + float(support[uncertain].sum()) - c.cost


def _cheapest(
    candidates: Sequence[_Candidate],
    found: Cells,
    faulty: Mask,
    support: Floats,
    cell_cost: float,
    least: float = PROVEN,
) -> list[_Candidate]:
    """Return the wires of the cover of least cost, with log odds above ``least``."""
    # A wire that costs more than it can save is in no optimal cover.
    candidates = [
        c for c in candidates if _gain(c, faulty, np.maximum(support, 0), cell_cost) > least
    ]
    if candidates:
        on_any = np.concatenate([c.cells for c in candidates])
        uncertain = np.unique(on_any[~faulty[on_any]])
        found = found[np.isin(found, on_any)]  # cells on no candidate are single faults
        covers = np.array([np.isin(np.r_[found, uncertain], c.cells) for c in candidates])
        # Cost saved if a wire through the cell is in the cover.
        saves = np.r_[np.full(len(found), cell_cost), support[uncertain]]
        cheapest = cheapest_of_few if len(candidates) <= _FEW else cheapest_of_many
        chosen = cheapest(np.array([c.cost for c in candidates]), covers, saves)
        candidates = [c for c, is_chosen in zip(candidates, chosen, strict=True) if is_chosen]
    return [c for c in candidates if _gain(c, faulty, support, cell_cost) > least]


def cheapest_of_few(cost: Floats, covers: Mask, saves: Floats) -> Mask:
    """Return the set of wires of least cost, bool ``[wires]``, by enumeration.

    Args:
        cost: float ``[wires]``.
        covers: bool ``[wires, cells]``.
        saves: float ``[cells]``, saved once if any wire of the set covers the cell; may be
            negative.
    """
    sets = (np.arange(1 << len(cost))[:, None] >> np.arange(len(cost)) & 1).astype(np.float64)
    net = ((sets @ covers) > 0) @ saves - sets @ cost
    best: Mask = sets[int(net.argmax())] > 0
    return best


def cheapest_of_many(cost: Floats, covers: Mask, saves: Floats) -> Mask:
    """Return the same set by integer programming: slower for few wires, feasible for many."""
    from scipy import sparse
    from scipy.optimize import Bounds, LinearConstraint, milp

    n, cells = covers.shape
    wires = sparse.csr_array(covers.T.astype(float))
    which, cell = np.nonzero(covers)
    of_wire = sparse.eye_array(n, format="csr")[which]
    of_cell = sparse.eye_array(cells, format="csr")[cell]
    # A cell is covered if and only if a wire through it is chosen.
    only_if = LinearConstraint(sparse.hstack([wires, -sparse.eye_array(cells)]), lb=0)
    if_ = LinearConstraint(sparse.hstack([-of_wire, of_cell]), lb=0)
    objective = np.concatenate([cost, -saves])
    solution = milp(
        objective, constraints=[only_if, if_], integrality=np.ones(n + cells), bounds=Bounds(0, 1)
    )
    # feasible by construction: no wire at all is a solution
    chosen: Mask = np.asarray(solution.x)[:n] > 0.5
    return chosen
