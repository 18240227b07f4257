"""Swapped, mirrored or shifted wiring: rows, columns or pads that answer in each other's place
after a repair.

The cells work, but their readings arrive at the wrong index. A permutation P of the wiring is
scored by the pseudo-likelihood (Besag 1975) of the contact events under the healthy model, with the
readings put back. A channel j, the readings at one index, may also be faulty:

    l(P) = sum_j max[ sum_e w_e log P(what j did in event e | channels that are not faulty),
                      sum_e w_e log P(what j did in event e | what j did in the other events) - 12 ]

what it did: never, sometimes or always loaded, and its load. A faulty channel (the second term is
larger) says the same of each permutation, and it is no predictor. Which channels are faulty is
found for each permutation, since those of exchanged lines contradict their neighbours until they
are put back. It is found step by step, and the present order is scored again with those of its best
rival.

Candidates are exchanges of two rows or two columns of a pad, a pad mirrored along either axis, its
rows or columns shifted by one, a pad turned by half a turn, one read column by column in place of
row by row, mirrored or not (a square one is transposed then, or turned by a quarter), and exchanged
pads. The best is taken, and the search goes on from there, so that combinations are found. A
permutation is reported if the gain l(P) - l(identity) exceeds 24, is positive without the two
events that favour it most, exceeds by 12 that of any other candidate that moves some of the same
cells, is as large for the working channels alone, and explains half of what a random order leaves
unexplained; w_e = 1 / (1 + k) discounts an event that repeats k earlier ones of the 32 strongest. A
whole pad that is mirrored or turned must also gain 5 % of what a random order of it loses. Where
the array is loaded symmetrically two wirings read alike, and nothing is reported. Lines that no
event loads differently are not distinguished. Where loads are spread widely, as by thick gloves,
exchanged lines may be named by mistake: the whole sensor has then changed as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import THE_SAME, count_repeats
from diagnostics.healthy.model import contact_events
from diagnostics.healthy.prediction import MIN_P_FLOOR, OUTLIERS, log_student_t
from diagnostics.preprocessing.levels import CERTAIN_RATIO, MAJORITY
from diagnostics.preprocessing.offset import levelled, levels_above
from diagnostics.preprocessing.readings import held

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.healthy.model import HealthyModel
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Scale

_EVENTS = 32  # contact events that are scored: a size
_FRAMES = 64  # of an event, evenly spread: a size
_FEWEST = 4  # events; fewer prove nothing
# of one kind on a pad, the least expected, whose exchange is tried; on large arrays: sizes
_LINES = 16
_FEW_LINES = 4
_WORK = 6400  # lines times cells, about: a size
LIMIT = 2 * CERTAIN_RATIO  # log likelihood gained, all events together
_WITHOUT = 2  # events without which there must be a gain too: one odd contact proves nothing
# of what a random order of a pad loses: gained where a whole pad is turned; by chance up to 0.03
_TURNED = 0.05
_MOST_STEPS = 6  # in which permutations are combined, or the faulty channels found anew: a size
# log ratio from which on a channel is faulty: of what only a fault explains
_FAULTY = CERTAIN_RATIO
_T4_AT_0 = 0.375  # density of Student's t with 4 degrees of freedom at 0
_LEAST_SPREAD = 0.01  # of a root load: half a converter step of the coarsest
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
        gain: log likelihood gained in the events of the log.
        events: number of events that were scored.
    """

    source: Cells
    steps: tuple[str, ...]
    gain: float
    events: int

    @property
    def reason(self) -> str:
        """One sentence."""
        return f"wiring changed: {', then '.join(self.steps)}; check the connectors"

    def undo(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return frames ``[..., D]`` with each reading at the index of the cell that gave it."""
        return frames[..., self.source]


class _Candidate(NamedTuple):
    """A permutation that is tried; ``turned``: of a whole pad, so that symmetric loads hardly tell
    it."""

    source: Cells
    text: str
    turned: bool = False


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
    if reference.model is None:
        return None
    present = layout.present.ravel()
    recordings = levelled(
        recordings, levels_above(recordings, reference.scale, present, reference.offset)
    )
    events, weight = events_of(recordings, reference.scale)
    if len(events) < _FEWEST:
        return None
    # Constant cells may be broken, those that are never at rest loaded by a strap: neither scored
    # nor predictors.
    moved = np.ptp(np.concatenate(events), axis=0) > reference.scale.near
    rested = np.any(
        [((reference.scale.root_load(r) == 0) & ~np.isnan(r)).any(axis=0) for r in recordings],
        axis=0,
    )
    used = moved & rested
    test = Test(events, weight, reference.model, reference.scale, present, used)
    source = np.arange(layout.n_cells)
    anywhere = np.random.default_rng(0).permutation(layout.n_cells)

    def at_random(faulty: Mask) -> float:
        return float(test.score(anywhere, faulty).by_event.sum())

    total = 0.0
    steps: list[str] = []
    now = test.settled(source, test.score(source, ~used))
    for _ in range(_MOST_STEPS):
        candidates = list(candidates_of(layout, now.surplus, source))
        if not candidates:  # one pad without rows and columns
            break
        scores = [
            test.score(candidate.source, now.faulty & (candidate.source == source))
            for candidate in candidates
        ]
        sums = np.array([score.by_event.sum() for score in scores])
        best = int(sums.argmax())
        found = test.settled(candidates[best].source, scores[best])
        # The present order may be as good once the channels that are faulty in the other one are
        # left out.
        again = test.settled(source, test.score(source, found.faulty))
        if again.by_event.sum() > now.by_event.sum():
            now = again
            continue
        gain = found.by_event - now.by_event
        # Where it was exchanged, two lines elsewhere may be exchanged as well.
        moves = candidates[best].source != source
        rivals = [
            sums[i]
            for i, of in enumerate(candidates)
            if i != best and (moves & (of.source != source)).any()
        ]
        if not _certain(gain) or sums[best] - max(rivals, default=-np.inf) < LIMIT / 2:
            break
        if (
            candidates[best].turned
            and gain.sum() < _TURNED * (sums[best] - at_random(found.faulty)) / layout.pads
        ):
            break
        # The channels that work say so by themselves: no permutation is due to the faulty ones.
        working = test.of_working(candidates[best].source, found.faulty) - test.of_working(
            source, found.faulty
        )
        if not _certain(working):
            break
        source = candidates[best].source
        total += float(gain.sum())
        steps.append(candidates[best].text)
        now = found
    if not steps:
        return None
    random = test.score(anywhere, now.faulty)
    left = now.surplus[~now.faulty[source]].sum()
    if left < MAJORITY * random.surplus[~now.faulty[anywhere]].sum():
        return None  # another sensor
    return Rewiring(source, tuple(steps), total, len(events))


def _certain(gain: Floats) -> bool:
    """Return whether the gains of the events, ``[n]``, prove a permutation, even without the two
    largest."""
    return bool(gain.sum() >= LIMIT and np.sort(gain)[:-_WITHOUT].sum() > 0)


class _Score(NamedTuple):
    """The score of one permutation.

    Attributes:
        by_event: float ``[n]``, weighted log likelihood of each event.
        surplus: float ``[D]``, by how much the log likelihood at each place exceeds its
            expectation.
        faulty: bool ``[D]``, channels that their own readings explain better than those of the
            others do.
    """

    by_event: Floats
    surplus: Floats
    faulty: Mask


@dataclass(frozen=True)
class Test:
    """Scores permutations on the same events.

    Attributes:
        events: frames ``[t, D]`` of each event.
        weight: float ``[n]``, of each event.
        model, scale: of the reference.
        present: bool ``[D]``, where there is a cell.
        used: bool ``[D]``, channels that are scored: their readings move.
    """

    events: Sequence[Floats]
    weight: Floats
    model: HealthyModel
    scale: Scale
    present: Mask
    used: Mask

    @cached_property
    def alone(self) -> Floats:
        """Log likelihood of what each channel did, given its own other events alone, ``[n, D]``."""
        return _log_likelihood_alone(self._features(np.arange(len(self.used))))

    @cached_property
    def _frames(self) -> tuple[Floats, Cells]:
        """The frames of all events, one after the other ``[T, D]``, and where each event ends."""
        return np.concatenate(self.events), np.cumsum([len(frames) for frames in self.events])

    @cached_property
    def _unmoved(self) -> NDArray[np.float32]:
        """The features of the events as they came, ``[n, 4, D]``."""
        return self._features_of(np.arange(len(self.used)), self.scale)

    def _features(self, source: Cells) -> NDArray[np.float32]:
        """Return the features of the events with the readings put back, ``[n, 4, D]``."""
        moved = np.flatnonzero(source != np.arange(len(source)))
        features = self._unmoved.copy()
        features[:, :, moved] = self._features_of(source[moved], self.scale.of(moved))
        return features

    def _features_of(self, channels: Cells, scale: Scale) -> NDArray[np.float32]:
        """Return what :meth:`Summary.features` says of some channels, ``[n, 4, channels]``, in all
        events at once."""
        frames, ends = self._frames
        root = scale.root_load(frames[:, channels])
        first = np.append(0, ends[:-1])
        lengths = (ends - first)[:, None].astype(np.float32)
        most = np.maximum.reduceat(root, first, axis=0)
        # not reduceat: it rounds otherwise
        total = np.stack([of_event.sum(axis=0) for of_event in np.split(root, ends[:-1])])
        loaded = np.add.reduceat(root > scale.root_near, first, axis=0, dtype=np.float32)
        ever = (loaded > 0).astype(np.float32)
        return np.stack([most, total / lengths, ever, loaded / lengths], axis=1)

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
        """Return the weighted log likelihood of each event, ``[n]``, of channels that are not
        ``faulty`` (``[D]``).

        That of :meth:`Prediction.log_likelihood`, which trusts the size of a load less.
        """
        features = self._features(source)
        counted = (self.used & ~faulty)[source]
        expected = self.model.predict(features, counted & self.present)
        likely = self._where_cells_are(expected.log_likelihood(features), features)
        by_event: Floats = self.weight * np.where(counted, likely, 0.0).sum(axis=1)
        return by_event

    def _where_cells_are(self, likely: Floats, features: NDArray[np.float32]) -> Floats:
        """Return log likelihoods ``[n, D]``; a load where no cell is, is as good as impossible.

        So the same readings count for each permutation.
        """
        return np.where(
            self.present, likely, np.where(features[:, 2] > 0, np.log(MIN_P_FLOOR), 0.0)
        )

    def score(self, source: Cells, faulty: Mask) -> _Score:
        """Return the score of one permutation; ``faulty`` channels (bool ``[D]``) are no
        predictors."""
        features = self._features(source)
        used = self.used[source]
        expected = self.model.predict(features, used & self.present & ~faulty[source])
        states = expected.states
        usual = (states * np.log(states)).sum(axis=0)
        surplus = np.where(used, self.weight @ (expected.log_likelihood(features) - usual), 0.0)
        likely = self._where_cells_are(_log_likelihood(features, expected), features)
        alone = self.alone[:, source]
        refuted = used & (self.weight @ (alone - likely) > _FAULTY)
        explained = np.where(used, np.where(refuted, alone, likely), 0.0)
        now = np.zeros(len(source), bool)
        now[source] = refuted
        return _Score(
            self.weight * explained.sum(axis=1) - _FAULTY * refuted.sum() / len(explained),
            surplus,
            now,
        )


def _log_likelihood(features: NDArray[np.float32], expected: Prediction) -> Floats:
    """Return the log likelihood of what each cell did, given the others, ``[n, D]``."""
    state = np.take_along_axis(np.log(expected.states), _state(features)[None], axis=0)[0]
    log_likely: Floats = state + _log_load(features, expected.mean, expected.spread)
    return log_likely


def _log_likelihood_alone(features: NDArray[np.float32]) -> Floats:
    """Return the log likelihood of what each channel did, given what it did in the other events,
    ``[n, D]``.

    Shares of the states by Laplace's rule of succession; loads with the mean and deviation of the
    others.
    """
    did = _state(features)
    same = np.zeros(did.shape)
    for state in range(3):
        among = did == state
        same += among * (among.sum(axis=0) - 1)
    load = np.where(did > 0, features[:, 1], 0.0).astype(np.float64)
    others = (did > 0).sum(axis=0) - (did > 0)
    some = np.maximum(others, 1)
    mean = (load.sum(axis=0) - load) / some
    variance = ((load**2).sum(axis=0) - load**2) / some - mean**2
    deviation = np.where(others > 1, np.sqrt(np.maximum(variance, 0.0) * (some + 1) / some), np.nan)
    return np.log((same + 1) / (len(did) + 2)) + _log_load(features, mean, deviation)


def _state(features: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return 0: never, 1: always, 2: sometimes loaded, ``[n, D]``, of features ``[n, 4, D]``."""
    return np.where(features[:, 2] == 0, 0, np.where(features[:, 3] == 1, 1, 2))


def _log_load(features: NDArray[np.float32], mean: Floats, spread: Floats) -> Floats:
    """Return the log density of the mean root load of the loaded cells, 0 for the others,
    ``[n, D]``.

    Student's t with 4 degrees of freedom, contaminated by a uniform one; where ``spread`` is NaN,
    uniform alone.
    """
    width = np.maximum(np.nan_to_num(spread, nan=np.inf), _LEAST_SPREAD)
    density = np.exp(log_student_t((features[:, 1] - mean) / width, 0.0)) * _T4_AT_0 / width
    contaminated = np.where(np.isfinite(width), (1 - OUTLIERS) * density + OUTLIERS, 1.0)
    return np.where(features[:, 2] > 0, np.log(contaminated), 0.0)


def events_of(
    recordings: Sequence[NDArray[np.float64]], scale: Scale, *, most: int = _EVENTS
) -> tuple[list[Floats], Floats]:
    """Return frames ``[t, D]`` of each of the ``most`` strongest contact events of the log, and the
    weights ``[n]``."""
    events = []
    found = []
    for recording in recordings:
        frames = np.nan_to_num(held(recording, np.full(recording.shape[1], np.nan))[1:], nan=0.0)
        for event in contact_events(frames, scale):
            own = frames[event.first : event.end]
            own = own[np.linspace(0, len(own) - 1, min(len(own), _FRAMES)).astype(int)]
            events.append(event)
            found.append(own)
    amplitudes = [event.amplitude(np.ones(len(event.lowest), np.float32)) for event in events]
    # In time order, and no more: the repeats of a whole log would be counted in a square of its
    # events.
    strongest = np.sort(np.argsort(np.negative(amplitudes), kind="stable")[:most]).tolist()
    return [found[i] for i in strongest], 1 / (
        1 + count_repeats([events[i] for i in strongest], THE_SAME)
    )


def candidates_of(layout: SensorLayout, surplus: Floats, source: Cells) -> Iterator[_Candidate]:
    """Yield the permutations that are tried, each on top of ``source``; with declared wiring only
    exchanged pads."""
    grid, score = layout.grid(np.arange(layout.n_cells)), layout.grid(surplus)
    # fewer on large arrays, where each costs more
    most = int(np.clip(_WORK // layout.n_cells, _FEW_LINES, _LINES))
    for pad in range(layout.pads) if layout.is_matrix else ():
        for axis, kind in enumerate(("row", "column")):
            size = grid.shape[axis + 1]
            worst = np.sort(np.argsort(score[pad].sum(axis=1 - axis))[:most]).tolist()
            orders = [
                (_exchanged(size, a, b), f"{kind}s {a} and {b} of pad {pad} are exchanged")
                for a, b in combinations(worst, 2)
            ]
            if size > 2:
                orders.append(
                    (np.arange(size)[::-1], f"the {kind}s of pad {pad} are in reverse order")
                )
            if size > 3:
                for by in (1, -1):
                    orders.append(
                        (
                            np.roll(np.arange(size), -by),
                            f"the {kind}s of pad {pad} are shifted by {by:+d}",
                        )
                    )
            for order, text in orders:
                changed = grid.copy()
                changed[pad] = np.take(grid[pad], order, axis=axis)
                yield _Candidate(source[changed.ravel()], text, turned="reverse" in text)
        for order, text in _orientations(*grid[pad].shape):
            changed = grid.copy()
            changed[pad] = grid[pad].ravel()[order]
            yield _Candidate(source[changed.ravel()], f"pad {pad} is {text}", turned=True)
    for a, b in combinations(range(layout.pads), 2):
        yield _Candidate(
            source[grid[_exchanged(layout.pads, a, b)].ravel()], f"pads {a} and {b} are exchanged"
        )


def _orientations(rows: int, columns: int) -> Iterator[tuple[NDArray[np.intp], str]]:
    """Yield the orders of a pad that is turned or read in the other order, ``[rows, columns]``, and
    their names."""
    if min(rows, columns) < 2:
        return
    by_column = np.arange(rows * columns).reshape(columns, rows).T
    yield by_column, "transposed: read column by column"
    yield by_column[::-1], "transposed: read column by column, the rows in reverse order"
    yield by_column[:, ::-1], "transposed: read column by column, the columns in reverse order"
    yield by_column[::-1, ::-1], "transposed: read column by column, both in reverse order"
    yield np.arange(rows * columns)[::-1].reshape(rows, columns), "turned by half a turn"


def _exchanged(size: int, a: int, b: int) -> NDArray[np.intp]:
    """Return the order of ``size`` lines or pads with two of them exchanged."""
    order = np.arange(size)
    order[[a, b]] = b, a
    return order
