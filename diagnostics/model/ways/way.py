"""What a way to fail is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units
from diagnostics.model.record import Array, Cells

MISS = 0.02  # share of the pieces in which a faulty cell reads as a healthy one


@dataclass(frozen=True)
class Way:
    """One way to fail.

    Attributes:
        kind: what it is called; None: its value tells (open, short, stuck).
        prior: share among faults.
        evidence: log P(log | fault) - log P(log | healthy), ``[D]``.
        since: likeliest first piece of the fault, int ``[D]``; None: the first one.
        value: what is told of it, ``[D]``: a load, or frames; None: the reading at the end.
        decides: whether it tells who is trusted, in every round.
        floats: whether such a cell moves by itself as well: there is no more evidence of it than of
            that.
    """

    kind: FaultKind | None
    prior: float
    evidence: Callable[[Observed, Units], Array]
    since: Callable[[Observed, Units], Cells] | None = None
    value: Callable[[Observed], Array] | None = None
    decides: bool = True
    floats: bool = False


def asked_once(found: Callable[..., Array]) -> Callable[..., Array]:
    """Return what is ``found`` of an :class:`Observed`, and is kept with it: several ask."""

    @wraps(found)
    def kept(observed: Observed, **how: object) -> Array:
        return observed.once((found, *how.values()), lambda: found(observed, **how))

    return kept
