"""Swapped, mirrored or shifted wiring: rows, columns or pads that answer in each other's place
after a repair.

The cells work, but their readings arrive at the wrong index. A permutation P of the wiring is
scored by the pseudo-likelihood (Besag 1975) of pieces of the log under the model of the array, with
the readings put back. A channel j, the readings at one index, may also be faulty:

    l(P) = sum_j max[ sum_t w_t log P(level of j in piece t | channels that are not faulty),
                      sum_t w_t log P(level of j in piece t | its levels in the other pieces) - 12 ]

A faulty channel (the second term is larger) says the same of each permutation, and it is no
predictor. Which channels are faulty is found for each permutation, since those of exchanged lines
contradict their neighbours until they are put back. It is found step by step, and the present order
is scored again with those of its best rival.

P(level) is half that of the network and half that of the conditional mean alone, which is right of
objects that the reference did not see as well.

Candidates are exchanges of two rows or two columns of a pad, a pad mirrored along either axis, its
rows or columns shifted by one, a pad turned by half a turn, one read column by column in place of
row by row, mirrored or not (a square one is transposed then, or turned by a quarter), and exchanged
pads. The best is taken, and the search goes on from there, so that combinations are found. What
tells the best one is the pseudo-likelihood and how often each cell has its levels, whatever the
others do: to the others a mirrored pad looks as if the other one were.

A permutation is reported if the gain l(P) - l(identity) exceeds 24 and two and a half times its
standard error over the pieces (Vuong 1989), if it exceeds by 12 that of any other candidate that
moves some of the same cells, is as large for the working channels alone, and explains half of what
a random order leaves unexplained; w_t = 1 / (1 + k) discounts a piece that repeats k earlier ones;
the 32 that load most are scored. A whole pad that is mirrored or turned must also gain 5 % of what
a random order of it loses. Where the array is loaded symmetrically two wirings read alike, and
nothing is reported. Lines that no piece loads differently are not distinguished. Where loads are
spread widely, as by thick gloves, exchanged lines may be named by mistake: the whole sensor has
then changed as well. Objects unlike any of the reference hide exchanged lines; so does a coarser
converter, or one that loads drive to its top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.model.symbols import NOTHING, root_load
from diagnostics.preprocessing.levels import CERTAIN_RATIO, MAJORITY
from diagnostics.sensor.permutations import best_of, candidates_of
from diagnostics.sensor.recalibration import mean_is_positive

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout
    from diagnostics.model.judge import Model
    from diagnostics.model.observed import Log

_PIECES = 32  # that are scored: a size
_FEWEST = 4  # pieces; fewer prove nothing
_THE_SAME = 0.95  # cosine from which on two pieces load the same cells
_PRIOR = 2.0  # pieces that a usual level is worth
_IMPOSSIBLE = 0.002
_STEEP = 1.8  # logistic distribution of deviation 1
LIMIT = 2 * CERTAIN_RATIO  # log likelihood gained, all pieces together
_ERRORS = 2.5  # standard errors by which the gain of a piece exceeds 0
# of what a random order of a pad loses: gained where a whole pad is turned; by chance up to 0.03
_TURNED = 0.05
_MOST_STEPS = 6  # in which permutations are combined, or the faulty channels found anew: a size
# log ratio from which on a channel is faulty: of what only a fault explains
_FAULTY = CERTAIN_RATIO
_ROUNDS = 4  # in which the faulty channels of a permutation are found, at most: a size

Floats = NDArray[np.float64]
Cells = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Rewiring:
    """A permutation of the wiring.

    Attributes:
        source: int ``[D]``; cell i of the array now answers at index ``source[i]``.
        steps: what was exchanged, as text, in order.
        gain: log likelihood gained in the pieces that were scored.
        pieces: number of these.
    """

    source: Cells
    steps: tuple[str, ...]
    gain: float
    pieces: int

    @property
    def reason(self) -> str:
        """One sentence."""
        return f"wiring changed: {', then '.join(self.steps)}; check the connectors"

    def undo(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return frames ``[..., D]`` with each reading at the index of the cell that gave it."""
        return frames[..., self.source]


def find_rewiring(
    recordings: Sequence[NDArray[np.float64]],
    reference: Reference,
    layout: SensorLayout,
) -> Rewiring | None:
    """Return the permutation of the wiring that explains a log; None where there is none, or the
    data do not tell.

    Args:
        recordings: ``[T, D]`` each; NaN = missing.
        reference: of the array, fitted.
        layout: the array.
    """
    test = Test.of(recordings, reference, layout)
    if test is None:
        return None
    source = np.arange(layout.n_cells)
    anywhere = np.random.default_rng(0).permutation(layout.n_cells)
    total = 0.0
    steps: list[str] = []
    now = test.settled(source, test.score(source, ~test.used))
    for _ in range(_MOST_STEPS):
        candidates = list(candidates_of(layout, now.surplus, source))
        if not candidates:  # one pad without rows and columns
            break
        scores = [
            test.score(candidate.source, now.faulty & (candidate.source == source))
            for candidate in candidates
        ]
        sums = np.array([score.by_piece.sum() for score in scores])
        working = ~scores[int(sums.argmax())].faulty
        sums += [score.usual[working].sum() for score in scores]
        i, lead = best_of(candidates, sums, source)
        best = candidates[i]
        found = test.settled(best.source, scores[i])
        # The present order may be as good once the channels that are faulty in the other one are
        # left out.
        again = test.settled(source, test.score(source, found.faulty))
        if again.by_piece.sum() > now.by_piece.sum():
            now = again
            continue
        gain = found.by_piece - now.by_piece
        if lead < LIMIT / 2 or not test.proves(gain, best.source, source, found.faulty):
            break
        if best.turned:
            lost = sums[i] - float(test.score(anywhere, found.faulty).by_piece.sum())
            if gain.sum() < _TURNED * lost / layout.pads:
                break
        source = best.source
        total += float(gain.sum())
        steps.append(best.text)
        now = found
    if not steps:
        return None
    random = test.score(anywhere, now.faulty)
    left = now.surplus[~now.faulty[source]].sum()
    if left < MAJORITY * random.surplus[~now.faulty[anywhere]].sum():
        return None  # another sensor
    return Rewiring(source, tuple(steps), total, len(test.pieces))


def _certain(gain: Floats) -> bool:
    """Return whether the gains of the pieces, ``[n]``, prove a permutation: not by a few of them
    (test of Vuong, 1989)."""
    return bool(gain.sum() >= LIMIT) and mean_is_positive(gain, _ERRORS)


class _Score(NamedTuple):
    """The score of one permutation.

    Attributes:
        by_piece: float ``[n]``, weighted log likelihood of each piece.
        usual: float ``[D]``, log likelihood of what each channel did where the permutation puts it,
            whatever the others did: to them a mirrored pad looks as if the other one were.
        surplus: float ``[D]``, by how much the log likelihood at each place exceeds its
            expectation.
        refuted: float ``[D]``, by how much more of each channel its own readings explain than those
            of the others do.
    """

    by_piece: Floats
    usual: Floats
    surplus: Floats
    refuted: Floats

    @property
    def faulty(self) -> Mask:
        """Channels that are surely refuted, bool ``[D]``."""
        return self.refuted > _FAULTY


@dataclass(frozen=True)
class Test:
    """Scores permutations on the same pieces of a log.

    Attributes:
        model: of the array.
        log: as it came.
        pieces: int ``[n]``, those that are scored.
        weight: float ``[n]``, of each of them.
    """

    model: Model
    log: Log
    pieces: Cells
    weight: Floats

    @classmethod
    def of(
        cls, recordings: Sequence[Floats], reference: Reference, layout: SensorLayout
    ) -> Test | None:
        """Return the test on the pieces that load a log most; None where the data do not tell."""
        model = reference.model
        log = None if model is None else model.log_of_record(model.record_of(recordings))
        if model is None or log is None or log.is_coarse:
            return None
        whole = np.zeros(layout.n_cells, np.intp)
        pieces, weight = strongest(log, np.arange(len(log.record)), _PIECES, whole)
        return None if len(pieces) < _FEWEST else cls(model, log, pieces, weight)

    @cached_property
    def used(self) -> Mask:
        """Channels that are scored, bool ``[D]``: constant ones may be broken, those that are never
        at rest loaded by a strap."""
        found: Mask = self.log.far & (self.log.load <= NOTHING).any(axis=0)
        return found

    @cached_property
    def alone(self) -> Floats:
        """Log likelihood of the level of each channel, given its other pieces alone, ``[n, D]``.

        By Laplace's rule of succession, towards how often all channels have a level.
        """
        _, level = self._put_back(np.arange(len(self.used)))
        every = np.bincount(level[:, self.used].ravel(), minlength=self.model.symbols.n) + 1.0
        usual = (every / every.sum())[level]
        same = np.zeros(level.shape)
        for one in range(self.model.symbols.n):
            among = level == one
            same += among * (among.sum(axis=0) - 1)
        return np.asarray(np.log((same + _PRIOR * usual) / (len(level) - 1 + _PRIOR)))

    def _put_back(self, source: Cells) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return the root loads and levels of the pieces with the readings put back, ``[n, D]``
        each."""
        rest = self.model.symbols.rest
        record = replace(self.log.record, mean=self.log.record.mean[self.pieces][:, source])
        above = rest.above(record, self._offset(source)[self.pieces])
        nobody = np.zeros(above.shape, bool)
        return root_load(above, rest), self.model.symbols.levels(record, above, nobody)

    @cached_property
    def _offsets(self) -> dict[bytes, NDArray[np.float32]]:
        """What pads share, by where the cells of each pad come from."""
        return {}

    def _offset(self, source: Cells) -> NDArray[np.float32]:
        """Return what pads share with the readings put back, ``[pieces, D]``: the same unless cells
        of other pads come."""
        rest = self.model.symbols.rest
        moved = rest.pad[source]
        if (moved == rest.pad).all():
            source = np.arange(len(source))
        key = moved.tobytes()
        if key not in self._offsets:
            record = self.log.record
            put_back = replace(
                record,
                low=record.low[:, source],
                high=record.high[:, source],
                mean=record.mean[:, source],
                received=record.received[:, source],
            )
            telling = self.model.living & self.log.received[source]
            self._offsets[key] = rest.shared(put_back, telling).offset
        return self._offsets[key]

    def proves(self, gain: Floats, source: Cells, before: Cells, faulty: Mask) -> bool:
        """Return whether the ``gain [n]`` of the pieces proves a permutation, not by a few of them,
        and the channels that work say so by themselves: none is due to the ``faulty`` ones."""
        if not _certain(gain):
            return False
        return _certain(self.of_working(source, faulty) - self.of_working(before, faulty))

    def settled(self, source: Cells, score: _Score) -> _Score:
        """Return the score of one permutation once its faulty channels are no predictors;
        ``score``: the one before."""
        for _ in range(_ROUNDS):
            before = score.faulty
            score = self.score(source, before)
            if (score.faulty == before).all():
                break
        return score

    def of_working(self, source: Cells, faulty: Mask) -> Floats:
        """Return the weighted log likelihood of each piece, ``[n]``, of channels that are not
        ``faulty`` (``[D]``)."""
        likely, _, _ = self._likely(source, faulty)
        by_piece: Floats = self.weight * np.where((self.used & ~faulty)[source], likely, 0).sum(1)
        return by_piece

    def _likely(self, source: Cells, faulty: Mask) -> tuple[Floats, Floats, Floats]:
        """Return the log likelihood of what each cell did, given the others without the ``faulty``
        channels, its expectation, and that of what it did whatever the others did, ``[n, D]`` each.

        A load where no cell is, is as good as impossible: so the same readings count for each
        permutation.
        """
        model = self.model
        load, level = self._put_back(source)
        known = (self.used & ~faulty)[source] & model.living
        begins = np.ones(len(load), bool)  # what a cell read before tells nothing of its place
        by_network = model.predictor(load, load, begins, known)
        levels = (by_network + self._of_mean(load, known)) / 2
        found = np.take_along_axis(levels, level.astype(np.intp)[..., None], 2)[..., 0]
        impossible = np.where(level > 0, np.log(_IMPOSSIBLE), 0.0)
        expected = (levels * np.log(levels)).sum(axis=-1)
        usual = self._usual[np.arange(len(source)), level]
        return np.where(model.living, np.log(found), impossible), expected, usual

    def _of_mean(self, load: NDArray[np.float32], known: Mask) -> Floats:
        """Return P(level) ``[n, D, K]`` by the conditional mean alone, which is right of objects
        that the reference did not see, too."""
        predictor = self.model.predictor
        mean, _ = predictor.mean.predict(load, known)
        error = np.where(np.isfinite(predictor.error), predictor.error, 1.0)
        edges = self.model.symbols.edges
        below = expit((edges[:, None, None] - mean) * (_STEEP / error))
        levels = np.diff(below, axis=0, prepend=0.0, append=1.0)
        rare = np.full((self.model.symbols.n - len(levels), *mean.shape), _IMPOSSIBLE)
        found = np.concatenate([levels + _IMPOSSIBLE, rare])
        of_level: Floats = np.moveaxis(found / found.sum(axis=0), 0, -1)
        return of_level

    @cached_property
    def _usual(self) -> Floats:
        """Log P(level) of each cell, whatever the others do, ``[D, K]``."""
        nothing = np.zeros((1, len(self.used)), np.float32)
        nobody = np.zeros(len(self.used), bool)
        usual: Floats = np.log(self.model.predictor(nothing, nothing, np.ones(1, bool), nobody)[0])
        return usual

    def score(self, source: Cells, faulty: Mask) -> _Score:
        """Return the score of one permutation; ``faulty`` channels (bool ``[D]``) are no
        predictors."""
        used = self.used[source]
        likely, expected, usual = self._likely(source, faulty)
        surplus = np.where(used, self.weight @ (likely - expected), 0.0)
        alone = self.alone[:, source]
        by = np.where(used, self.weight @ (alone - likely), -np.inf)
        explained = np.where(used, np.where(by > _FAULTY, alone, likely), 0.0)
        penalty = _FAULTY * (by > _FAULTY).sum() / len(explained)
        refuted = np.zeros(len(source))
        refuted[source] = by
        usually = np.zeros(len(source))
        usually[source] = np.where(used & self.model.living, self.weight @ usual, 0.0)
        by_piece = self.weight * explained.sum(axis=1) - penalty
        return _Score(by_piece, usually, surplus, refuted)


def strongest(log: Log, some: Cells, most: int, pad_of: Cells) -> tuple[Cells, Floats]:
    """Return ``most`` of some pieces of a log and their weights: those that load it most, in turn
    of each unit and each of its pads. A piece that repeats k earlier ones weighs 1 / (1 + k)."""
    load = np.where(log.far, log.load, 0)[some]
    turn = np.full(len(some), len(some))
    for pad in np.unique(pad_of):
        on_pad = load[:, pad_of == pad].sum(axis=1)
        order = np.lexsort((-on_pad, log.record.of_unit[some]))
        unit = log.record.of_unit[some][order]
        rank = np.arange(len(some)) - np.searchsorted(unit, unit)
        turn[order] = np.minimum(turn[order], np.where(on_pad[order] > 0, rank, len(some)))
    total = load.sum(axis=1)
    chosen = np.sort(np.lexsort((-total, turn))[: min(most, int((total > 0).sum()))])
    if not len(chosen):
        return some[:0], np.zeros(0)
    unit = load[chosen] / np.linalg.norm(load[chosen], axis=1, keepdims=True)
    repeats = np.tril(unit @ unit.T >= _THE_SAME, -1).sum(axis=1)
    return some[chosen], 1 / (1 + repeats)
