"""How many recordings of a data set hold a fault at most, from some that were drawn at random.

Of N recordings, K hold a fault that the check finds in them. In n drawn without replacement the
number X of such recordings is hypergeometric. The bound is the largest K with P(X <= k) of at least
5 % at the k that were found (Clopper and Pearson 1934, for finite sets).

Not bounded: what the check does not find in a recording that holds it.
"""

from __future__ import annotations

from math import comb

from diagnostics import Diagnosis, Verdict

_RISK = 0.05


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


def bound_of_sample(diagnosis: Diagnosis, of: int) -> str:
    """Return in how many of all recordings a fault shows at most, in one sentence.

    Args:
        diagnosis: of recordings that were drawn at random.
        of: number of all recordings.
    """
    faulty = diagnosis.by_recording.verdicts == Verdict.FAULTY
    found = int(faulty.any(axis=1).sum())
    drawn = diagnosis.n_recordings
    most = most_faulty(found, drawn, of)
    return (
        f"a fault shows in {found} of {drawn} recordings drawn from {of}: with {1 - _RISK:.0%}"
        f" confidence in at most {most} of all ({most / of:.1%}), as far as a quick check finds it"
    )


def _at_most(found: int, drawn: int, faulty: int, of: int) -> float:
    """Return P(X <= found), hypergeometric."""
    ways = sum(
        comb(faulty, k) * comb(of - faulty, drawn - k)
        for k in range(max(0, drawn - (of - faulty)), min(found, faulty) + 1)
    )
    return ways / comb(of, drawn)
