"""Swapped, mirrored or shifted wiring: rows, columns or pads that answer in each other's place after a repair.

Every cell works, so no cell is faulty; the readings arrive at the wrong index. A permutation of the wiring is scored by
the pseudo-likelihood (Besag 1975) of the contact events under the healthy model, with the readings put back,

    l_e(P) = sum_i log P(what cell i did in event e | other cells),    never, sometimes or always loaded, and its load

Candidates are exchanges of two rows or two columns of a pad, a pad mirrored along either axis, its rows or columns
shifted by one, and exchanged pads. The best is taken, and the search goes on from there, so that combinations are
found. A permutation is reported if the gain sum_e w_e (l_e(P) - l_e(identity)) exceeds 24, is positive without the two
events that favour it most, exceeds that of any other candidate by 12, and explains half of what a random order leaves
unexplained; w_e = 1 / (1 + k) discounts an event that repeats k earlier ones of the 32 strongest. Where the array is
loaded symmetrically two wirings read alike, and nothing is reported. Lines that no event loads differently are not
distinguished. Where loads are spread widely, as by thick gloves, exchanged lines may be named by mistake: the whole
sensor has then changed as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import THE_SAME, Summary, count_repeats
from diagnostics.healthy.model import contact_events
from diagnostics.healthy.prediction import MIN_P_FLOOR
from diagnostics.preprocessing.levels import CERTAIN_RATIO, MAJORITY
from diagnostics.preprocessing.readings import held

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.healthy.model import HealthyModel
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Scale

_EVENTS = 32  # contact events that are scored: a size
_FRAMES = 64  # of an event, evenly spread: a size
_FEWEST = 4  # events; fewer prove nothing
_LINES, _FEW_LINES = 16, 4  # of one kind on a pad, the least expected, whose exchange is tried; on large arrays: sizes
_WORK = 6400  # lines times cells, about: a size
_LIMIT = 2 * CERTAIN_RATIO  # log likelihood gained, all events together
_WITHOUT = 2  # events without which there must be a gain too: one odd contact proves nothing
_MOST_STEPS = 4  # permutations that are combined

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
    source: Cells
    text: str


def find_rewiring(
    recordings: Sequence[NDArray[np.float64]],
    reference: Reference,
    layout: SensorLayout,
) -> Rewiring | None:
    """Return the permutation of the wiring that explains a log; None where there is none, or the data do not tell.

    Args:
        recordings: ``[T, D]`` each; NaN = missing.
        reference: of the array, fitted.
        layout: the array.
    """
    if reference.model is None:
        return None
    events, weight = _events(recordings, reference.scale)
    if len(events) < _FEWEST:
        return None
    # Constant cells may be broken, those that are never at rest loaded by a strap: neither scored nor predictors.
    moved = np.ptp(np.concatenate(events), axis=0) > reference.scale.near
    rested = np.any([((reference.scale.root_load(r) == 0) & ~np.isnan(r)).any(axis=0) for r in recordings], axis=0)
    test = _Test(events, weight, reference.model, reference.scale, layout.present.ravel(), moved & rested)
    source, total = np.arange(layout.n_cells), 0.0
    steps: list[str] = []
    now = test.score(source)
    for _ in range(_MOST_STEPS):
        candidates = list(_candidates(layout, now.surplus, source))
        if not candidates:  # one pad without rows and columns
            break
        scores = [test.score(candidate.source) for candidate in candidates]
        gains = np.array([score.by_event - now.by_event for score in scores])
        sums = gains.sum(axis=1)
        best = int(sums.argmax())
        rivals = np.delete(sums, best)
        if not _certain(gains[best]) or (len(rivals) and sums[best] - rivals.max() < _LIMIT / 2):
            break
        source, total = candidates[best].source, total + float(sums[best])
        steps.append(candidates[best].text)
        now = scores[best]
    if not steps:
        return None
    at_random = test.score(np.random.default_rng(0).permutation(layout.n_cells))
    if now.surplus.sum() < MAJORITY * at_random.surplus.sum():
        return None  # another sensor
    return Rewiring(source, tuple(steps), total, len(events))


def _certain(gain: Floats) -> bool:
    """Return whether the gains of the events, ``[n]``, prove a permutation, even without the two largest."""
    return bool(gain.sum() >= _LIMIT and np.sort(gain)[:-_WITHOUT].sum() > 0)


class _Score(NamedTuple):
    """Log likelihood of each event, ``[n]``, and by how much that of each cell exceeds its expectation, ``[D]``."""

    by_event: Floats
    surplus: Floats


@dataclass(frozen=True)
class _Test:
    """Scores permutations on the same events.

    Attributes:
        events: frames ``[t, D]`` of each event.
        weight: float ``[n]``, of each event.
        model, scale: of the reference.
        present: bool ``[D]``, where there is a cell.
        moved: bool ``[D]``, indices whose readings move.
    """

    events: Sequence[Floats]
    weight: Floats
    model: HealthyModel
    scale: Scale
    present: Mask
    moved: Mask

    def score(self, source: Cells) -> _Score:
        """Return the score of one permutation."""
        near = self.scale.root_near
        roots = (self.scale.root_load(frames[:, source]) for frames in self.events)
        features = np.stack([Summary.of(root, 0, near).features() for root in roots])
        expected = self.model.predict(features, self.moved[source] & self.present)
        likely, states = expected.log_likelihood(features), expected.states
        usual = (states * np.log(states)).sum(axis=0)
        # The same readings count for each permutation; a load where no cell is, is as good as impossible.
        likely = np.where(self.present, likely, np.where(features[:, 2] > 0, np.log(MIN_P_FLOOR), 0.0))
        likely, usual = (np.where(self.moved[source], of, 0.0) for of in (likely, usual * self.present))
        return _Score(self.weight * likely.sum(axis=1), (self.weight[:, None] * (likely - usual)).sum(axis=0))


def _events(recordings: Sequence[NDArray[np.float64]], scale: Scale) -> tuple[list[Floats], Floats]:
    """Return frames ``[t, D]`` of each of the strongest contact events of the log, and the weights ``[n]``."""
    events, found = [], []
    for recording in recordings:
        frames = np.nan_to_num(held(recording, np.full(recording.shape[1], np.nan))[1:], nan=0.0)
        for event in contact_events(frames, scale):
            own = frames[event.first : event.end]
            own = own[np.linspace(0, len(own) - 1, min(len(own), _FRAMES)).astype(int)]
            events.append(event)
            found.append(own)
    amplitudes = [event.amplitude(np.ones(len(event.lowest), np.float32)) for event in events]
    # In time order, and no more: the repeats of a whole log would be counted in a square of its events.
    strongest = np.sort(np.argsort(np.negative(amplitudes), kind="stable")[:_EVENTS]).tolist()
    return [found[i] for i in strongest], 1 / (1 + count_repeats([events[i] for i in strongest], THE_SAME))


def _candidates(layout: SensorLayout, surplus: Floats, source: Cells) -> Iterator[_Candidate]:
    """Yield the permutations that are tried, each on top of ``source``; with declared wiring only exchanged pads."""
    grid, score = layout.grid(np.arange(layout.n_cells)), layout.grid(surplus)
    most = int(np.clip(_WORK // layout.n_cells, _FEW_LINES, _LINES))  # fewer on large arrays, where each costs more
    for pad in range(layout.pads) if layout.is_matrix else ():
        for axis, kind in enumerate(("row", "column")):
            size = grid.shape[axis + 1]
            worst = np.sort(np.argsort(score[pad].sum(axis=1 - axis))[:most]).tolist()
            orders = [
                (_exchanged(size, a, b), f"{kind}s {a} and {b} of pad {pad} are exchanged")
                for a, b in combinations(worst, 2)
            ]
            if size > 2:
                orders.append((np.arange(size)[::-1], f"the {kind}s of pad {pad} are in reverse order"))
            if size > 3:
                for by in (1, -1):
                    orders.append((np.roll(np.arange(size), -by), f"the {kind}s of pad {pad} are shifted by {by:+d}"))
            for order, text in orders:
                changed = grid.copy()
                changed[pad] = np.take(grid[pad], order, axis=axis)
                yield _Candidate(source[changed.ravel()], text)
    for a, b in combinations(range(layout.pads), 2):
        yield _Candidate(source[grid[_exchanged(layout.pads, a, b)].ravel()], f"pads {a} and {b} are exchanged")


def _exchanged(size: int, a: int, b: int) -> NDArray[np.intp]:
    """Return the order of ``size`` lines or pads with two of them exchanged."""
    order = np.arange(size)
    order[[a, b]] = b, a
    return order
