"""Spatial evidence: would a healthy cell hold this value while the other cells do what they do?

For each cell that ends the log still, at value v from frame s on, two explanations compete. Stuck: it reads v whatever
happens. Healthy: it reads v throughout a touch as often as healthy cells do when the others are touched like that.
Every touch after s adds

    log 1 / P(v throughout the touch | healthy, others)

Cells that broke together, as those on one wire, vouch for each other all the same: they are judged once more with none
of them asked (see :func:`apart_evidence`).

How likely a stuck cell is to be stuck at just this v is charged once: a cell held still under a constant load also
reads one value, but an arbitrary one, while the rails are where broken cells go.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.contact import Expected
from diagnostics.drift import drifting, gain_evidence, misleading, offset_evidence
from diagnostics.question import LEAST, SUDDEN, Cells, Mask, Model, Question, Values
from diagnostics.scale import Scale
from diagnostics.touches import Touch

_TELLING = 0.5  # log evidence from which on a touch counts as one that tested the cell
_ONE_LOAD = 0.5  # correlation of what touches elsewhere say of a load that outlasts them
_MOST_ROUNDS = 8  # of judging, leaving suspects out and putting others back
_MOST_DRIFTING = 16  # cells that are left out for their drift, one by one

Floats = NDArray[np.float64]


class Caution(NamedTuple):
    """What evidence is worth, as far as it matters while it is gathered.

    Attributes:
        suspicious: log evidence from which on a cell is left out when others are judged.
        gains: share of the evidence of another gain that counts.
    """

    suspicious: float
    gains: float = 1.0


@dataclass(frozen=True)
class Spatial:
    """What the other cells say.

    Attributes:
        evidence: float ``[D]``, log likelihood ratio stuck : healthy; 0 where there is nothing to ask.
        surprise: float ``[D]``, the part of it that touches brought.
        at_first: float ``[D]``, the same while only the cells that moved were asked.
        asked: bool ``[D]``, the cells that are still now.
        touches: int ``[D]``, how many touches each was judged by that said more than nothing.
        offset: float ``[D]``, log likelihood ratio of a cell that moves, but is loaded all through the last touches,
            however little the others are; 0 for the others.
        gain: float ``[D]``, log likelihood ratio of a cell that moves, but has another gain; 0: too few touches tell.
        factor: float ``[D]``, how many times its gain in the reference, where it certainly is another; NaN elsewhere.
        since: int ``[D]``, from about which frame on; 0: all along, or not known.
    """

    evidence: Floats
    surprise: Floats
    at_first: Floats
    asked: Mask
    touches: NDArray[np.intp]
    offset: Floats
    gain: Floats
    factor: Floats
    since: NDArray[np.intp]

    @property
    def drifting(self) -> Mask:
        """The cells that move, but certainly not as healthy ones do, bool ``[D]``."""
        return drifting(self.offset, self.gain)

    @classmethod
    def before(cls, cells: Cells) -> Spatial:
        """Return what is known where nothing touched the cells since earlier touches were weighed."""
        asked = cells.asked
        settled, nothing = np.where(asked, cells.settled, 0.0), np.zeros(len(asked))
        none = np.zeros(len(asked), np.intp)
        return cls(settled, settled, settled, asked, none, nothing, nothing, np.full(len(asked), np.nan), none)


class _Agreed(NamedTuple):
    """What the cells say that are asked in the end; ``at_first``: what was brought while those asked at first were."""

    expected: Expected
    surprise: Floats
    brought: Floats
    at_first: Floats
    evidence: Floats
    trusted: Mask


def _agreed(question: Question, trusted: Mask, suspicious: float) -> Generator[None, None, _Agreed]:
    """Ask the ``trusted`` cells, leave out those that look stuck, put the others back, until none changes sides."""
    trusted, brought = trusted & question.askable, []
    for _ in range(_MOST_ROUNDS):
        yield
        expected, surprise = yield from question.answered(trusted)
        brought.append(question.brought(surprise))
        evidence = np.where(question.asked, question.values.prior + brought[-1], 0.0)
        asked_now = trusted
        trusted = question.askable & (evidence + question.cells.temporal < suspicious)
        if (trusted == asked_now).all():
            break
    return _Agreed(expected, surprise, brought[-1], brought[0], evidence, trusted)


def stuck_evidence(
    touches: Sequence[Touch], cells: Cells, model: Model, scale: Scale, tolerance: float, caution: Caution
) -> Generator[None, None, Spatial]:
    """Weigh stuck against healthy for each cell that is still now. A generator that pauses on its way.

    Cells that moved answer first; still cells whose value proved normal are then put back, and those that look
    stuck are left out, until no cell changes sides: cells that died side by side vouch for each other at first. Cells
    that move, but not as healthy ones do (see ``drift``), are left out as well.

    Args:
        touches: what happened.
        cells: what is known of them.
        model: what healthy looks like.
        scale: what a reading means.
        tolerance: how near to v counts as v.
        caution: what evidence is worth.
    """
    if not touches:
        known, prior = Spatial.before(cells), Values.now(cells, scale, tolerance).prior
        return replace(known, evidence=np.where(known.surprise > 0, prior + known.surprise, known.evidence))
    question = Question.of(touches, cells, model, scale, tolerance)
    values, runs = question.values, cells.runs
    # At first those are asked that moved, unless their load has outlived a touch, or jumped alone. Of the cells at rest
    # few are broken.
    first = np.array([touch.first for touch in touches])
    moved = cells.askable & runs.moved & (first[:, None] <= runs.start)
    fresh = runs.start >= touches[-1].since
    trusted = question.askable & runs.moved & (values.rests | (fresh & (cells.temporal < SUDDEN)))
    said = yield from _agreed(question, trusted, caution.suspicious)
    at_first, drifts, whole = said.at_first, np.zeros(len(trusted), bool), question.features[question.begins]
    for _ in range(_MOST_DRIFTING):
        yield
        expected = said.expected.on(question.begins)
        offset = offset_evidence(whole, expected.always, moved[-1] & np.isfinite(expected.spread))
        gain = gain_evidence(whole, expected, moved, scale.root_near, caution.gains * question.worth[question.begins])
        more = misleading(offset, gain.evidence, drifts)
        if not more.any():
            break
        drifts |= more
        without = replace(question, askable=question.askable & ~drifts)
        said = yield from _agreed(without, said.trusted, caution.suspicious)
    of_gain = drifting(offset, gain.evidence) & ~drifting(offset)
    return Spatial(
        said.evidence,
        said.brought,
        at_first,
        question.asked,
        np.where(of_gain, gain.touches, (said.surprise > _TELLING).sum(axis=0)),
        offset,
        gain.evidence,
        factor=np.where(of_gain, gain.factor, np.nan),
        since=np.where(of_gain & (gain.since > 0), first[gain.since], 0),
    )


def apart_evidence(
    touches: Sequence[Touch],
    cells: Cells,
    model: Model,
    scale: Scale,
    tolerance: float,
    trusted: Mask,
    groups: Sequence[NDArray[np.intp]],
) -> Generator[None, None, Floats]:
    """Return what touches brought against cells with nobody asked who may have broken with them, ``[groups, D]``.

    Args:
        touches, cells, model, scale, tolerance: as for :func:`stuck_evidence`.
        trusted: bool ``[D]``, those that were asked in the end.
        groups: cells each, that may have broken together.
    """
    question = Question.of(touches, cells, model, scale, tolerance)
    brought = np.zeros((len(groups), len(trusted)))
    for i, group in enumerate(groups):
        others = trusted & question.askable
        others[group] = False
        _, surprise = yield from question.answered(others)
        brought[i] = question.brought(surprise)
    return brought


def lone_evidence(
    cells: Cells, outlasted: NDArray[np.intp], model: Model, scale: Scale, tolerance: float
) -> Generator[None, None, Floats]:
    """Return what it says that a load is held where nothing moves, a log likelihood ratio ``[D]``.

    All cells have a say in that, so that a thing that lies there is no fault: its cells have each other.

    Args:
        cells: what is known of them.
        outlasted: int ``[D]``, how many touches of other parts of the skin each load has outlasted.
        model, scale, tolerance: as for :func:`stuck_evidence`.
    """
    value = np.nan_to_num(cells.runs.value)
    values, root = Values.of(value, scale, tolerance), scale.root_load(value)
    held = np.flatnonzero(outlasted)
    loaded = (root > scale.root_near).astype(np.float32)
    expected = yield from model.expect(np.stack([root, root, loaded, loaded])[None], cells.askable)
    likely = expected.always[0, held] * expected.within(values.low[held], values.high[held], held)[0]
    # However often something else was touched, it is one load.
    evidence = np.zeros(len(outlasted))
    evidence[held] = -np.log(np.maximum(likely, LEAST)) * outlasted[held] / (1 + _ONE_LOAD * (outlasted[held] - 1))
    return evidence
