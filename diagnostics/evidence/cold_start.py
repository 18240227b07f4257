"""A cold start: what a log without a reference keeps, and what it says of each cell.

The state keeps the last contact events of every tile (see ``events.tiles``; an array of up to 400
cells is one tile). Older events are scored, and only their summed evidence is kept.

A tile cannot tell which cells of its halo are faulty, but their own tiles can. So several tiles are
scored twice: first with the moving cells as predictors, then without the cells that their own tile
suspects.

Detects cells that hold a value while those around them are loaded, that no longer return to their
rest, that blink or are far noisier than healthy cells usually are, and that deliver nothing. Not
detected: what moves by itself, gains, wires of which no cell is tested.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.calibration import calibrated, faulty_at, probability_of
from diagnostics.decision.cell_findings import CellFindings
from diagnostics.decision.judged import Judged
from diagnostics.events.contact_events import EventLog
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import Rectangle, tiles
from diagnostics.evidence.conditional_test import CellState, Model
from diagnostics.evidence.nearest_neighbours import NearestNeighbours
from diagnostics.evidence.rest_level import RestLevel
from diagnostics.evidence.spatial import Spatial, SpatialTest
from diagnostics.evidence.stream_state import StreamState
from diagnostics.evidence.weak_response import WeakResponse
from diagnostics.preprocessing.levels import (
    CERTAIN_RATIO,
    DOUBTED,
    LIGHT,
    RARE,
    SUSPICIOUS,
)
from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.preprocessing.rest_of_log import RestOfLog

if TYPE_CHECKING:
    from diagnostics.evidence.prediction import Prediction
    from diagnostics.evidence.reference import Reference
    from diagnostics.faults import Fault
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.load import LoadDirection
    from diagnostics.preprocessing.scale import Array, Scale

# with more events in a tile, all but the last are scored and dropped
MAX_EVENTS = 40
KEPT_EVENTS = 32
_PASSES = 2  # of several tiles
# a shorter segment, as the last one of a log, leaves old events for the next one
_FEW = SEGMENT // 2
_CLEAR = 4.0  # times the tolerance of two equal lines: lighter loads are equal by chance

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]


@dataclass(frozen=True)
class ColdStart:
    """What a log without a reference keeps, after some frames.

    Attributes:
        layout: the array.
        events: the last contact events of each tile.
        accumulated: float ``[D]``, evidence from dropped events, for the constant runs that still
            last.
        rest: where cells rest.
        level: what they read before, where they rested.
        response: how they follow those around them.
    """

    layout: SensorLayout
    events: TiledEvents
    accumulated: Floats
    rest: RestOfLog
    level: RestLevel
    response: WeakResponse

    @classmethod
    def begin(cls, layout: SensorLayout, needed: Mask | None = None) -> ColdStart:
        """Return the state before any frame. Tiles without a ``needed`` cell (bool ``[D]``) are
        skipped."""
        n = layout.n_cells
        return cls(
            layout,
            TiledEvents.begin(tiles(layout), needed),
            np.zeros(n),
            RestOfLog(),
            RestLevel.begin(n),
            WeakResponse.begin(n),
        )

    @property
    def tiled(self) -> bool:
        """Whether there are several tiles."""
        return len(self.events.tiles) > 1

    @property
    def is_full(self) -> bool:
        """Whether a tile has more events than are kept."""
        return any(len(events.kept) > MAX_EVENTS for events in self.events.of)

    def dropped(self, stream: StreamState) -> ColdStart:
        """Return the state in which old events are scored, and dropped."""
        old, kept = self.events.split(MAX_EVENTS, KEPT_EVENTS)
        surprisal = self._test(stream, self._cells(stream, None), old, passes=1).surprisal
        return replace(self, events=kept, accumulated=surprisal)

    def rested(self, stream: StreamState, frames: Floats, plain: Scale, noise: float) -> ColdStart:
        """Return the state after frames ``[t, D]`` of one more segment have told where cells
        rest.

        Args:
            stream: before these.
            frames: NaN = missing.
            plain: the scale without knowledge of the log.
            noise: from the lowest to the highest of many readings at rest.
        """
        moved = stream.runs.moved & stream.received
        light = max(LIGHT * plain.full_scale, noise)
        return replace(self, rest=self.rest.extend(frames[:, moved], stream.lowest[moved], light))

    def scale(self, stream: StreamState, plain: Scale) -> Scale:
        """Return the scale of the log."""
        return self.rest.scale(plain, stream.lowest, stream.runs.moved & stream.received)

    def extend(
        self, stream: StreamState, ended: Mask, steady: Floats, root: Array, numbers: Cells
    ) -> ColdStart:
        """Return the state after the frames of one more segment.

        Args:
            stream: with the runs at its end.
            ended: bool ``[D]``, cells whose run ended in it; ``stream.before`` holds these runs.
            steady, root: readings and root loads ``[t, D]``, without changes of the offset.
            numbers: int ``[t]``, of the frames.
        """
        scale = stream.scale
        # Evidence belongs to a constant run, and ends with it.
        accumulated = np.where(ended, 0.0, self.accumulated)
        loads = scale.full_scale * root.astype(np.float64) ** 2
        return replace(
            self,
            accumulated=accumulated,
            level=self.level.extend(stream.before, ended),
            response=self.response.extend(steady, loads, self.layout),
            events=self.events.extend(root, numbers, scale.root_near, stream.runs.start),
        )

    def log_likelihood(self, stream: StreamState, onset: int, known: Mask) -> tuple[Floats, Mask]:
        """Return the mean log likelihood of what each cell did in the contact events since frame
        ``onset``, given the ``known`` cells (bool ``[D]``), and whether it was loaded, ``[D]``
        each."""
        likely = np.zeros(self.layout.n_cells)
        loaded = np.zeros(self.layout.n_cells, bool)
        for i, events in self.events.kept():
            tile = self.events.tiles[i]
            suffixes = [s.features() for e in events.kept for s in e.suffixes() if s.first >= onset]
            if suffixes:
                features = np.stack(suffixes)
                expected = self._model_of(i, events, stream.scale)(features, known[tile.inputs])
                likely[tile.outputs] = expected.log_likelihood(features).mean(axis=0)[tile.place]
                loaded[tile.inputs] |= (features[:, 2] > 0).any(axis=0)
        return likely, loaded

    def spatial(self, stream: StreamState, explained: Mask | None = None) -> Spatial:
        """Return the spatial test of all constant cells; those already ``explained`` (bool ``[D]``)
        are left out."""
        return self._test(stream, self._cells(stream, explained), self.events, _PASSES)

    def temporal(self, stream: StreamState) -> Floats:
        """Return the log likelihood ratio of the level of each constant run, ``[D]``."""
        return self.level.evidence(
            stream.runs, stream.rests(), stream.reference.tolerance, self.layout
        )

    def _suspected(self, stream: StreamState, spatial: Spatial) -> Mask:
        """Return the cells that are no predictors after a test, bool ``[D]``."""
        evidence = spatial.evidence + self.temporal(stream)
        return spatial.scored & (evidence >= SUSPICIOUS) | spatial.drifting

    def _cells(self, stream: StreamState, explained: Mask | None) -> CellState:
        """Return the state of the cells before the spatial test; ``explained`` cells (bool ``[D]``)
        are left out."""
        out = stream.intermittency.intermittent | stream.intermittency.excess
        if explained is not None:
            out |= explained
        eligible = stream.received & ~stream.silent & ~out
        # What no event can tell from a broken cell is not tested; what it reads says something of
        # the others.
        untestable = self.response.untestable(stream.scale.near) & stream.rests()
        runs = replace(stream.runs, length=np.where(untestable, 0, stream.runs.length))
        return CellState(
            runs,
            stream.scale,
            stream.reference.tolerance,
            self.accumulated,
            self.temporal(stream),
            eligible,
        )

    def _test(
        self, stream: StreamState, cells: CellState, events: TiledEvents, passes: int
    ) -> Spatial:
        """Return the spatial test; of several tiles in one or two ``passes``, see the module."""
        if not self.tiled:
            (only,) = events.of
            return SpatialTest(only.kept, cells, self._model_of(0, only, stream.scale)).finish()
        result = self._scored(cells, events, stream.runs.moved)
        for _ in range(passes - 1):
            result = self._scored(cells, events, ~self._suspected(stream, result))
        return result

    def _scored(self, cells: CellState, events: TiledEvents, outside: Mask) -> Spatial:
        """Return the spatial test of each tile; ``outside`` (bool ``[D]``): its predictors beside
        its outputs."""
        result = Spatial(*[np.array(values) for values in vars(Spatial.before(cells)).values()])
        for i, own in events.kept():
            tile = events.tiles[i]
            of_tile = cells.of(tile.inputs)
            allowed = outside[tile.inputs]
            allowed[tile.place] = True
            of_tile = replace(of_tile, eligible=of_tile.eligible & allowed)
            model = self._model_of(i, own, cells.scale)
            for name, values in vars(SpatialTest(own.kept, of_tile, model).finish()).items():
                getattr(result, name)[tile.outputs] = values[tile.place]
        return result

    def _model_of(self, i: int, events: EventLog, scale: Scale) -> Model:
        """Return the model of tile i, which its ``events`` are."""
        if not self.tiled:
            return NearestNeighbours.of(events.kept, self.layout, scale.root_near).predict
        own = self.events.tiles[i].rectangle(self.layout)
        model = NearestNeighbours.of(events.kept, own.layout, scale.root_near)
        return _on_rectangle(replace(model, log=own.on(model.log)).predict, own)


class ColdStream(StreamState):
    """The state of a log without a model after some frames.

    Args:
        layout: the array.
        reference: what is known of it.
        needed: bool ``[D]``, the cells to be scored; None: all.
        load, order: as of :class:`StreamState`.

    Attributes:
        cold: what such a log keeps.
    """

    def __init__(
        self,
        layout: SensorLayout,
        reference: Reference,
        needed: Mask | None = None,
        load: LoadDirection | None = None,
        order: Cells | None = None,
    ) -> None:
        super().__init__(layout, reference, None, load, order)
        self.cold = ColdStart.begin(layout, needed)

    def _close(self) -> None:
        if self._filled > _FEW and self.cold.is_full:
            self.cold = self.cold.dropped(self)
        super()._close()

    def _scale_after(self, frames: Floats, plain: Scale, noisy: Scale) -> Scale:
        self.cold = self.cold.rested(self, frames, plain, self._noise.range)
        return self.cold.scale(self, plain)

    def _touched_in(self, steady: Floats, root: Array, numbers: Cells, moved: Mask) -> Mask:
        ended = self.runs.start != self.before.start
        self.cold = self.cold.extend(self, ended, steady, root, numbers)
        # Where a cell rests that never moved is unknown: at its lowest reading at most.
        rise = np.fmax.reduce(steady) - self.lowest
        surely: Mask = moved | (rise > max(self.scale.near, self._noise.range))
        return np.asarray(super()._touched_in(steady, root, numbers, moved) & surely)

    def _clear(self, plain: Scale, noisy: Scale) -> Scale:
        # How often healthy lines with light loads agree is unknown.
        return replace(plain, near=max(self.scale.near, _CLEAR * plain.near))


def _on_rectangle(model: Model, own: Rectangle) -> Model:
    """Return the model of the inputs of a tile; ``model`` is that of their bounding rectangle."""

    def predict(features: Array, predictors: Mask) -> Prediction:
        e = model(own.on(features), own.on(predictors))
        return e if own.full else e.on(slice(None), own.cells)

    return predict


def judged_cold(
    stream: ColdStream,
    aliases: tuple[list[Fault], Mask],
    rate: float,
    full_scale: float,
) -> Judged:
    """Return what a log without a reference says of each cell.

    Args:
        stream: the log.
        aliases: causes of lines that read the same, and the cells that these explain, bool ``[D]``.
        rate: expected share of healthy cells among those that are faulty.
        full_scale: of the layout.
    """
    cold = stream.cold
    causes, explained = aliases
    spatial = cold.spatial(stream, explained)
    temporal = cold.temporal(stream)
    intermittency = stream.intermittency
    found = _findings(stream, spatial, temporal, explained, rate, full_scale)
    evidence = {
        "spatial": spatial.evidence + spatial.offset,
        "temporal": np.where(
            spatial.scored, temporal, intermittency.blinking + intermittency.noisy
        ),
        "events": spatial.events.astype(np.float64),
    }
    shown = stream.touched & cold.response.follows
    return Judged(found=found, aliases=causes, shown=shown, evidence=evidence)


def _findings(
    stream: StreamState,
    spatial: Spatial,
    temporal: Floats,
    explained: Mask,
    rate: float,
    full_scale: float,
) -> CellFindings:
    """Return the findings about each cell; arguments as of :func:`judged_cold`."""
    runs = stream.runs
    frames = stream.intermittency
    rests = stream.rests()
    tested = spatial.surprisal > 0
    odds = calibrated(spatial.evidence, temporal, runs.moved, rests, tested=tested)
    weight = calibrated(spatial.surprisal, temporal, runs.moved, rests, tested=tested)
    dead = stream.reference.dead
    known = spatial.scored & ~runs.moved & (dead > 0)
    stuck = probability_of(odds, runs.moved, spatial.scored & ~known)
    stuck[known] = dead[known]
    silent = stream.silent & ~explained
    free = stream.present & ~explained
    delivers = free & ~silent
    intermittent = frames.intermittent & delivers
    noisy = frames.excess & delivers
    drifting = delivers & ~intermittent & ~noisy & spatial.drifting & (stream.crosstalk is None)
    certain = silent | intermittent | noisy | drifting
    probability = np.where(stream.present, np.where(certain, 1 - RARE, stuck), 0.0)
    faulty = (faulty_at(np.where(certain, 0.0, probability), rate) | certain) & free
    beyond = spatial.scored & ~rests
    held = stream.reading(runs.value)
    tolerance = 2 * stream.reference.tolerance
    unsaid: dict[str, Any] = dict.fromkeys(("refuted", "unsure", "wire"), np.full(len(held), -1))
    unsaid |= dict.fromkeys(("of_wire", "share"), np.zeros(len(held)))
    return CellFindings(
        faulty=faulty,
        # A cell that moved is alive, unless it is suspected since.
        alive=free & ~faulty & runs.moved & (probability < DOUBTED),
        silent=silent,
        rests=spatial.scored & rests,
        full=beyond & (held >= full_scale - tolerance),
        zero=None if stream.load is None else beyond & (held <= tolerance),
        intermittent=intermittent,
        noisy=noisy,
        drifting=drifting,
        value=np.where(intermittent, stream.blinks_to(full_scale), held),
        since=np.select(
            [silent, intermittent, noisy, drifting],
            [runs.missed_since, frames.blinks_since, frames.noisy_since, 0],
            runs.start,
        ),
        probability=probability,
        # A cell at rest supports a broken line by the events alone, without the prior of its value.
        weight=np.where(known, CERTAIN_RATIO, weight),
        events=np.where(intermittent, frames.blinks, spatial.events),
        known=known,
        gain=np.full(len(held), np.nan),
        **unsaid,
        as_one=np.zeros(len(held), bool),
        typical=stream.typical_reading(),
    )
