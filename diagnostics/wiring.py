"""Wiring evidence: the cheapest set of wires and cells that explains which cells are faulty.

Costs are negative log probabilities. A broken line costs ``log 200`` (one wire in two hundred), a single cell the
log of how rare single faults are on this pad, and each live cell that a line says is dead costs ``log 1000``. The
set of least cost is found by integer programming; how rare single faults are is then read off the solution, and the
programme solved again until it no longer changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import Line, SensorLayout

_LINE_COST = np.log(200.0)
_CONTRADICTION_COST = np.log(1000.0)
_RAREST, _MOST_COMMON = 0.005, 0.5  # bounds on the share of single faults, which few cells cannot tell exactly
# Faulty cells that must have been seen on a line before it is blamed: so many, and this share of its cells.
_FEWEST_WITNESSES, _WITNESS_SHARE = 3, 1 / 3
_ROUNDS = 5


@dataclass(frozen=True)
class Cause:
    """What explains some faulty cells: a wire, or nothing but themselves.

    Attributes:
        line: the wire; None for a single cell.
        cells: the cells it makes faulty, ascending.
        seen: those of them that were found faulty; the others are inferred.
        probability: of the wire being at fault rather than all of ``seen`` by chance; 1 for single cells.
    """

    line: Line | None
    cells: tuple[int, ...]
    seen: tuple[int, ...]
    probability: float


def explain(faulty: NDArray[np.intp], alive: NDArray[np.bool_], layout: SensorLayout) -> tuple[Cause, ...]:
    """Explain cells that are faulty *in the same way* (same kind, same value).

    Args:
        faulty: int ``[n]``, their indices.
        alive: bool ``[D]``: the cells that contradict a broken wire. Cells that are neither may be inferred faulty.
        layout: the array.
    """
    causes: list[Cause] = []
    for pad in range(layout.pads):
        on_pad = faulty[(faulty // (layout.rows * layout.cols)) == pad]
        if len(on_pad):
            causes += _explain_pad(pad, on_pad, alive, layout)
    return tuple(causes)


def _explain_pad(pad: int, faulty: NDArray[np.intp], alive: NDArray[np.bool_], layout: SensorLayout) -> list[Cause]:
    served = {
        line: layout.cells_on(line)
        for line in layout.lines
        if line.pad == pad and line.kind in ("row", "column", "converter")
    }
    candidates = {
        line: cells
        for line, cells in served.items()
        if np.isin(faulty, cells).sum() >= max(min(_FEWEST_WITNESSES, len(cells)), _WITNESS_SHARE * len(cells))
    }
    tested = int(alive[served[Line(pad, "converter", 0)]].sum()) + len(faulty)
    blamed: set[Line] = set()
    singles = 0
    for _ in range(_ROUNDS):
        cell_cost = -np.log(np.clip(singles / tested, _RAREST, _MOST_COMMON))
        blamed = _cheapest_cover(candidates, faulty, alive, cell_cost)
        behind = [cell for line in blamed for cell in candidates[line].tolist()]
        singles, before = int((~np.isin(faulty, behind)).sum()), singles
        if singles == before:
            break
    causes: list[Cause] = []
    explained: set[int] = set()
    for line in sorted(blamed):
        seen = np.intersect1d(candidates[line], faulty)
        gain = len(seen) * cell_cost - _LINE_COST - alive[candidates[line]].sum() * _CONTRADICTION_COST
        cells = candidates[line][~alive[candidates[line]]]
        causes.append(Cause(line, tuple(cells.tolist()), tuple(seen.tolist()), float(1 / (1 + np.exp(-gain)))))
        explained |= set(cells.tolist())
    causes += [Cause(None, (c,), (c,), 1.0) for c in faulty.tolist() if c not in explained]
    return causes


def _cheapest_cover(
    candidates: Mapping[Line, NDArray[np.intp]], faulty: NDArray[np.intp], alive: NDArray[np.bool_], cell_cost: float
) -> set[Line]:
    """Return the lines of the cheapest set of lines and single cells that covers every faulty cell."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    if not candidates:
        return set()
    lines = list(candidates)
    contradictions = np.array([alive[candidates[line]].sum() for line in lines])
    cost = np.concatenate([_LINE_COST + _CONTRADICTION_COST * contradictions, np.full(len(faulty), cell_cost)])
    by_line = [np.isin(faulty, candidates[line]).astype(float) for line in lines]
    covers = np.column_stack([*by_line, np.eye(len(faulty))])
    solution = milp(
        cost,
        constraints=LinearConstraint(covers, lb=1),
        integrality=np.ones(len(cost), dtype=int),
        bounds=Bounds(0, 1),
    )
    # Feasible by construction: every cell can explain itself.
    chosen = np.asarray(solution.x)[: len(lines)] > 0.5
    return {line for line, taken in zip(lines, chosen, strict=True) if taken}
