"""The search for recordings in which cells and lines hold a value while those beside them move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.levels import CERTAIN_RATIO, FEWEST, MAJORITY, SUSPICIOUS
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.when.held_again import held_again
from diagnostics.when.mixture import QUIET_LEVELS, Found, Mixture, Symbol
from diagnostics.when.spans import Spans
from diagnostics.when.weak import shares_of_load

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

SUSPECT = 8.0  # log odds from which on nothing is learned from a cell in these recordings
# of a line: where its cells agree, healthy ones that a task leaves untouched hardly do
SUSPECT_LINE = SUSPICIOUS
_FEWEST = 2 * FEWEST  # recordings
_ROUNDS = 5  # at most: a size
_LEVELS = 8  # of how far the cells beside one move: a size
_CONTEXTS = (_LEVELS + 1) * QUIET_LEVELS
_QUIET = np.array([0.3, 0.7])  # shares of the cells at rest that do not dither
_ALL = 0.9  # share of a line's cells that hold a value, where it does
_FEWEST_ON_LINE = 4
_WITNESSES = 3  # recordings whose median is no cell's jump to the value it is stuck at


@dataclass(frozen=True)
class Held:
    """Where cells hold a value although those beside them move.

    Attributes:
        evidence: float ``[D]``, log odds that a cell is faulty in its recordings; -inf: none.
        suspect: bool ``[n, D]``, what nothing should be learned from.
        moved: bool ``[n, D]``, where a cell moved.
        value: float ``[D]``, what it reads in these recordings; NaN: none.
        again: bool ``[n, D]``, where it holds a value away from rest that it holds again and again
            (:mod:`diagnostics.when.held_again`): no proof.
        share: float ``[D]``, of what the cells on both sides read, in nearly every contact; NaN: no
            less than usual (:mod:`diagnostics.when.weak`). No proof.
    """

    evidence: Floats
    suspect: Mask
    moved: Mask
    value: Floats
    again: Mask
    share: Floats

    @classmethod
    def nothing(cls, spans: Spans, tolerance: float) -> Held:
        """Return that no cell is suspect."""
        n_cells = spans.low.shape[1]
        return cls(
            np.full(n_cells, -np.inf),
            np.zeros(spans.low.shape, bool),
            spans.ranges > 2 * tolerance,
            np.full(n_cells, np.nan),
            np.zeros(spans.low.shape, bool),
            np.full(n_cells, np.nan),
        )

    def of(self, cells: NDArray[np.intp]) -> Held:
        """Return the same of some cells."""
        return Held(
            self.evidence[cells],
            self.suspect[:, cells],
            self.moved[:, cells],
            self.value[cells],
            self.again[:, cells],
            self.share[cells],
        )

    @property
    def probability(self) -> Floats:
        """P(a cell is faulty in its recordings), ``[D]``."""
        return np.asarray(np.exp(-np.logaddexp(0.0, -self.evidence)))

    @property
    def certain(self) -> Mask:
        """Where cells are faulty, bool ``[n, D]``."""
        return self.suspect & (self.evidence >= CERTAIN_RATIO)

    def states(self) -> list[tuple[tuple[int, ...], NDArray[np.intp]]]:
        """Return the sets of recordings in which some cells are suspect, with the cells, the
        largest first."""
        cells = np.flatnonzero(self.suspect.any(axis=0))
        of: dict[tuple[int, ...], list[int]] = {}
        for cell in cells.tolist():
            key = tuple(np.flatnonzero(self.suspect[:, cell]).tolist())
            of.setdefault(key, []).append(cell)
        by_size = sorted(of.items(), key=lambda item: (-len(item[1]), item[0]))
        return [(recordings, np.array(some)) for recordings, some in by_size]


def find_held(
    spans: Spans, layout: SensorLayout, tolerance: float, classes: ArrayLike | None = None
) -> Held:
    """Return in which recordings cells hold a value although those beside them move.

    Args:
        spans: of n recordings, in time order.
        layout: the array.
        tolerance: a constant cell stays within +- this, in the layout's unit.
        classes: of each recording, ``[n]``; None: unknown.
    """
    found = Held.nothing(spans, tolerance)
    if len(spans) >= _FEWEST:
        number = None
        if classes is not None:
            _, number = np.unique(np.asarray(classes), return_inverse=True)
        found = _Search(spans, layout, tolerance, number).held()
    share = shares_of_load(spans, layout)
    return replace(found, again=held_again(spans, layout), share=share)


class _Search:
    """The search of a log; see the module."""

    def __init__(
        self,
        spans: Spans,
        layout: SensorLayout,
        tolerance: float,
        classes: NDArray[np.intp] | None,
    ) -> None:
        # A fault may last in time, and class by class.
        orders = [np.arange(len(spans))]
        if classes is not None:
            orders.append(np.argsort(classes, kind="stable"))
        self._spans = spans
        self._tolerance = tolerance
        self._known = spans.known & layout.is_cell
        nothing = Held.nothing(spans, tolerance)
        self._nothing = nothing
        self._moved = nothing.moved
        moves = np.clip(spans.ranges - 2 * tolerance, 0.0, None) / layout.full_scale
        self._moves = np.sqrt(moves)
        self._exact = self._known & (spans.ranges <= 0)
        self._symbol = self._symbols(layout)
        self._beside = layout.beside
        self._on, self._near = _lines(layout)
        self._cells = Mixture(self._symbol, _CONTEXTS, orders, classes)
        self._lines = Mixture(self._line_symbols(), _CONTEXTS, orders)

    def held(self) -> Held:
        """Return what is found once nothing changes any more."""
        trusted = self._known
        suspect = np.zeros_like(trusted)
        cells = lines = None
        for number in range(_ROUNDS):
            context, told = self._contexts(trusted)
            cells = self._step(self._cells, number, context, told, cells)
            found = cells.states & (cells.evidence > self._limit(number)) & ~self._moved
            evidence = cells.evidence
            if len(self._on):
                context, told = self._line_contexts(trusted)
                lines = self._step(self._lines, number, context, told, lines)
                of_lines = lines.states & (lines.evidence > self._limit(number, lines=True))
                on_line = of_lines.astype(np.float64) @ self._on > 0
                found = found | on_line & ~self._moved & self._known
                each = np.where(self._on > 0, lines.evidence[:, None], -np.inf)
                evidence = np.where(
                    on_line.any(axis=0), np.maximum(evidence, each.max(axis=0)), evidence
                )
            if number == 0 and not found.any():
                return self._nothing
            settled = (found == suspect).all() and number > 1
            suspect = found
            trusted = self._known & ~suspect
            if settled:
                break
        return self._concluded(evidence, suspect)

    @staticmethod
    def _limit(number: int, *, lines: bool = False) -> float:
        """Return the log odds of a suspicion: none at first."""
        if number == 0:
            return 0.0
        return SUSPECT_LINE if lines else SUSPECT

    def _step(
        self,
        mixture: Mixture,
        number: int,
        context: NDArray[np.intp],
        told: Mask,
        last: Found | None,
    ) -> Found:
        """Return the result of one round."""
        if not told.any():
            return Found(np.full(told.shape[1], -np.inf), np.zeros_like(told))
        if last is None:
            return mixture.first(context, told)
        limit = self._limit(number - 1, lines=mixture is self._lines)
        trusted = ~(last.states & (last.evidence > limit))
        return mixture.again(context, told, trusted, new=number == 1)

    def _concluded(self, evidence: Floats, suspect: Mask) -> Held:
        """Return the result with what the cells read, of cells that work in some recording."""
        suspect = suspect & (self._known & ~suspect).any(axis=0)
        evidence = np.where(suspect.any(axis=0), evidence, -np.inf)
        middles = np.where(suspect, self._spans.middles, np.nan)
        value = np.full(len(evidence), np.nan)
        some = np.isfinite(middles).any(axis=0)
        value[some] = np.nanmedian(middles[:, some], axis=0)
        return replace(self._nothing, evidence=evidence, suspect=suspect, value=value)

    def _symbols(self, layout: SensorLayout) -> NDArray[np.intp]:
        """Return the symbol of each cell in each recording, ``[n, D]``."""
        elsewhere = np.ones(self._moved.shape, bool)
        for rest in self._rests(layout):
            elsewhere &= self._away(rest, layout) > 4 * self._tolerance
        held = np.where(elsewhere, Symbol.HELD, Symbol.RESTED)
        exactly = np.where(elsewhere, Symbol.HELD_EXACTLY, Symbol.RESTED_EXACTLY)
        still_symbol = np.where(self._exact, exactly, held)
        return np.where(self._moved, Symbol.MOVED, still_symbol).astype(np.intp)

    def _rests(self, layout: SensorLayout) -> list[Floats]:
        """Return what each cell may rest at, ``[D]`` each; NaN: nothing tells.

        A cell rests at what it reads lowest in the recordings in which it moves: where it fails
        early, what it is stuck at lasts longer. One that hardly ever moves, or moves under loads
        that never end, rests where most others of its pad do.
        """
        moves = self._moved & self._known
        own = known_quantile(np.where(moves, self._spans.low, np.nan), 0.5, axis=0)
        own[moves.sum(axis=0) < _WITNESSES] = np.nan
        still = np.where(self._moved | ~self._known, np.nan, self._spans.middles)
        usual = known_quantile(still, 0.5, axis=0)
        of_pad = np.full(len(own), np.nan)
        for pad in range(layout.pads):
            on_pad = layout.pad_of == pad
            level = known_quantile(usual[on_pad], 0.5, axis=0)
            agree = np.abs(usual[on_pad] - level) <= 4 * self._tolerance
            if agree.sum() > MAJORITY * np.isfinite(usual[on_pad]).sum():
                of_pad[on_pad] = level
        own = np.where(np.isnan(own), of_pad, own)
        return [own, np.where(np.isnan(of_pad), own, of_pad)]

    def _away(self, rest: Floats, layout: SensorLayout) -> Floats:
        """Return how far cells hold from where they rest (``[D]``), ``[n, D]``; what all cells of
        a pad at rest share does not count; NaN: unknown."""
        away = self._spans.middles - rest
        still = np.where(self._moved | ~self._known, np.nan, away)
        for pad in range(layout.pads):
            of_pad = layout.pad_of == pad
            away[:, of_pad] -= np.nan_to_num(known_quantile(still[:, of_pad], 0.5, axis=1))[:, None]
        found: Floats = np.abs(away)
        return found

    def _line_symbols(self) -> NDArray[np.intp]:
        """Return the symbol of each line in each recording, ``[n, lines]``."""
        count = self._known.astype(np.float64) @ self._on.T
        moved = (self._moved & self._known).astype(np.float64) @ self._on.T
        exact = self._exact.astype(np.float64) @ self._on.T
        held = np.where(exact >= _ALL * count, Symbol.RESTED_EXACTLY, Symbol.RESTED)
        return np.where(moved > (1 - _ALL) * count, Symbol.MOVED, held).astype(np.intp)

    def _of_lines(self, known: Mask) -> Mask:
        """Return whether a cell of each line is known, bool ``[n, lines]``."""
        return np.asarray(known.astype(np.float64) @ self._on.T > 0)

    def _contexts(self, trusted: Mask) -> tuple[NDArray[np.intp], Mask]:
        """Return the context of each cell, int ``[n, D]``, and where there is any."""
        total = np.zeros(trusted.shape)
        count = np.zeros(trusted.shape)
        for other in self._beside.T:
            counts = trusted[:, other] & (other >= 0)
            total += np.where(counts, self._moves[:, other], 0.0)
            count += counts
        context = self._with_quiet(total / np.maximum(count, 1), trusted)
        return context, (count > 0) & self._known

    def _line_contexts(self, trusted: Mask) -> tuple[NDArray[np.intp], Mask]:
        """Return the context of each line, int ``[n, lines]``, and where there is any."""
        count = trusted.astype(np.float64) @ self._near.T
        total = (trusted * self._moves) @ self._near.T
        context = self._with_quiet(total / np.maximum(count, 1), trusted)
        return context, (count > 0) & self._of_lines(self._known)

    def _with_quiet(self, beside: Floats, trusted: Mask) -> NDArray[np.intp]:
        """Return contexts: how far the cells beside move, and how many cells at rest do not
        dither."""
        moving = beside[beside > 0]
        edges = np.array([np.finfo(float).tiny])
        if len(moving):
            inner = np.quantile(moving, np.linspace(0, 1, _LEVELS)[1:-1])
            edges = np.unique(np.append(edges, inner))
        level = np.searchsorted(edges, beside, side="right")
        still = trusted & ~self._moved
        # where most cells move, the others tell little of how the array dithers
        least = MAJORITY * trusted.sum(axis=1)
        exact = (still & self._exact).sum(axis=1)
        share = exact / np.maximum(np.maximum(still.sum(axis=1), least), 1)
        quiet = np.searchsorted(_QUIET, share, side="right")[:, None]
        return np.asarray(level + (_LEVELS + 1) * quiet)


def _lines(layout: SensorLayout) -> tuple[Floats, Floats]:
    """Return which cells are on each line, and which are beside it, 0 or 1, ``[lines, D]`` each.

    Lines of few cells, and of most cells of the array, say nothing that their cells do not.
    """
    on: list[Floats] = []
    near: list[Floats] = []
    for line in layout.lines:
        mine = np.zeros(layout.n_cells)
        mine[layout.cells_on(line)] = 1.0
        if not _FEWEST_ON_LINE <= mine.sum() < MAJORITY * layout.is_cell.sum():
            continue
        others = layout.beside[mine > 0].ravel()
        next_to = np.zeros(layout.n_cells)
        next_to[others[others >= 0]] = 1.0
        next_to *= 1 - mine
        if next_to.any():
            on.append(mine)
            near.append(next_to)
    if not on:
        return np.zeros((0, layout.n_cells)), np.zeros((0, layout.n_cells))
    return np.stack(on), np.stack(near)
