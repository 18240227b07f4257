"""How many recordings of a data set hold a fault at most, from some that were drawn at random.

Of N recordings, K hold a fault that the check finds in them. In n drawn without replacement the
number X of such recordings is hypergeometric. The bound is the largest K with P(X <= k) of at least
5 % at the k that were found (Clopper and Pearson 1934, for finite sets). It is told of faults of
one cell or more, and of those of a tenth of the cells or more, which need a person.

Not bounded: what the check does not find in a recording that holds it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from math import comb
from typing import Any

from diagnostics import Diagnosis, Verdict

_RISK = 0.05
_MANY = 0.1  # of the cells: a person is needed


@dataclass(frozen=True)
class Bound:
    """How many recordings hold a fault at most.

    Attributes:
        cells: of the fault, or more.
        found: drawn recordings in which such a fault shows.
        most: of all recordings.
    """

    cells: int
    found: int
    most: int


@dataclass(frozen=True)
class SampleBound:
    """What recordings that were drawn tell of all.

    Attributes:
        drawn: number of recordings that were drawn.
        of: number of all.
        confidence: of the bounds, each by itself.
        bounds: for faults of some cells or more.
    """

    drawn: int
    of: int
    confidence: float
    bounds: tuple[Bound, ...]

    @classmethod
    def from_diagnosis(cls, diagnosis: Diagnosis, of: int) -> SampleBound:
        """Return what a diagnosis of recordings tells that were drawn at random from ``of``."""
        faulty = (diagnosis.by_recording.verdicts == Verdict.FAULTY).sum(axis=1)
        drawn = diagnosis.n_recordings
        many = max(2, math.ceil(_MANY * int(diagnosis.layout.present.sum())))
        bounds = []
        for cells in (1, many):
            found = int((faulty >= cells).sum())
            bounds.append(Bound(cells, found, most_faulty(found, drawn, of)))
        return cls(drawn, of, 1 - _RISK, tuple(bounds))

    def __str__(self) -> str:
        one, many = self.bounds
        return (
            f"a fault shows in {one.found} of {self.drawn} recordings drawn from {self.of}: with"
            f" {self.confidence:.0%} confidence in at most {one.most} of all"
            f" ({one.most / self.of:.1%}), and one of {many.cells} cells or more in at most"
            f" {many.most} ({many.most / self.of:.1%}), as far as a quick check finds it"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {**asdict(self), "bounds": [asdict(one) for one in self.bounds]}


def most_faulty(found: int, drawn: int, of: int, risk: float = _RISK) -> int:
    """Return how many recordings hold a fault at most.

    Args:
        found: recordings among the drawn ones in which a fault shows.
        drawn: number of recordings that were drawn.
        of: number of all recordings.
        risk: probability that it is more.

    Raises:
        ValueError: not 0 <= found <= drawn <= of, or none was drawn.
    """
    if not 0 <= found <= drawn <= of or not drawn:
        raise ValueError(f"expected 0 <= found <= drawn <= of, got {found}, {drawn}, {of}")
    least = found
    most = of - (drawn - found)
    while least < most:
        middle = (least + most + 1) // 2
        if _at_most(found, drawn, middle, of) >= risk:
            least = middle
        else:
            most = middle - 1
    return least


def _at_most(found: int, drawn: int, faulty: int, of: int) -> float:
    """Return P(X <= found), hypergeometric."""
    ways = sum(
        comb(faulty, k) * comb(of - faulty, drawn - k)
        for k in range(max(0, drawn - (of - faulty)), min(found, faulty) + 1)
    )
    return ways / comb(of, drawn)
