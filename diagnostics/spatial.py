"""Spatial evidence: would a healthy cell hold this value while the other cells do what they do?

For each cell that ends the log still, at value v from frame s on, two explanations compete. Stuck: it reads v whatever
happens. Healthy: it reads v throughout a touch as often as healthy cells do when the others are touched like that.
Every touch after s adds

    log 1 / P(v throughout the touch | healthy, others)

Now and then a touch is like none before, and then the model errs about many cells at once. The cells that move give
that away, and the model is believed the less in that touch.

Cells that broke together, as those on one wire, vouch for each other all the same: they are judged once more with none
of them asked (see :func:`apart_evidence`).

How likely a stuck cell is to be stuck at just this v is charged once: a cell held still under a constant load also
reads one value, but an arbitrary one, while the rails are where broken cells go.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, softmax

from diagnostics.contact import Expected
from diagnostics.drift import drifting, gain_evidence, misleading, offset_evidence
from diagnostics.scale import Array, Scale
from diagnostics.temporal import SHORTEST_RUN, StillRuns
from diagnostics.touches import Touch, repeated

_ANYWHERE = 0.2  # of broken cells stick anywhere, of the rest as many to the low rail as to the high one
_LEAST = 1e-4  # no touch is less likely than this: models err
SUDDEN = 1.0  # log ratio of a jump from which on a cell is no witness
_TELLING = 0.5  # log evidence from which on a touch counts as one that tested the cell
_WORTHS = (0.25, 0.5, 0.75, 1.0)  # of the log odds of the model, in one touch or another
_WITNESS_SHARE = 0.5  # of what the moving cells say of that counts: neighbours err together
_USUALLY = 0.741  # spreads: half of all loads are farther off what is expected (Student's t, 4 degrees of freedom)
_AS_USUAL, _STRANGEST = 4, 4.0  # cells that are off as usual, beside those seen in a touch; times as far, at most
_ONE_LOAD = 0.5  # correlation of what touches elsewhere say of a load that outlasts them
_REPEATS, _THE_SAME = 0.15, 0.95  # correlation of what touches say that load the cells alike, and the cosine of such
_MOST_ROUNDS = 8  # of judging, leaving suspects out and putting others back
_MOST_DRIFTING = 16  # cells that are left out for their drift, one by one

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Caution(NamedTuple):
    """What evidence is worth, as far as it matters while it is gathered.

    Attributes:
        suspicious: log evidence from which on a cell is left out when others are judged.
        gains: share of the evidence of another gain that counts.
    """

    suspicious: float
    gains: float = 1.0


class Model(Protocol):
    """Knows what healthy cells would do in a touch."""

    def expect(self, features: Array, trusted: NDArray[np.bool_]) -> Generator[None, None, Expected]:
        """See ``ContactModel.expect``."""


@dataclass(frozen=True)
class Cells:
    """What is known of each cell before the others are asked, ``[D]``.

    Attributes:
        runs: the still stretch of each.
        settled: float, evidence from earlier touches, of the stretches that still go on.
        temporal: float, log likelihood ratio of what it holds and of the jump into it, where the cell jumped alone.
        sudden: float, that of the jump, wherever it jumped.
        askable: bool, where there is a cell that is not known to be faulty.
        outlasted: bool, where a load is held since before something else was touched.
    """

    runs: StillRuns
    settled: Floats
    temporal: Floats
    sudden: Floats
    askable: Mask
    outlasted: Mask

    def of(self, cells: NDArray[np.intp]) -> Cells:
        """Return the same of some cells."""
        rest = (values[cells] for name, values in vars(self).items() if name != "runs")
        return Cells(self.runs.of(cells), *rest)


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
        asked = cells.askable & (cells.runs.length >= SHORTEST_RUN)
        settled, nothing = np.where(asked, cells.settled, 0.0), np.zeros(len(asked))
        none = np.zeros(len(asked), np.intp)
        return cls(settled, settled, settled, asked, none, nothing, nothing, np.full(len(asked), np.nan), none)


@dataclass(frozen=True)
class _Values:
    """What still cells read, ``[D]``.

    Attributes:
        rests: bool, the reading of an untouched cell.
        low, high: root loads between which a cell reads the same.
        prior: log probability that a broken cell sticks to this value.
    """

    rests: Mask
    low: Floats
    high: Floats
    prior: Floats

    @classmethod
    def now(cls, cells: Cells, scale: Scale, tolerance: float) -> _Values:
        """Of the cells that are still now; the others count as 0."""
        still = Spatial.before(cells).asked
        return cls.of(np.where(still, np.nan_to_num(cells.runs.value), 0.0), scale, tolerance)

    @classmethod
    def of(cls, value: Floats, scale: Scale, tolerance: float) -> _Values:
        rests = scale.root_load(value) <= scale.root_near
        full = value >= scale.full_scale - 2 * tolerance
        low = scale.root_load(value - 2 * tolerance).astype(np.float64)
        high = np.where(full, np.inf, scale.root_load(value + 2 * tolerance))
        anywhere = _ANYWHERE * 4 * tolerance / scale.full_scale
        return cls(rests, low, high, np.log(np.where(rests | full, (1 - _ANYWHERE) / 2, anywhere)))


@dataclass(frozen=True)
class _Question:
    """What is asked of the cells that are still now, whoever answers.

    Attributes:
        cells, model: what is known of the cells, what healthy looks like.
        values: what still cells read.
        asked, askable: bool ``[D]``, the cells that are judged, and those that may be asked about others.
        features, begins, counted: see :func:`_looked_at`.
        worth: float ``[n, 1]``, of what each stretch says so much is new.
    """

    cells: Cells
    model: Model
    values: _Values
    asked: Mask
    askable: Mask
    features: Array
    begins: Mask
    counted: Mask
    worth: Floats

    @classmethod
    def of(cls, touches: Sequence[Touch], cells: Cells, model: Model, scale: Scale, tolerance: float) -> _Question:
        """Ask about one touch or more."""
        still, runs, values = Spatial.before(cells).asked, cells.runs, _Values.now(cells, scale, tolerance)
        # A load that came all of a sudden, and is still held: a quick grasp, or many cells broken at once. While this
        # touch lasts nobody can tell, so such cells are neither judged by it nor asked about the others.
        held = still & ~values.rests & runs.moved & (runs.start >= touches[-1].since) & ~cells.outlasted
        unsure = held & (cells.sudden >= SUDDEN) & (cells.temporal < SUDDEN)
        asked = still & ~unsure
        features, begins, counted = _looked_at(touches, runs, asked)
        worth = 1 / (1 + _REPEATS * repeated(touches, _THE_SAME, values.rests | ~still)[begins.cumsum() - 1, None])
        return cls(cells, model, values, asked, cells.askable & ~unsure, features, begins, counted, worth)

    def answered(self, trusted: Mask) -> Generator[None, None, tuple[Expected, Floats]]:
        """Return what the ``trusted`` cells (bool ``[D]``) expect, and the surprise of each stretch ``[n, D]``."""
        expected = yield from self.model.expect(self.features, trusted)
        yield
        held = np.flatnonzero(self.asked & ~self.values.rests)
        likely = _believed(expected.never, self.features[:, 2] == 0, trusted & self.cells.runs.moved)
        strange = _strange(expected, self.features, trusted)
        within = expected.within(self.values.low[held], self.values.high[held], held, strange)
        likely[:, held] = expected.always[:, held] * within
        return expected, np.where(self.counted, -self.worth * np.log(np.maximum(likely, _LEAST)), 0.0)

    def brought(self, surprise: Floats) -> Floats:
        """Return the evidence ``[D]`` of all touches, those before included."""
        return np.where(self.asked, self.cells.settled + surprise.sum(axis=0), 0.0)


class _Agreed(NamedTuple):
    """What the cells say that are asked in the end; ``at_first``: what was brought while those asked at first were."""

    expected: Expected
    surprise: Floats
    brought: Floats
    at_first: Floats
    evidence: Floats
    trusted: Mask


def _agreed(question: _Question, trusted: Mask, suspicious: float) -> Generator[None, None, _Agreed]:
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
        known, prior = Spatial.before(cells), _Values.now(cells, scale, tolerance).prior
        return replace(known, evidence=np.where(known.surprise > 0, prior + known.surprise, known.evidence))
    question = _Question.of(touches, cells, model, scale, tolerance)
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
    question = _Question.of(touches, cells, model, scale, tolerance)
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
    values, root = _Values.of(value, scale, tolerance), scale.root_load(value)
    held = np.flatnonzero(outlasted)
    loaded = (root > scale.root_near).astype(np.float32)
    expected = yield from model.expect(np.stack([root, root, loaded, loaded])[None], cells.askable)
    likely = expected.always[0, held] * expected.within(values.low[held], values.high[held], held)[0]
    # However often something else was touched, it is one load.
    evidence = np.zeros(len(outlasted))
    evidence[held] = -np.log(np.maximum(likely, _LEAST)) * outlasted[held] / (1 + _ONE_LOAD * (outlasted[held] - 1))
    return evidence


def _looked_at(touches: Sequence[Touch], runs: StillRuns, asked: Mask) -> tuple[Array, Mask, Mask]:
    """Return the stretches that tell something: features ``[n, 4, D]``, whole touches ``[n]``, those that count.

    For each cell that is ``asked`` (bool ``[D]``) one stretch of each touch counts, ``[n, D]``: the longest within its
    still stretch.
    """
    suffixes = [suffix for touch in touches for suffix in touch.suffixes()]
    first = np.array([suffix.first for suffix in suffixes])
    begins = np.array([i == 0 for touch in touches for i in range(len(touch.parts))])
    within = first[:, None] >= runs.start
    earlier = np.concatenate([np.zeros((1, len(asked)), bool), within[:-1]]) & ~begins[:, None]
    counted = within & ~earlier & asked
    needed = np.flatnonzero(begins | counted.any(axis=1))
    return np.stack([suffixes[i].features() for i in needed]), begins[needed], counted[needed]


def _strange(expected: Expected, features: Array, witness: Mask) -> Floats:
    """Return how many times as far as usual loads are off what is expected, ``[n]``, 1 to 4.

    So far off are half of those of the ``witness`` (bool ``[D]``), cells that are known to work.
    """
    known = witness & np.isfinite(expected.spread)
    loaded = features[:, 2, known] > 0
    error = np.abs(features[:, 1, known] - expected.mean[:, known]) / expected.spread[known]
    error = np.column_stack([np.where(loaded, error, np.inf), np.full((len(features), _AS_USUAL), _USUALLY)])
    middle = (loaded.sum(axis=1) + _AS_USUAL) // 2
    half: Floats = np.sort(error, axis=1)[np.arange(len(features)), middle]
    return np.clip(half / _USUALLY, 1.0, _STRANGEST)


def _believed(never: Floats, unloaded: NDArray[np.bool_], witness: NDArray[np.bool_]) -> Floats:
    """Return P(unloaded throughout) ``[n, D]``, nearer to even in the touches in which the model errs.

    A touch like none before surprises many cells at once, and those that move tell so: how well their own loads were
    foreseen decides what the log odds are worth for all the others.

    Args:
        never: ``[n, D]``, what the model says.
        unloaded: bool ``[n, D]``, what the cells did.
        witness: bool ``[D]``, those that are known to work.
    """
    odds = logit(np.maximum(never, _LEAST))
    right = np.where(unloaded | np.isinf(odds), odds, -odds)[:, witness]  # where nothing is known, nothing is wrong
    likelihood = -np.stack([np.log1p(np.exp(-worth * right)).sum(axis=1) for worth in _WORTHS])
    share = softmax(_WITNESS_SHARE * likelihood, axis=0)  # (worths, n)
    doubted = np.sum([p[:, None] * expit(w * odds) for p, w in zip(share, _WORTHS, strict=True)], axis=0)
    believed: Floats = np.maximum(never, doubted)  # doubt is no evidence against cells expected to stay unloaded
    return believed
