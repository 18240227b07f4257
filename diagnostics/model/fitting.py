"""Fits the model to fault-free recordings.

Conditional means, networks and tables are cross-fitted: each recording is judged by what did not
see it. The network learns with cells left out, as logs have faulty ones. Logs that are held out
tell how often each healthy cell is odd, and with dead cells beside them the factor on the evidence
of each way to fail: what it says of a healthy cell stays below certainty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.model.conditional_mean import ConditionalMean, CrossFitted
from diagnostics.model.groups import as_one_of, fit_groups
from diagnostics.model.judge import Judgement, Model
from diagnostics.model.lines import NO_HALF, Lines, fit_lines, odd_of
from diagnostics.model.observed import Log, Observed
from diagnostics.model.over_time import CERTAIN
from diagnostics.model.predictor import CrossFittedNetwork, Network, Predictor
from diagnostics.model.record import Array, Cells, Mask, Record, frames_of_piece, record_of
from diagnostics.model.rest import fit_rest
from diagnostics.model.symbols import (
    NOTHING,
    CrossFittedFlatness,
    Flatness,
    Symbols,
    activity_of,
    before_of,
    root_load,
)
from diagnostics.model.ways import WAYS
from diagnostics.preprocessing.levels import FEWEST
from diagnostics.preprocessing.tolerance import converter_step, tolerance_of

_FOLDS = 4
_HALVES = 2  # of the folds: networks and tables without each
_FEWER = 0.5  # of the steps of a network of half the recordings
_LEFT_OUT = (
    0.0,
    0.04,
    0.1,
    0.2,
    0.4,
    0.6,
    1.0,
)  # shares of the cells that the network goes without
_EXAMPLES = 400_000  # of the network
_JOINED = 0.05  # of the pieces: another recording goes before, as in a log of joined ones
_BEGINS = 0.1  # of them: a recording begins with it, as one that is cut does
_UNLOADED = 5  # one in so many pieces in which nothing is loaded
_LIVES = 1e-5  # of full scale: a range of readings
_ODD_UNITS = 50.0  # units of all cells that weigh on the share of one
_RARELY = 1e-3
_OFTEN = 0.2
_SHORTEST = 24  # frames of a recording that is taken apart
_LOGS = 48
_OF_LOGS = 0.4  # of the time of a fit, for the progress only
_LENGTHS = (3, 6, 6, 40)  # recordings of a log
_SHORT = 6  # of a short one
_DEAD = (0.0, 0.04, 0.08, 0.16)  # shares of the cells that are dead in it
_EXCEED = 0.1  # healthy cells of a log exceed the limit of all
_USUALLY = 0.95  # of the healthy cells
_OBJECT = 2  # cells from its middle to its edge

Recordings = Sequence[NDArray[np.floating]]
Examples = tuple[Array, NDArray[np.int8]]


@dataclass(frozen=True)
class _Reference:
    """The reference while the model is fitted.

    Attributes:
        recordings: ``[T, D]`` each.
        record: of all of them.
        symbols: of healthy cells.
        load, level, flat: of the record, ``[n, D]``.
        living: bool ``[D]``.
        fold: int, of each recording.
        means: without each of the folds.
    """

    recordings: Recordings
    record: Record
    symbols: Symbols
    load: Array
    level: NDArray[np.int8]
    flat: NDArray[np.int8]
    living: Mask
    fold: Cells
    means: Sequence[ConditionalMean]

    @classmethod
    def of(
        cls,
        recordings: Recordings,
        record: Record,
        layout: SensorLayout,
        living: Mask,
        rng: np.random.Generator,
    ) -> _Reference:
        """Return the recordings as symbols, in folds."""
        step = converter_step(recordings, layout)
        rest = fit_rest(record, float(layout.full_scale), step, layout.pad_of, living)
        above = rest.above(record, rest.shared(record, living).offset)
        symbols = Symbols.fit(above, rest, living)
        load = root_load(above, rest)
        level = symbols.levels(record, above, np.zeros(above.shape, bool))
        fold = rng.permutation(len(recordings)) % min(_FOLDS, len(recordings))
        of_piece = fold[record.recording]
        means = [
            ConditionalMean.fit(load[of_piece != k], layout, living) for k in range(fold.max() + 1)
        ]
        flat = symbols.flat(record)
        return cls(recordings, record, symbols, load, level, flat, living, fold, means)

    @property
    def of_piece(self) -> Cells:
        """Fold of each piece, int ``[n]``."""
        return self.fold[self.record.recording]

    def flatness(self, chosen: Mask) -> Flatness:
        """Return how flat the ``chosen`` pieces (bool ``[n]``) are."""
        return Flatness.fit(
            self.symbols.group(self.level[chosen]),
            activity_of(self.level[chosen], self.flat[chosen], self.living),
            self.flat[chosen],
            before_of(self.flat, self.record)[chosen],
            self.living,
        )


def fit_model(
    recordings: Recordings,
    layout: SensorLayout,
    dead: Mask,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Model | None:
    """Fit to fault-free recordings ``[T, D]`` of loads or readings, NaN: missing.

    Args:
        recordings: in which cells move; few long ones are taken apart.
        layout: of the array; ``full_scale`` is the highest reading that there is.
        dead: bool ``[D]``, cells that are dead in them.
        progress: receives the share of the work that is done.

    Returns:
        None: too few frames, or no cell moves in them.
    """
    rng = np.random.default_rng(0)
    longest = max(map(len, recordings))
    recordings = _enough([np.asarray(one, np.float32) for one in recordings])
    present = layout.is_cell
    length = frames_of_piece(recordings)
    record = record_of(recordings, length)
    ranges = np.fmax.reduce(record.high) - np.fmin.reduce(record.low)
    living = present & ~dead & (ranges > _LIVES * layout.full_scale)
    if len(recordings) < FEWEST or not living.any():
        return None
    reference = _Reference.of(recordings, record, layout, living, rng)
    symbols = reference.symbols
    load = reference.load
    whole = ConditionalMean.fit(load, layout, living)
    progress(0.1)
    predictor = Predictor.of(load, layout, living, whole)
    examples = _examples(predictor, reference, rng)
    network = Network.fit(*_together(examples), symbols.n)
    progress(0.4)
    cross_fitted = CrossFitted.of(reference.means, reference.of_piece)
    half = reference.of_piece % _HALVES
    lines, resting = fit_lines(layout, living, cross_fitted, load, record, half)
    tolerance = tolerance_of([np.asarray(one, float) for one in recordings], layout)
    as_one = as_one_of(layout, living, symbols, reference.flat, tolerance)
    if len(as_one.on):
        record = record_of(recordings, length, as_one)
        reference = replace(reference, record=record)
    log = Log(record, symbols, present, living)
    groups, chain = fit_groups(as_one, log, half)
    held_out = _held_out(reference, examples, resting, chain)
    del examples  # a hundred megabytes of a large array
    progress(0.5)
    flatness = reference.flatness(np.ones(len(record), bool))
    model = Model.of(symbols, flatness, predictor, length, longest, present, living, lines, groups)
    held_out.judge(model, reference.of_piece)
    observed = model.observed(log, living & log.received)
    model.odd = _odd(observed, living)
    model.lines = replace(model.lines, odd=_odd_lines(model.lines, observed))
    progress(1 - _OF_LOGS)
    _judge_logs(model, reference, held_out, rng, progress)
    return replace(
        model,
        lines=replace(model.lines, resting=lines.resting, half=NO_HALF),
        groups=replace(model.groups, chain=groups.chain, half=NO_HALF),
        predictor=replace(predictor, mean=whole, network=network),
        flatness=flatness,
    )


def _enough(recordings: list[Array]) -> list[Array]:
    """Return the recordings, the longest in halves until there are enough to leave some out."""
    while len(recordings) < FEWEST:
        longest = max(range(len(recordings)), key=lambda i: len(recordings[i]))
        one = recordings[longest]
        if len(one) < _SHORTEST:
            break
        half = len(one) // 2
        recordings[longest : longest + 1] = [one[:half], one[half:]]
    return recordings


@dataclass(frozen=True)
class _HeldOut:
    """What is fitted without each fold: conditional means, and without each half: networks and
    tables; how lines rest, and chains of groups."""

    means: Sequence[ConditionalMean]
    networks: Sequence[Network]
    tables: Sequence[Flatness]
    resting: Array
    chain: Array

    def judge(self, model: Model, fold: Cells) -> None:
        """Let a model judge pieces of these folds (int ``[n]``) by what has not seen them."""
        half = fold % len(self.networks)
        model.predictor.mean = CrossFitted.of(self.means, fold)
        model.predictor.network = CrossFittedNetwork.of(self.networks, half)
        model.flatness = CrossFittedFlatness.of(self.tables, half)
        model.lines = replace(model.lines, resting=self.resting, half=half)
        model.groups = replace(model.groups, chain=self.chain, half=half)


def _held_out(
    reference: _Reference,
    examples: Sequence[Examples],
    resting: Array,
    chain: Array,
) -> _HeldOut:
    """Return what is fitted without each fold, and without each half of them."""
    half = reference.of_piece % _HALVES
    networks = []
    tables = []
    for k in range(min(_HALVES, len(examples))):
        others = [of_fold for i, of_fold in enumerate(examples) if i % _HALVES != k]
        networks.append(Network.fit(*_together(others), reference.symbols.n, _FEWER))
        tables.append(reference.flatness(half != k))
    return _HeldOut(reference.means, networks, tables, resting, chain)


def _together(examples: Sequence[Examples]) -> Examples:
    inputs = [of_fold[0] for of_fold in examples]
    levels = [of_fold[1] for of_fold in examples]
    return np.concatenate(inputs), np.concatenate(levels)


def _examples(
    predictor: Predictor, reference: _Reference, rng: np.random.Generator
) -> list[Examples]:
    """Return inputs and levels that the network learns, ``[n, k]`` and int ``[n]`` of each
    fold."""
    record = reference.record
    load = reference.load
    cells = np.flatnonzero(reference.living)
    most = int(_EXAMPLES / len(cells) / len(reference.means) / len(_LEFT_OUT)) + 1
    examples = []
    for k, mean in enumerate(reference.means):
        inputs = []
        levels = []
        predictor.mean = mean
        mine = np.flatnonzero(reference.fold[record.recording] == k)
        part = rng.integers(0, len(_LEFT_OUT), len(mine))
        for i, share in enumerate(_LEFT_OUT):
            known = reference.living.copy()
            known[rng.choice(cells, int(share * len(cells)), replace=False)] = False
            of_part = mine[part == i]
            on = load[of_part].max(axis=1) > NOTHING
            of_part = of_part[on | (np.arange(len(of_part)) % _UNLOADED == 0)]
            if not len(of_part):
                continue
            chosen = rng.choice(of_part, min(len(of_part), most), replace=False)
            joined = rng.random(len(chosen)) < _JOINED
            before = np.where(joined, rng.choice(mine, len(chosen)), chosen - 1)
            in_turn = np.stack([before, chosen], axis=1).ravel()
            first = np.ones(len(in_turn), bool)
            begins = record.first[chosen] | (rng.random(len(chosen)) < _BEGINS)
            first[1::2] = begins & ~joined
            told = load[in_turn]
            found = predictor.inputs(told, told, first, known)[1::2, cells]
            inputs.append(found.reshape(-1, found.shape[-1]))
            levels.append(reference.level[chosen][:, cells].ravel())
        examples.append((np.concatenate(inputs), np.concatenate(levels)))
    return examples


def _odd(observed: Observed, living: Mask) -> Array:
    """Return in which share of its units each healthy cell is odd, ``[D]``."""
    units = len(observed.odd)
    odd = observed.odd.sum(axis=0)
    pooled = max(odd[living].sum() / max(1, units * living.sum()), _RARELY)
    share = (odd + _ODD_UNITS * pooled) / (units + _ODD_UNITS)
    found: Array = np.clip(share, _RARELY, _OFTEN).astype(np.float32)
    return found


def _odd_lines(lines: Lines, observed: Observed) -> Array:
    """Return in which share of the recordings each healthy line is odd, ``[W]``."""
    found = lines.evidence(observed, observed.known, observed.known)
    return odd_of(found[1])


def _judge_logs(
    model: Model,
    reference: _Reference,
    held_out: _HeldOut,
    rng: np.random.Generator,
    progress: Callable[[float], None],
) -> None:
    """Let a model know the evidence of each way that healthy cells reach, lines and groups with
    them, in logs that are held out, with dead cells beside.

    In the first two thirds of the logs it is told who is healthy. What cells reach there bounds the
    evidence in the others, in which it finds them by itself: without a bound, some healthy cell of
    a long log always looks faulty, and misleads the others once it is left out.
    """
    cells = np.flatnonzero(model.living)
    of_objects = np.random.default_rng(1)
    reached = _Reached.of(model)
    of_lines = np.zeros(len(model.lines.on), np.float32)
    of_groups = np.zeros(len(model.groups.odd), np.float32)
    pieces = 1
    for i in range(_LOGS):
        size = min(len(reference.recordings), _LENGTHS[i % len(_LENGTHS)])
        chosen = rng.choice(len(reference.recordings), size, replace=False)
        share = _DEAD[i // len(_LENGTHS) % len(_DEAD)]
        dead = rng.choice(cells, int(share * len(cells)), replace=False)
        log = [reference.recordings[j].copy() for j in chosen.tolist()]
        for cell in dead:
            value = rng.uniform(0, 1) * model.symbols.rest.full
            for frames in log:
                frames[:, cell] = value
        of_frame = np.repeat(reference.fold[chosen], [len(frames) for frames in log])
        if (i + i // len(_LENGTHS)) % 2:  # every other log of each length
            log = [np.concatenate(log)]
        record = model.record_of(log)
        held_out.judge(model, of_frame[record.begins])
        healthy = model.living.copy()
        healthy[dead] = False
        told = 3 * i < 2 * _LOGS
        if not told:
            reached.bound(model)
        judgement = model.judge_record(record, healthy=healthy if told else None)
        of_lines = np.maximum(of_lines, _of_healthy_lines(model, judgement, rng, of_objects))
        moving = judgement.observed.log.far & model.living
        of_group, _ = model.groups.evidence(judgement.observed.log, moving)
        of_groups = np.maximum(of_groups, of_group)
        reached.add(judgement, healthy, is_long=size > _SHORT)
        pieces = max(pieces, len(record))
        progress(1 - _OF_LOGS * (1 - (i + 1) / _LOGS))
    reached.bound(model)
    model.lines = replace(model.lines, highest=of_lines, reached=int(model.reached.max()))
    model.groups = replace(model.groups, highest=of_groups, reached=pieces)


@dataclass(frozen=True)
class _Reached:
    """The evidence of each way that healthy cells reach.

    Attributes:
        highest: ``[2, ways, D]``, in short logs and in long ones.
        every: evidence ``[ways, cells]`` of the healthy cells of each log, short and long ones.
        units: int ``[2]``, most units of a log.
    """

    highest: Array
    every: tuple[list[Array], list[Array]]
    units: Cells

    @classmethod
    def of(cls, model: Model) -> _Reached:
        """Return what they reach before any log."""
        highest = np.zeros((2, len(WAYS), len(model.present)), np.float32)
        return cls(highest, ([], []), np.ones(2, np.intp))

    def add(self, judgement: Judgement, healthy: Mask, *, is_long: bool) -> None:
        """Take in a log; ``healthy``: bool ``[D]``, who is."""
        number = int(is_long)
        evidence = judgement.of_ways[:, healthy]
        before = self.highest[number][:, healthy]
        self.highest[number][:, healthy] = np.maximum(before, evidence)
        self.every[number].append(evidence)
        self.units[number] = max(self.units[number], len(judgement.units.begins))

    def bound(self, model: Model) -> None:
        """Let a model know it: of each cell, and what one of ten logs exceeds of all; and of which
        ways hardly any healthy cell is certain."""
        highest = self.highest.copy()
        cells = int(model.living.sum())
        for of_length, logs in zip(highest, self.every, strict=True):
            if logs:
                evidence = np.concatenate(logs, axis=1)
                tail = np.quantile(evidence, 1 - _EXCEED / cells, axis=1)
                np.maximum(of_length, tail[:, None], out=of_length)
                usually = np.quantile(evidence, _USUALLY, axis=1)
                model.telling &= usually < CERTAIN
        model.highest = np.maximum.accumulate(highest)
        model.reached = np.maximum.accumulate(self.units)


def _of_healthy_lines(
    model: Model, judgement: Judgement, rng: np.random.Generator, of_objects: np.random.Generator
) -> Array:
    """Return the evidence of each line ``[W]`` in a log without broken ones, with a line beside it
    that is left out, and with cells that an object lies on; each generator draws where."""
    observed = judgement.observed
    moving = model.moving(observed.log)
    found = np.zeros(len(model.lines.on), np.float32)
    if len(found):
        out = model.lines.on[rng.integers(len(found))]
        under = _around(model, int(of_objects.choice(np.flatnonzero(model.living))))
        for free in (np.ones_like(out), ~out, ~under):
            known = observed.known & free
            evidence = model.lines.evidence(observed, known, moving & free)
            found = np.maximum(found, evidence[0])
    return found


def _around(model: Model, cell: int) -> Mask:
    """Return a cell and those around it, as many as an object loads, bool ``[D]``."""
    found = np.zeros(len(model.present), bool)
    found[cell] = True
    for _ in range(_OBJECT):
        beside = model.predictor.beside[found]
        found[beside[beside >= 0]] = True
    return found
