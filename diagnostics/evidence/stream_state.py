"""The state of a log: fed frame by frame, of constant size, and independent of how the frames are
split into blocks.

Frames are processed in segments of 32. The state keeps the constant run of every cell and the last
contact events of every tile (see ``events.tiles``; an array of up to 400 cells is one tile). Older
events are scored, and only their summed evidence is kept.

A tile cannot tell which cells of its halo are faulty, but their own tiles can. So several tiles are
scored twice: first with the moving cells as predictors, then without the cells that their own tile
suspects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.events.contact_events import THE_SAME, EventLog, count_repeats
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import Rectangle, Tile, tiles
from diagnostics.evidence.conditional_test import (
    CellState,
    ConditionalTest,
    HeldValues,
    Model,
    novelty,
)
from diagnostics.evidence.drift import offset_evidence
from diagnostics.evidence.duplicate_lines import DuplicateLines, informative
from diagnostics.evidence.intermittency import Intermittency
from diagnostics.evidence.jumps import SUDDEN_JUMP
from diagnostics.evidence.life import EvidenceOfLog, LifeRecord, LifeTest
from diagnostics.evidence.pad_level import PadLevel
from diagnostics.evidence.rest_level import RestLevel
from diagnostics.evidence.spatial import Exclusion, Spatial, SpatialTest, held_load_evidence
from diagnostics.evidence.term import ConstantCells, Term
from diagnostics.evidence.weak_response import WeakResponse
from diagnostics.healthy.nearest_neighbours import NearestNeighbours
from diagnostics.healthy.prediction import OUTLIERS
from diagnostics.preprocessing.levels import LIGHT, MAJORITY, SUSPICIOUS
from diagnostics.preprocessing.noise import NoiseNow
from diagnostics.preprocessing.offset import OffsetTracker, even_rests
from diagnostics.preprocessing.readings import SEGMENT, held
from diagnostics.preprocessing.rest_of_log import RestOfLog
from diagnostics.preprocessing.transport import TransportState, invalid

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.layout import SensorLayout
    from diagnostics.model.record import Record, Recorder
    from diagnostics.preprocessing.load import LoadDirection
    from diagnostics.preprocessing.scale import Array, Scale
    from diagnostics.sensor.crosstalk import Crosstalk

# with more events in a tile, all but the last are scored and dropped
MAX_EVENTS = 40
KEPT_EVENTS = 32
# consecutive frames without a reading: not chance any more
_SILENT = 2 * SEGMENT
_NEVER_RECEIVED = SEGMENT // 2
# a shorter segment, as the last one of a log, leaves old events for the next one
_FEW = SEGMENT // 2
_CLEAR = 4.0  # times the tolerance of two equal lines: lighter loads are equal by chance

Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]


class StreamState:
    """The state of a diagnosis after some frames.

    Args:
        layout: the array.
        reference: the healthy reference.
        exclusion: when a cell is excluded from the predictors.
        needed: bool ``[D]``, the cells to be scored; None: all. Tiles without such a cell are
            skipped.
        load: how readings become loads; None: they are.
        order: int ``[D]``, which reading of a frame each cell is; None: they are in order.
        recorder: builds the record that the model judges; None: there is no model.

    Attributes:
        transport: lost and repeated frames.
        runs: the constant run of each cell.
        local: the last contact events of each tile.
        accumulated: float ``[D]``, evidence from dropped events, for the constant runs that still
            last.
        intermittency: blinks and excess noise.
        duplicates: pairs of lines that read the same.
        touched: bool ``[D]``, cells that were loaded at least once.
        scale: baseline with the present offsets, and full scale.
        below: bool ``[D]``, cells that last read less than at rest.
        life: the record for the proof of life; empty without a model of it.
        crosstalk: of lines, that the reference does not have; None: not known.
        held: bool ``[D]``, cells that hold a value in some recordings while those beside move.
    """

    def __init__(
        self,
        layout: SensorLayout,
        reference: Reference,
        exclusion: Exclusion,
        needed: Mask | None = None,
        load: LoadDirection | None = None,
        order: Cells | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        model = reference.model
        every = (
            tiles(layout)
            if model is None
            else tuple(Tile(r.inputs, r.outputs) for r in model.local_regressions)
        )
        self.layout = layout
        self.reference = reference
        self.tiled = len(every) > 1
        self.exclusion = exclusion._replace(threshold=SUSPICIOUS) if self.tiled else exclusion
        self.present = layout.present.ravel()
        self.order = order
        self.load = load
        self.below = np.zeros(layout.n_cells, bool)
        self.transport = TransportState()
        self._patience = reference.repeats(layout)
        self.runs = ConstantRuns.begin(layout.n_cells)
        self.local = TiledEvents.begin(every if self.tiled else tiles(layout), needed)
        self.accumulated = np.zeros(layout.n_cells)
        self.intermittency = Intermittency.begin(layout)
        self.duplicates = DuplicateLines.begin(layout, reference.duplicates.shares)
        self.touched = np.zeros(layout.n_cells, bool)
        self.scale: Scale = reference.scale
        # of the whole skin, if there are several tiles
        self._skin = EventLog()
        self._begun = list[int]()
        self._offsets = OffsetTracker.begin(layout.n_cells)
        self._noise = NoiseNow()
        self._rest = RestOfLog()
        self._response = WeakResponse.begin(layout.n_cells)
        self._level = RestLevel.begin(layout.n_cells)
        self.life = LifeRecord()
        self._highest = np.full(layout.n_cells, np.nan)
        self.crosstalk: Crosstalk | None = None
        self.held = np.zeros(layout.n_cells, bool)
        self._of_pad = PadLevel.begin(layout.n_cells)
        self._recorder = recorder
        self._absent = not self.present.all()  # whether some position has no cell
        self._buffer = np.empty((SEGMENT, layout.n_cells))
        self._numbers = np.empty(SEGMENT, np.intp)
        self._begins = np.zeros(SEGMENT, bool)  # frames that begin a recording
        self._begins_next = False
        self._filled = 0
        self._models: dict[int, Model] = {}

    @property
    def begun(self) -> list[int]:
        """First frames of the last contact events of the skin as a whole."""
        return self._begun if self.tiled else [event.first for event in self.local.of[0].kept]

    def begin_recording(self) -> None:
        """Take the next frame as the first one of a recording: it does not follow the last one."""
        self._begins_next = True

    def extend(self, frames: NDArray[np.float64]) -> bool:
        """Take in frames ``[t, D]`` of readings; return whether a segment was completed."""
        if self.order is not None:
            frames = frames[:, self.order]
        if self.load is not None:
            side = np.where(np.isnan(frames), self.below, frames < self.load.rest)
            self.below = side[-1].astype(bool) if len(side) else self.below
            frames = self.load.loads(frames)
        if self._absent:  # such a position may read anything
            frames = np.where(self.present, frames, self.reference.scale.baseline)
        wrong = invalid(frames, self.layout.full_scale)
        if wrong is not None:
            frames = np.where(wrong, np.nan, frames)
            self.transport = self.transport.dropped(wrong)
        before = self.transport.seen
        self.transport, new = self.transport.receive(frames, self.present, self._patience)
        if self._begins_next:
            # it tells something though it repeats the last one of another recording
            arrived = np.flatnonzero(~np.isnan(frames[:, self.present]).all(axis=1))
            new = np.union1d(arrived[:1], new)
        completed = False
        taken = 0
        while taken < len(new):
            n = min(SEGMENT - self._filled, len(new) - taken)
            chosen = new[taken : taken + n]
            self._buffer[self._filled : self._filled + n] = frames[chosen]
            self._numbers[self._filled : self._filled + n] = chosen + before
            self._begins[self._filled : self._filled + n] = False
            self._begins[self._filled] = self._begins_next
            self._begins_next = False
            self._filled += n
            taken += n
            if self._filled == SEGMENT:
                self._close()
                completed = True
        return completed

    def miss(self, frames: int) -> None:
        """Count frames that were never received, according to the sender's clock."""
        if frames > 0:
            self.transport = self.transport.without(frames)

    def complete(self) -> StreamState:
        """Return a state in which the frames of the unfinished segment are processed; this state
        stays as it is."""
        if not self._filled:
            return self
        other = copy(self)
        other._close()
        return other

    def __copy__(self) -> StreamState:
        """Return a state that takes in frames of its own."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other._buffer = self._buffer.copy()
        other._numbers = self._numbers.copy()
        other._begins = self._begins.copy()
        return other

    def reading(self, load: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the readings of loads ``[D]``, where they are not the same."""
        return load if self.load is None else self.load.readings(load, self.below)

    @property
    def received(self) -> Mask:
        """Cells that delivered a reading at least once, bool ``[D]``."""
        return self.present & np.isfinite(self.runs.last)

    @property
    def silent(self) -> Mask:
        """Cells that deliver no reading, or no longer do, bool ``[D]``."""
        return self.present & (
            self.runs.missed >= np.where(self.received, _SILENT, _NEVER_RECEIVED)
        )

    @property
    def noisier(self) -> bool:
        """Whether all cells have more noise than in the reference: how they depend on each other is
        unknown then."""
        usual = self.reference.noise
        return usual is not None and usual.raises(self._noise) > 0

    def rests(self) -> Mask:
        """Cells whose constant run lies at their baseline, bool ``[D]``."""
        return np.isfinite(self.runs.value) & (
            self.scale.root_load(self.runs.value) <= self.scale.root_near
        )

    def rest_of_pads(self) -> NDArray[np.float64]:
        """Return how far above their baselines half of the cells of each cell's pad read together,
        ``[D]``: now, or as the least since they were last unloaded.

        0 where none do, or where it is more than in the reference.
        """
        usual = self.reference.rests
        if usual is None or not usual.any():
            return np.zeros(self.layout.n_cells)
        near = self.scale.near
        pad_of = self.layout.pad_of
        now = self.runs.last - self.scale.baseline
        least = self.least_loads()[0] ** 2 * self.scale.full_scale
        rests = np.zeros(self.layout.pads)
        above = np.where(self.present, np.stack([least, now]), np.nan)
        for of in above:
            (even,) = even_rests(of[None], pad_of, len(rests), near)
            rests = np.where((even > near) & (even <= usual + near), even, rests)
        return rests[pad_of]

    def rests_with_pad(self) -> Mask:
        """Return the cells that hold what their pad rests at, above their baselines, bool
        ``[D]``."""
        level = self.rest_of_pads()
        above = self.runs.value - self.scale.baseline
        return np.asarray((level > 0) & (np.abs(above - level) <= self.scale.near))

    def unused(self, alive: Mask) -> Mask:
        """Return the cells at rest of pads that nothing shows to be in use, bool ``[D]``.

        Such a pad has no loaded cell that is ``alive``, and most of its cells were never loaded,
        nor hold full scale or a reading below their rest, while another pad is in use. Nothing
        touched it, or it is cut off where it rests: the readings are the same.
        """
        below = self.runs.value < self.scale.baseline - self.scale.near
        below &= ~self.runs.moved
        full = ~self.runs.moved & (self.runs.value >= self.scale.full_scale - self.scale.near)
        still = self.present & ~below & ~full & ~self.touched & np.isfinite(self.lowest)
        of_pad = self.layout.pad_of
        pads = self.layout.pads
        share = np.bincount(of_pad[still], minlength=pads)
        cells = np.bincount(of_pad[self.present], minlength=pads)
        used = np.bincount(of_pad[alive & self.touched], minlength=pads) > 0
        idle = ~used & (share > MAJORITY * cells)
        return np.asarray(still & idle[of_pad] & bool(used.any()))

    def temporal(self) -> NDArray[np.float64]:
        """Log likelihood ratio of the constant run, its level and noise, and the jump into it,
        ``[D]``."""
        reference = self.reference
        cells = self._constant_cells()
        if reference.model is None:
            return self._level.evidence(cells)
        terms: tuple[Term, ...] = reference.jumps_seen, reference.least, reference.noise_loss
        jump, low, noise = (term.evidence(cells) for term in terms)
        if reference.beside is not None:
            low = np.maximum(
                low, reference.beside.evidence(cells, reference.scale.baseline, self._of_pad.level)
            )
        return jump + np.where(np.abs(noise) > np.abs(low), noise, low)

    def without_noise(self) -> Mask:
        """Return the cells that have lost the noise they had in the reference, bool ``[D]``."""
        return self.reference.noise_loss.evidence(self._constant_cells()) > 0

    def _constant_cells(self) -> ConstantCells:
        """Return what the terms of constant cells are given."""
        reference = self.reference
        rests = self.rests()
        lower = reference.least.lower(self.runs, rests & self.present)
        return ConstantCells(
            self.layout, reference.scale.full_scale, reference.tolerance, self.runs, rests, lower
        )

    def model_of(self, i: int, events: EventLog) -> Model:
        """Return the healthy model of tile i; without a reference, a model of its ``events``."""
        known = self.reference.model
        if not self.tiled:
            return (
                known or NearestNeighbours.of(events.kept, self.layout, self.scale.root_near)
            ).predict
        if i in self._models:
            return self._models[i]
        own = self.local.tiles[i].rectangle(self.layout)
        if known is None:
            model = NearestNeighbours.of(events.kept, own.layout, self.scale.root_near)
            return _on_rectangle(replace(model, log=own.on(model.log)).predict, own)
        return self._models.setdefault(
            i, _on_rectangle(known.of_tile(i, own.cells, own.layout).predict, own)
        )

    @property
    def ranges(self) -> NDArray[np.float64]:
        """Highest minus lowest reading of each cell, ``[D]``; 0: none."""
        found: NDArray[np.float64] = np.nan_to_num(self._highest - self.lowest)
        return found

    @property
    def lowest(self) -> NDArray[np.float64]:
        """The lowest reading of each cell so far, ``[D]``; inf: none."""
        return self.reference.scale.baseline + self._offsets.lowest

    def log_likelihood(self, onset: int, known: Mask) -> tuple[NDArray[np.float64], Mask]:
        """Return the mean log likelihood of what each cell did in the contact events since frame
        ``onset``, given the ``known`` cells (bool ``[D]``), and whether it was loaded, ``[D]``
        each."""
        likely = np.zeros(self.layout.n_cells)
        loaded = np.zeros(self.layout.n_cells, bool)
        for i, events in self.local.kept():
            tile = self.local.tiles[i]
            suffixes = [s.features() for e in events.kept for s in e.suffixes() if s.first >= onset]
            if suffixes:
                features = np.stack(suffixes)
                expected = self.model_of(i, events)(features, known[tile.inputs])
                likely[tile.outputs] = expected.log_likelihood(features).mean(axis=0)[tile.place]
                loaded[tile.inputs] |= (features[:, 2] > 0).any(axis=0)
        return likely, loaded

    def record(self) -> Record:
        """Return the record of the log so far, which the model judges.

        Raises:
            ValueError: there is no model, or no frame was received.
        """
        if self._recorder is None:
            raise ValueError("the diagnosis has no model")
        return self._recorder.record(self.transport.seen)

    def evidence_of_life(self) -> EvidenceOfLog | None:
        """Return what the log says of how cells depend on each other; the reference must have a
        model of it."""
        assert self.reference.life is not None
        return EvidenceOfLog.of(self.life, self.reference.life, self.layout.beside)

    def proof_of_life(
        self,
        evidence: EvidenceOfLog | None,
        explained: Mask,
        constant: Mask,
        first: LifeTest | None = None,
    ) -> LifeTest:
        """Return the test whether cells depend on each other as healthy ones do.

        Args:
            evidence: what the log says.
            explained: bool ``[D]``, cells that are left out.
            constant: bool ``[D]``, cells that predict no others.
            first: an earlier test, whose result this one begins with.
        """
        eligible = self.received & ~self.silent & ~explained & (self.reference.dead == 0)
        return LifeTest(evidence, eligible, constant, first)

    def spatial(self, explained: Mask | None = None, misleading: Mask | None = None) -> Spatial:
        """Return the spatial test of all constant cells.

        Cells already ``explained`` (bool ``[D]``) are left out; those that are ``misleading``
        predict no others.
        """
        cells = self.cells(explained)
        cells = self._with_held_loads(cells) if self.tiled else cells
        return self._test(cells, self.local, passes=2, misleading=misleading)

    def each_excluded(
        self, spatial: Spatial, explained: Mask, groups: Sequence[Cells]
    ) -> Iterator[NDArray[np.float64]]:
        """Yield, for each group of cells, the summed surprisal ``[D]`` with these excluded from the
        predictors.

        Args:
            spatial: the result of the test with all cells that are not suspected as predictors.
            explained: bool ``[D]``, cells already explained.
            groups: cells that one fault would explain, int ``[k]`` each.
        """
        every = self.cells(explained)
        predictors = ~self.suspected(spatial)

        @cache  # no group changes it
        def prepared(i: int) -> ConditionalTest:
            events = self.local.of[i]
            return ConditionalTest.of(
                events.kept, every.of(self.local.tiles[i].inputs), self.model_of(i, events)
            )

        for group in groups:
            total = self.accumulated.copy()
            among = np.zeros(len(predictors), bool)
            among[group] = True
            for i, _ in self.local.kept():
                tile = self.local.tiles[i]
                if among[tile.outputs].any():
                    test = prepared(i)
                    _, surprisal = test.score(test.eligible & (predictors & ~among)[tile.inputs])
                    total[tile.outputs] = test.summed(surprisal)[tile.place]
            yield total

    def least_loads(self) -> tuple[NDArray[np.float64], Cells]:
        """Return the least root load of each cell since an event last left it unloaded, ``[D]``; 0:
        the last one did.

        With it the first frame of these events, 0 where these are all that are kept.
        """
        least = np.zeros(self.layout.n_cells)
        since = np.zeros(self.layout.n_cells, np.intp)
        for i, events in self.local.kept():
            tile = self.local.tiles[i]
            lowest = np.stack([event.lowest[tile.place] for event in events.kept])
            lasting = np.logical_and.accumulate((lowest > self.scale.root_near)[::-1])[::-1]
            first = np.array([event.first for event in events.kept])[lasting.argmax(axis=0)]
            least[tile.outputs] = np.where(
                lasting[-1], np.where(lasting, lowest, 1.0).min(axis=0), 0.0
            )
            since[tile.outputs] = np.where(lasting[-1] & ~lasting[0], first, 0)
        return least, since

    def never_unloaded(self, cells: Mask, predictors: Mask) -> NDArray[np.float64]:
        """Return -log P(a healthy cell stays loaded in all events since one last left it unloaded)
        ``[D]``.

        Given the readings of the ``predictors`` (bool ``[D]``) alone: cells on one object would
        support each other. Repeated events count for less.
        Tiles without one of the ``cells`` (bool ``[D]``) are left out.
        """
        surprisal = np.zeros(self.layout.n_cells)
        for i, events in self.local.kept():
            tile = self.local.tiles[i]
            if not cells[tile.outputs].any():
                continue
            whole = np.stack([event.whole.features() for event in events.kept])
            always = self.model_of(i, events)(whole, predictors[tile.inputs]).always
            likely = np.maximum(always, OUTLIERS)
            counts = novelty(count_repeats(events.kept, THE_SAME))[:, None]
            surprisal[tile.outputs] = offset_evidence(
                whole, likely, self.present[tile.inputs], counts
            )[tile.place]
        return surprisal

    def log_held(
        self, root: NDArray[np.float64], predictors: Mask, values: HeldValues
    ) -> NDArray[np.float64]:
        """Return log P(a healthy cell holds its value) ``[D]``, given the root loads ``[D]`` of the
        ``predictors``.

        0: cells without load; NaN: cells that no reference event loaded, so that the model knows no
        load of them.
        """
        features = np.stack([root, root, root > 0, root > 0]).astype(np.float32)
        likely = np.ones(len(root))
        loaded = root > 0
        for i, tile in enumerate(self.local.tiles):
            if loaded[tile.outputs].any():
                inputs = tile.inputs
                own = tile.place[loaded[tile.outputs]]
                e = self.model_of(i, self.local.of[i])(
                    features[None, :, inputs], predictors[inputs]
                )
                these = inputs[own]
                within = e.within(values.low[these], values.high[these], own)[0]
                likely[these] = np.where(np.isnan(e.spread[own]), np.nan, e.always[0, own] * within)
        return np.log(np.maximum(likely, np.finfo(float).tiny))

    def suspected(self, spatial: Spatial) -> Mask:
        """Return the cells that are no predictors after a test, bool ``[D]``."""
        return (
            spatial.scored & (spatial.evidence + self.temporal() >= self.exclusion.threshold)
        ) | spatial.drifting

    def cells(self, explained: Mask | None) -> CellState:
        """Return the state of the cells before the spatial test; ``explained`` cells (bool ``[D]``)
        are left out."""
        explained = (
            self.intermittency.intermittent
            | self.intermittency.excess
            | (explained is not None and explained)
        )
        eligible = self.received & ~self.silent & ~explained
        runs = self.runs
        if self.reference.model is None:
            # What no event can tell from a broken cell is not tested; what it reads says something
            # of the others.
            untestable = self._response.untestable(self.scale.near) & self.rests()
            runs = replace(runs, length=np.where(untestable, 0, runs.length))
        return CellState(
            runs, self.scale, self.reference.tolerance, self.accumulated, self.temporal(), eligible
        )

    def _test(
        self, cells: CellState, events: TiledEvents, passes: int, misleading: Mask | None = None
    ) -> Spatial:
        """Return the spatial test; of several tiles in one or two ``passes``, see the module."""
        if not self.tiled:
            (only,) = events.of
            model = self.model_of(0, only)
            return SpatialTest(only.kept, cells, model, self.exclusion, misleading).finish()
        if misleading is None:
            misleading = np.zeros(self.layout.n_cells, bool)
        result = _scored(self, cells, events, misleading, self.runs.moved)
        for _ in range(passes - 1):
            result = _scored(self, cells, events, misleading, ~self.suspected(result))
        return result

    def _with_held_loads(self, cells: CellState) -> CellState:
        """Return the cells with the evidence of loads that are held where nothing has moved for
        some events."""
        if self.reference.model is None:
            return cells  # held loads cannot be predicted from one log alone
        loaded = cells.scored & (self.scale.root_load(self.runs.value) > self.scale.root_near)
        accumulated = cells.accumulated.copy()
        for i in self.local.holding(loaded):
            tile = self.local.tiles[i]
            own = self.local.of[i].kept
            since = np.maximum(self.runs.start[tile.inputs], own[-1].end if own else 0)
            many = np.where(
                loaded[tile.inputs], len(self.begun) - np.searchsorted(self.begun, since), 0
            )
            if many[tile.place].any():
                evidence = held_load_evidence(
                    cells.of(tile.inputs), many, self.model_of(i, self.local.of[i])
                )
                accumulated[tile.outputs] += evidence[tile.place]
        return replace(cells, accumulated=accumulated)

    def _close(self) -> None:
        """Process a segment."""
        if self._filled > _FEW and any(len(events.kept) > MAX_EVENTS for events in self.local.of):
            self._drop()
        frames = self._buffer[: self._filled]
        numbers = self._numbers[: self._filled]
        begins = self._begins[: self._filled]
        self._filled = 0
        if self._recorder is not None:
            self._recorder = self._recorder.extend(frames, numbers, begins=begins)
        self._highest = np.fmax(self._highest, np.fmax.reduce(frames))
        self._offsets = self._offsets.extend(
            frames, self.reference.scale, self.present, self.reference.offset
        )
        self._noise = self._noise.extend(frames, self.present)
        plain = self._offsets.on(self.reference.scale)
        noise = 0.0 if self.reference.noise is None else self.reference.noise.raises(self._noise)
        noisy = plain.above(noise)
        self.scale = scale = noisy
        if self.reference.model is None:
            moved = self.runs.moved & self.received
            light = max(LIGHT * plain.full_scale, self._noise.range)
            self._rest = self._rest.extend(frames[:, moved], self.lowest[moved], light)
            self.scale = scale = self._rest.scale(plain, self.lowest, moved)
        start = self.runs.start
        known = _known(frames, self.runs.last)
        before = self.runs
        self.runs = self.runs.extend(frames, numbers, self.reference.tolerance, scale.baseline)
        runs = self.runs
        # Evidence belongs to a constant run, and ends with it.
        self.accumulated = np.where(runs.start == start, self.accumulated, 0.0)
        if self.reference.beside is not None:
            baseline = self.reference.scale.baseline
            most = self.reference.beside.most
            self._of_pad = self._of_pad.extend(
                frames, runs, int(numbers[0]), baseline, self.layout, most
            )
        steady = self._offsets.off(known)
        root = scale.root_load(steady)
        still = runs.start <= numbers[0]
        clear = noisy
        touched = root.any(axis=0)
        if self.reference.model is None:
            self._level = self._level.extend(before, runs.start != start)
            self._response = self._response.extend(
                steady, scale.full_scale * root.astype(np.float64) ** 2, self.layout
            )
            # How often healthy lines with light loads agree is unknown.
            clear = replace(plain, near=max(scale.near, _CLEAR * plain.near))
            # Where a cell rests that never moved is unknown: at its lowest reading at most.
            rise = np.fmax.reduce(steady) - self.lowest
            touched &= moved | (rise > max(scale.near, self._noise.range))
        self.touched = self.touched | touched
        if self.reference.life is not None:
            number = int(numbers[0]) // SEGMENT
            self.life = self.life.extend(root, known, number, self.reference.life.groups)
        jump = self.reference.jumps_seen.size(runs, self.reference.scale.full_scale)
        jumped = (jump >= SUDDEN_JUMP) & (runs.alone | still)
        self.local = self.local.extend(root, numbers, scale.root_near, runs.start, jumped)
        if self.tiled:
            skin = self._skin.extend(root, numbers, scale.root_near, runs.start, jumped)
            self._begun = [*self._begun[:-1], *(event.first for event in skin.kept)][-KEPT_EVENTS:]
            _, self._skin = skin.split(1)
            # On long lines some cell is always dead: cells that never moved are no difference
            # between two lines.
            frames = np.where(runs.moved, frames, np.nan)
        usual = self.reference.usual.with_noise(noise / plain.full_scale)
        self.intermittency = self.intermittency.extend(
            known, root, numbers, noisy, usual, still, begins=begins
        )
        # Lines that only have noise where they rest agree by chance.
        telling = informative(frames, still, clear) & self.touched
        self.duplicates = self.duplicates.extend(frames, numbers, telling, plain.near)

    def _drop(self) -> None:
        """Score old events, and drop them."""
        old, kept = self.local.split(MAX_EVENTS, KEPT_EVENTS)
        self.accumulated = self._test(self.cells(None), old, passes=1).surprisal
        self.local = kept


def _scored(
    stream: StreamState, cells: CellState, events: TiledEvents, misleading: Mask, outside: Mask
) -> Spatial:
    """Return the spatial test of each tile; ``outside`` (bool ``[D]``): its predictors beside its
    outputs."""
    result = Spatial(*(np.array(values) for values in vars(Spatial.before(cells)).values()))
    for i, own in events.kept():
        tile = events.tiles[i]
        of_tile = cells.of(tile.inputs)
        allowed = outside[tile.inputs]
        allowed[tile.place] = True
        of_tile = replace(of_tile, eligible=of_tile.eligible & allowed)
        model = stream.model_of(i, own)
        test = SpatialTest(own.kept, of_tile, model, stream.exclusion, misleading[tile.inputs])
        for name, values in vars(test.finish()).items():
            getattr(result, name)[tile.outputs] = values[tile.place]
    return result


def _on_rectangle(model: Model, own: Rectangle) -> Model:
    """Return the model of the inputs of a tile; ``model`` is that of their bounding rectangle."""

    def predict(features: Array, predictors: Mask) -> Prediction:
        e = model(own.on(features), own.on(predictors))
        return e if own.full else e.on(slice(None), own.cells)

    return predict


def _known(frames: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``frames`` with each missing reading replaced by the one before it; ``last`` holds
    those before all.

    A cell without any reading in these frames stays missing: an old reading is no load now.
    """
    missing = np.isnan(frames)
    return (
        np.where(missing.all(axis=0), np.nan, held(frames, last)[1:]) if missing.any() else frames
    )
