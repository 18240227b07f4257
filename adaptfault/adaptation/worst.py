"""The faults that would cost most: the expected accuracy after repair without each wire, each pad,
and pairs of wires.

Each fault set is removed from the validation windows and forecast
(:mod:`adaptfault.adaptation.forecast`). What counts is the accuracy after the repair, because a
repair takes seconds. All single wires and pads are forecast. Pairs are forecast among the worst
single wires alone, so the worst of all pairs may be missed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptfault.adaptation.forecast import Expected
from adaptfault.data.documents import members
from diagnostics import FaultSet, SensorLayout
from diagnostics.shown import shown

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter

SCHEMA = "adaptfault.worst/1"


@dataclass(frozen=True)
class Loss:
    """A fault and its accuracy after repair.

    Attributes:
        what: the wire, the two wires or the pad.
        fault_set: its cells.
        expected: accuracy (R2 of a regression) after the best measured stage of the repair.
    """

    what: str
    fault_set: FaultSet
    expected: Expected


@shown
@dataclass(frozen=True, eq=False)
class WorstFaults:
    """Faults in the order of the mean probability of the true class after repair, lowest first.

    It tells small losses apart that the accuracy of some hundred windows does not.

    Attributes:
        layout: the array.
        fault_free: accuracy without faults.
        wires, pairs, pads: the faults of each kind; a pad is left out where it is the only one.
        measure: what is expected, "accuracy" or "R2"; R2 then stands for the probability, too.
    """

    layout: SensorLayout
    fault_free: Expected
    wires: tuple[Loss, ...]
    pairs: tuple[Loss, ...]
    pads: tuple[Loss, ...]
    measure: str = "accuracy"

    def __str__(self) -> str:
        return self.text()

    def text(self, most: int = 5) -> str:
        """Return the list as text, at most so many faults of each kind."""
        ranked = "R2" if self.measure == "R2" else "mean probability of the true class; accuracy"
        lines = [f"expected {self.measure} without faults: {self.fault_free}"]
        for name, losses in (("wire", self.wires), ("two wires", self.pairs), ("pad", self.pads)):
            if losses:
                lines.append(f"worst {name} to lose, after repair: {ranked}")
                for loss in losses[:most]:
                    first = "" if self.measure == "R2" else f"{loss.expected.likelihood:.3f}; "
                    lines.append(f"  {first}{loss.expected}  {loss.what}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        kinds = {
            name: [
                {**members(loss, "what", "expected"), "cells": list(loss.fault_set)}
                for loss in getattr(self, name)
            ]
            for name in ("wires", "pairs", "pads")
        }
        return {"schema": SCHEMA, **members(self, "layout", "fault_free"), **kinds}

    def plot(self) -> Any:
        """Draw what each cell costs with the worse of its two wires; return the matplotlib
        figure."""
        from diagnostics.decision.plot import draw_row, pads_figure

        lost = np.full(self.layout.n_cells, np.nan)
        for loss in self.wires:
            cells = list(loss.fault_set)
            lost[cells] = np.fmax(
                lost[cells], max(0.0, self.fault_free.likelihood - loss.expected.likelihood)
            )
        figure, axes = pads_figure(self.layout, n_rows=1)
        top = max(float(np.nanmax(lost)), 1e-3)
        what = "R2" if self.measure == "R2" else "P(true class)"
        label = f"{what} lost after repair, worse wire"
        draw_row(axes[0], lost, self.layout, top=top, cmap="Reds", label=label)
        return figure


_MANY = 4  # forecasts, of which the time left is told


def worst_faults(
    adapter: Adapter, *, among: int = 5, say: Callable[[str], None] = lambda text: None
) -> WorstFaults:
    """Forecast the loss of each row and column wire, of each pad, and of the pairs among the
    ``among`` worst wires.

    It takes one head in closed form for each fault set: seconds each.

    Args:
        adapter: of the model.
        among: number of the worst wires of which all pairs are forecast; below 2: no pairs.
        say: receives a line of progress before each part.
    """
    layout = adapter.layout
    index = np.flatnonzero(layout.present).tolist()
    wires = {
        str(line): layout.cells_on(line).tolist()
        for line in layout.lines
        if line.kind in ("row", "column")
    }
    pads = {
        f"pad {pad}": [c for c in index if layout.position(c)[0] == pad]
        for pad in range(layout.pads)
    }

    def ranked(sets: Iterable[tuple[str, Iterable[int]]]) -> tuple[Loss, ...]:
        """Return the losses by faults, the worst first."""
        losses = []
        every = list(sets)
        began = monotonic()
        for done, (what, cells) in enumerate(every):
            if done in (1, len(every) // 2) and len(every) >= _MANY:
                left = (monotonic() - began) / done * (len(every) - done)
                say(f"{done} of {len(every)}, about {left:.0f} s left")
            faults = FaultSet(tuple(sorted(set(cells))), layout.n_cells)
            if 0 < len(faults) < len(index):
                stages = adapter.forecast(faults).stages
                losses.append(
                    Loss(
                        what, faults, max(stages["fill"], stages["head"], key=lambda e: e.accuracy)
                    )
                )
        return tuple(sorted(losses, key=lambda loss: loss.expected.likelihood))

    say(f"forecasting {len(wires)} wires")
    alone = ranked(wires.items())
    pairs = list(combinations(alone[: max(among, 0)], 2))
    say(f"forecasting {len(pairs)} pairs of wires and {len(pads)} pads")
    together = ranked((f"{a.what} and {b.what}", a.fault_set | b.fault_set) for a, b in pairs)
    fault_free = adapter.forecast(FaultSet((), layout.n_cells)).stages["fault-free"]
    return WorstFaults(layout, fault_free, alone, together, ranked(pads.items()), adapter.measure)
