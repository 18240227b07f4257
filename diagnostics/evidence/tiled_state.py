"""The memory and the judgement of a large array: touches are kept, and cells judged, patch by patch (see ``tiles``).

A patch cannot tell which of the cells around it are broken: their own patches can. So all patches judge twice: at first
each asks, of the cells around it, only those that moved; then it leaves out those that their own patch suspects.

A cell that holds a load where nothing moves is put to the test by touches elsewhere on the skin: it outlasts them all.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import EventLog
from diagnostics.events.tiles import MOST_CELLS, Rectangle, TiledEvents, tiles
from diagnostics.evidence.conditional_test import CellState, Model
from diagnostics.evidence.spatial import (
    Exclusion,
    Spatial,
    group_excluded_evidence,
    held_load_evidence,
    spatial_evidence,
)
from diagnostics.evidence.stream_state import KEPT_EVENTS, MAX_EVENTS, StreamState, run_to_end
from diagnostics.healthy.model import HealthyModel, Prediction
from diagnostics.healthy.nearest_neighbours import NearestNeighbours
from diagnostics.healthy.reference import Reference
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.scale import Array

_SUSPICIOUS = 3.0  # log evidence from which on a cell is left out when others are judged, here and by its neighbours
_PAUSES = 8  # of each time that the patches are gone through: a monitor waits for all of them

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _Trusting:
    """A model that asks, of the cells around its patch, only some: bool ``[inputs]``."""

    model: Model
    scored: Mask

    def predict(self, features: Array, predictors: Mask) -> Generator[None, None, Prediction]:
        """See ``HealthyModel.predict``."""
        return self.model.predict(features, predictors & self.scored)


@dataclass(frozen=True)
class _Alone:
    """A model of a patch as an array of its own, asked about the inputs."""

    model: Model
    own: Rectangle

    def predict(self, features: Array, predictors: Mask) -> Generator[None, None, Prediction]:
        """See ``HealthyModel.predict``."""
        e = yield from self.model.predict(self.own.on(features), self.own.on(predictors))
        return e if self.own.full else e.on(slice(None), self.own.cells)


class TiledStreamState(StreamState):
    """A :class:`~diagnostics.evidence.stream_state.StreamState` of an array of several patches.

    Attributes:
        local: the touches of each patch.
        touches: those of the skin as a whole, bare.
    """

    def __init__(
        self, layout: SensorLayout, reference: Reference, exclusion: Exclusion, needed: Mask | None = None
    ) -> None:
        super().__init__(layout, reference, exclusion._replace(threshold=_SUSPICIOUS))
        local_regressions = reference.model.local_regressions if reference.model else None
        self.local = TiledEvents.begin(
            tiles(layout) if local_regressions is None else tuple(t.tile for t in local_regressions), needed
        )
        self._models: dict[int, Model] = {}  # of the patches that were touched, as the reference has them

    def spatial(self, wrong: Mask | None = None, events: EventLog | None = None) -> Generator[None, None, Spatial]:
        """See :meth:`StreamState.spatial`."""
        assert events is None, "touches belong to a patch here"
        # At first, of the cells around a patch, those that moved are asked.
        every = yield from self._outlasting(self.cells(wrong))
        first = yield from self._judged(self.local, every, self.runs.moved)
        return (yield from self._judged(self.local, every, ~self._suspected(first)))

    def group_excluded(
        self, spatial: Spatial, wrong: Mask, groups: Sequence[NDArray[np.intp]]
    ) -> Generator[None, None, NDArray[np.float64]]:
        """See :meth:`StreamState.group_excluded`."""
        every, predictors = self.cells(wrong), ~self._suspected(spatial)
        total = np.tile(self.accumulated, (len(groups), 1))
        among = np.stack([np.isin(np.arange(len(predictors)), group) for group in groups])
        for i, events in enumerate(self.local.of):
            tile = self.local.tiles[i]
            here, cells = np.flatnonzero(among[:, tile.outputs].any(axis=1)), tile.inputs
            if not events.kept or not len(here):
                continue
            own = [np.flatnonzero(mask) for mask in among[here][:, cells]]
            summed = run_to_end(
                group_excluded_evidence(
                    events.kept, every.of(cells), self.model_of(i, events), self.scale.of(cells),
                    self.reference.tolerance, predictors[cells], own,
                )
            )  # fmt: skip
            total[here[:, None], tile.outputs] = summed[:, tile.place]
            yield
        return total

    def views(self, onset: int) -> Iterator[tuple[Array, NDArray[np.intp], NDArray[np.intp], Model]]:
        """See :meth:`StreamState.views`."""
        for i, events in self.local.kept():
            tile = self.local.tiles[i]
            suffixes = [s.features() for t in events.kept for s in t.suffixes() if s.first >= onset]
            if suffixes:
                yield np.stack(suffixes), tile.inputs, tile.place, self.model_of(i, events)

    def model_of(self, i: int, events: EventLog) -> Model:
        """What healthy cells of patch i would do; without a reference, as far as its ``events`` tell."""
        known = self.reference.model
        if known is not None and i in self._models:
            return self._models[i]
        own = self.local.tiles[i].rectangle(self.layout)
        if known is None:
            log = NearestNeighbours.of(events.kept, own.layout).log
            return _Alone(NearestNeighbours(own.on(log), own.layout), own)
        model = HealthyModel((known.local_regressions[i].at(own.cells),), own.layout, known.stacking)
        return self._models.setdefault(i, _Alone(model, own))

    def _outlasting(self, every: CellState) -> Generator[None, None, CellState]:
        """Return the cells, with what is known of those that hold a load where nothing has moved for some touches."""
        if self.reference.model is None:
            return every  # a log tells little of the healthy where nothing moved
        scored = every.scored & (self.scale.root_load(self.runs.value) > self.scale.root_near)
        begun = np.array([event.first for event in self.events.kept])
        holding, outlasted, accumulated = [], np.zeros(len(scored), bool), every.accumulated.copy()
        for i in self.local.holding(scored):
            tile, own = self.local.tiles[i], self.local.of[i].kept
            since = np.maximum(self.runs.start[tile.inputs], own[-1].end if own else 0)
            many = np.where(scored[tile.inputs], len(begun) - np.searchsorted(begun, since), 0)
            outlasted[tile.outputs] = many[tile.place] > 0
            if outlasted[tile.outputs].any():
                holding.append((i, many))
        for k, (i, many) in enumerate(holding):
            tile = self.local.tiles[i]
            cells, scale = every.of(tile.inputs), self.scale.of(tile.inputs)
            model = self.model_of(i, self.local.of[i])
            evidence = run_to_end(held_load_evidence(cells, many, model, scale, self.reference.tolerance))
            accumulated[tile.outputs] += evidence[tile.place]
            if _pause_after(k, len(holding)):
                yield
        return replace(every, accumulated=accumulated, outlasted=outlasted)

    def _judged(self, local: TiledEvents, every: CellState, neighbourhood: Mask) -> Generator[None, None, Spatial]:
        """Judge all patches, each asking those of the cells ``neighbourhood`` it (bool ``[D]``)."""
        total = Spatial(*(np.array(values) for values in vars(Spatial.before(every)).values()))
        judged = [
            (i, events) for i, events in enumerate(local.of)
            if events.kept or every.outlasted[local.tiles[i].outputs].any()
        ]  # fmt: skip
        for k, (i, events) in enumerate(judged):
            tile = local.tiles[i]
            cells = tile.inputs
            scored = neighbourhood[cells]
            scored[tile.place] = True
            model = _Trusting(self.model_of(i, events), scored)
            scale, tolerance = self.scale.of(cells), self.reference.tolerance
            of_tile = run_to_end(
                spatial_evidence(events.kept, every.of(cells), model, scale, tolerance, self.exclusion)
            )
            for name, values in vars(of_tile).items():
                getattr(total, name)[tile.outputs] = values[tile.place]
            if _pause_after(k, len(judged)):
                yield
        return total

    @property
    def _crowded(self) -> bool:
        return any(len(events.kept) > MAX_EVENTS for events in self.local.of)

    def _remember(self, root: Array, numbers: NDArray[np.intp], jumped: Mask) -> None:
        start = self.runs.start
        self.local = self.local.extend(root, numbers, self.scale.root_near, start, jumped)
        skin = self.events.extend(root, numbers, self.scale.root_near, start, jumped)
        self.events = skin.split(KEPT_EVENTS)[1].without_loads()  # more would say no more

    def _comparable(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        # On a line of a hundred cells one is always dead: what never moved does not tell two lines apart.
        return np.where(self.runs.moved, frames, np.nan)

    def _let_go(self) -> Generator[None, None, None]:
        old, kept = [], []
        for events in self.local.of:
            crowded = len(events.kept) > MAX_EVENTS
            gone, left = events.split(KEPT_EVENTS) if crowded else (EventLog(), events)
            old.append(gone)
            kept.append(left)
        accumulated = (yield from self._judged(self.local.replaced(old), self.cells(None), self.runs.moved)).surprisal
        self.local, self.accumulated = self.local.replaced(kept), accumulated


def _pause_after(k: int, n: int) -> bool:
    return k * _PAUSES // n != (k + 1) * _PAUSES // n


def new_stream(
    layout: SensorLayout, reference: Reference, exclusion: Exclusion, needed: Mask | None = None
) -> StreamState:
    """Return an empty memory of the kind that an array needs: large ones are remembered patch by patch.

    ``exclusion`` says what evidence is worth; when a cell of a large array is suspicious, this module says. The touches
    of a patch without a cell that is ``needed`` (bool ``[D]``; None: all) are not remembered.
    """
    if layout.present.sum() > MOST_CELLS:
        return TiledStreamState(layout, reference, exclusion, needed)
    return StreamState(layout, reference, exclusion)
