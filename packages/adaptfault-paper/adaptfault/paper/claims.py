"""Statements of the paper, and whether the measurements support them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from adaptfault.paper.ledger import Ledger, Mean
from adaptfault.paper.settings import Settings, aware

Verdict = Literal["holds", "holds in part", "does not hold"]
# shares of the fault-free accuracy (above chance, for the first)
_NEAR = 0.1
_MODERATE = 0.8
_HIGH = 0.9


@dataclass(frozen=True)
class Claim:
    """A statement of the paper beside the measurement.

    Attributes:
        statement: with its section.
        here: the measurement, with 95 % intervals.
        verdict: whether it holds.
        criterion: the definition of "holds".
    """

    statement: str
    here: str
    verdict: Verdict
    criterion: str


def judge(ledger: Ledger, settings: Settings, *, n_classes: int, present: int) -> list[Claim]:
    """Return the claims that the available results decide."""
    free = ledger.mean(2, "none", 0, "nothing") or ledger.mean(4, "none", 0, aware(0))
    if free is None:
        return []
    rules: list[Callable[..., Iterator[Claim]]] = [
        _shorts,
        _opens,
        _samples,
        _adaptation,
        _correction,
    ]
    return [
        claim for rule in rules for claim in rule(ledger, settings, free, 1 / n_classes, present)
    ]


def _shorts(
    ledger: Ledger, settings: Settings, free: Mean, chance: float, present: int
) -> Iterator[Claim]:
    short = ledger.mean(2, "short", 5, "nothing")
    if short is not None:
        near = short.accuracy <= chance + _NEAR * (free.accuracy - chance)
        half = short.accuracy <= (chance + free.accuracy) / 2
        yield Claim(
            "Five short cells (SF5) bring the accuracy to about 13 %, near chance (VI-D)",
            f"{short}; chance is {chance:.3f}, fault-free {free.accuracy:.3f}",
            "holds" if near else "holds in part" if half else "does not hold",
            "within a tenth of the way from chance to fault-free; in part: within half of it",
        )


def _opens(
    ledger: Ledger, settings: Settings, free: Mean, chance: float, present: int
) -> Iterator[Claim]:
    opened = ledger.mean(2, "open", 5, "nothing")
    short = ledger.mean(2, "short", 5, "nothing")
    if opened is not None and short is not None:
        keeps = opened.accuracy >= _MODERATE * free.accuracy
        yield Claim(
            "Open cells (OF) cost only a moderate part of the accuracy (VI-D)",
            f"{opened} with five, against {short.accuracy:.3f} with five short ones",
            "holds" if keeps else "holds in part" if opened.low > short.high else "does not hold",
            "five open cells keep 80 % of the fault-free accuracy; in part: better than short ones",
        )


def _samples(
    ledger: Ledger, settings: Settings, free: Mean, chance: float, present: int
) -> Iterator[Claim]:
    rows = [
        (n, m)
        for n in (0, *settings.samples)
        if (m := ledger.mean(4, "mixed", 5, aware(n))) is not None
    ]
    if len(rows) > 1:
        (_, first), (n, last) = rows[0], rows[-1]
        control = ledger.mean(4, "mixed", 5, aware(n, "none"))
        rising = all(a.accuracy < b.accuracy for (_, a), (_, b) in itertools.pairwise(rows))
        beside = f"; as many without faults: {control}" if control else ""
        yield Claim(
            "More fault-injected training samples make the network more robust (VI-E)",
            "; ".join(f"{n} samples: {m}" for n, m in rows)
            + beside
            + " (five cells open or short)",
            (
                "holds"
                if rising and last.low > (control or first).high
                else "holds in part"
                if last.low > first.high
                else "does not hold"
            ),
            "the accuracy rises with each step and ends clearly above that of as many steps on"
            " fault-free samples; in part: clearly above the first",
        )


def _adaptation(
    ledger: Ledger, settings: Settings, free: Mean, chance: float, present: int
) -> Iterator[Claim]:
    k = max(settings.sizes(settings.adapted, present), default=0)
    for strategy, name in (
        ("adapted", "repaired without gradients"),
        ("trained anew", "trained anew"),
    ):
        adapted = ledger.mean(5, "mixed", k, strategy)
        if adapted is not None:
            share = adapted.accuracy / free.accuracy
            yield Claim(
                "Without the faulty cells the network keeps a high accuracy, even without 200 of"
                f" 220 (VI-F): {name}",
                f"{adapted} without {k} of {present} cells, {share:.0%} of fault-free",
                "holds" if share >= _HIGH else "holds in part" if share >= 0.5 else "does not hold",
                "90 % of the fault-free accuracy; in part: half of it",
            )


def _correction(
    ledger: Ledger, settings: Settings, free: Mean, chance: float, present: int
) -> Iterator[Claim]:
    pairs = [
        (k, corrected, opened)
        for k in settings.sizes(settings.counts, present)
        if (corrected := ledger.mean(6, "short", k, "correct to 0")) is not None
        and (opened := ledger.mean(2, "open", k, "nothing")) is not None
    ]
    if pairs:
        gap = max(abs(corrected.accuracy - opened.accuracy) for _, corrected, opened in pairs)
        k, corrected, opened = pairs[-1]
        yield Claim(
            "Short cells corrected to 0 are as good as open ones, for the same number (VI-G)",
            f"largest difference {gap:.4f}; with {k} cells {corrected.accuracy:.3f} and"
            f" {opened.accuracy:.3f}",
            "holds" if gap < 0.005 else "holds in part" if gap < 0.05 else "does not hold",
            "the same within 0.005 for every k; in part: within 0.05",
        )
