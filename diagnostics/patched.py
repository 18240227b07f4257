"""The memory and the judgement of a large array: touches are kept, and cells judged, patch by patch (see ``patches``).

A patch cannot tell which of the cells around it are broken: their own patches can. So all patches judge twice: at first
each asks, of the cells around it, only those that moved; then it leaves out those that their own patch suspects.

A cell that holds a load where nothing moves is put to the test by touches elsewhere on the skin: it outlasts them all.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.contact import ContactModel, Expected
from diagnostics.layout import SensorLayout
from diagnostics.memory import KEPT_TOUCHES, MOST_TOUCHES, Memory, finished
from diagnostics.patches import MOST_CELLS, PatchTouches, Rectangle, patches
from diagnostics.question import Cells, Model
from diagnostics.reference import Reference
from diagnostics.scale import Array
from diagnostics.spatial import Caution, Spatial, apart_evidence, lone_evidence, stuck_evidence
from diagnostics.surroundings import Surroundings
from diagnostics.touches import Touches

_SUSPICIOUS = 3.0  # log evidence from which on a cell is left out when others are judged, here and by its neighbours
_PAUSES = 8  # of each time that the patches are gone through: a monitor waits for all of them

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _Trusting:
    """A model that asks, of the cells around its patch, only some: bool ``[inputs]``."""

    model: Model
    asked: Mask

    def expect(self, features: Array, trusted: Mask) -> Generator[None, None, Expected]:
        """See ``ContactModel.expect``."""
        return self.model.expect(features, trusted & self.asked)


@dataclass(frozen=True)
class _Alone:
    """A model of a patch as an array of its own, asked about the inputs."""

    model: Model
    own: Rectangle

    def expect(self, features: Array, trusted: Mask) -> Generator[None, None, Expected]:
        """See ``ContactModel.expect``."""
        e = yield from self.model.expect(self.own.on(features), self.own.on(trusted))
        return e if self.own.full else e.on(slice(None), self.own.cells)


class PatchedMemory(Memory):
    """A :class:`~diagnostics.memory.Memory` of an array of several patches.

    Attributes:
        local: the touches of each patch.
        touches: those of the skin as a whole, bare.
    """

    def __init__(
        self, layout: SensorLayout, reference: Reference, caution: Caution, needed: Mask | None = None
    ) -> None:
        super().__init__(layout, reference, caution._replace(suspicious=_SUSPICIOUS))
        tiles = reference.model.tiles if reference.model else None
        self.local = PatchTouches.begin(patches(layout) if tiles is None else tuple(t.patch for t in tiles), needed)
        self._models: dict[int, Model] = {}  # of the patches that were touched, as the reference has them

    def spatial(self, wrong: Mask | None = None, touches: Touches | None = None) -> Generator[None, None, Spatial]:
        """See :meth:`Memory.spatial`."""
        assert touches is None, "touches belong to a patch here"
        # At first, of the cells around a patch, those that moved are asked.
        every = yield from self._outlasting(self.cells(wrong))
        first = yield from self._judged(self.local, every, self.runs.moved)
        return (yield from self._judged(self.local, every, ~self._suspected(first)))

    def apart(
        self, spatial: Spatial, wrong: Mask, groups: Sequence[NDArray[np.intp]]
    ) -> Generator[None, None, NDArray[np.float64]]:
        """See :meth:`Memory.apart`."""
        every, trusted = self.cells(wrong), ~self._suspected(spatial)
        total = np.tile(self.settled, (len(groups), 1))
        among = np.stack([np.isin(np.arange(len(trusted)), group) for group in groups])
        for i, touches in enumerate(self.local.of):
            patch = self.local.patches[i]
            here, cells = np.flatnonzero(among[:, patch.outputs].any(axis=1)), patch.inputs
            if not touches.kept or not len(here):
                continue
            own = [np.flatnonzero(mask) for mask in among[here][:, cells]]
            brought = finished(
                apart_evidence(
                    touches.kept, every.of(cells), self.model_of(i, touches), self.scale.of(cells),
                    self.reference.tolerance, trusted[cells], own,
                )
            )  # fmt: skip
            total[here[:, None], patch.outputs] = brought[:, patch.place]
            yield
        return total

    def views(self, onset: int) -> Iterator[tuple[Array, NDArray[np.intp], NDArray[np.intp], Model]]:
        """See :meth:`Memory.views`."""
        for i, touches in self.local.kept():
            patch = self.local.patches[i]
            suffixes = [s.features() for t in touches.kept for s in t.suffixes() if s.first >= onset]
            if suffixes:
                yield np.stack(suffixes), patch.inputs, patch.place, self.model_of(i, touches)

    def model_of(self, i: int, touches: Touches) -> Model:
        """What healthy cells of patch i would do; without a reference, as far as its ``touches`` tell."""
        known = self.reference.model
        if known is not None and i in self._models:
            return self._models[i]
        own = self.local.patches[i].rectangle(self.layout)
        if known is None:
            log = Surroundings.of(touches.kept, own.layout).log
            return _Alone(Surroundings(own.on(log), own.layout), own)
        model = ContactModel((known.tiles[i].at(own.cells),), own.layout, known.rim)
        return self._models.setdefault(i, _Alone(model, own))

    def _outlasting(self, every: Cells) -> Generator[None, None, Cells]:
        """Return the cells, with what is known of those that hold a load where nothing has moved for some touches."""
        if self.reference.model is None:
            return every  # a log tells little of the healthy where nothing moved
        asked = every.asked & (self.scale.root_load(self.runs.value) > self.scale.root_near)
        begun = np.array([touch.first for touch in self.touches.kept])
        holding, outlasted, settled = [], np.zeros(len(asked), bool), every.settled.copy()
        for i in self.local.holding(asked):
            patch, own = self.local.patches[i], self.local.of[i].kept
            since = np.maximum(self.runs.start[patch.inputs], own[-1].end if own else 0)
            many = np.where(asked[patch.inputs], len(begun) - np.searchsorted(begun, since), 0)
            outlasted[patch.outputs] = many[patch.place] > 0
            if outlasted[patch.outputs].any():
                holding.append((i, many))
        for k, (i, many) in enumerate(holding):
            patch = self.local.patches[i]
            cells, scale = every.of(patch.inputs), self.scale.of(patch.inputs)
            model = self.model_of(i, self.local.of[i])
            evidence = finished(lone_evidence(cells, many, model, scale, self.reference.tolerance))
            settled[patch.outputs] += evidence[patch.place]
            if _pause_after(k, len(holding)):
                yield
        return replace(every, settled=settled, outlasted=outlasted)

    def _judged(self, local: PatchTouches, every: Cells, around: Mask) -> Generator[None, None, Spatial]:
        """Judge all patches, each asking those of the cells ``around`` it (bool ``[D]``)."""
        total = Spatial(*(np.array(values) for values in vars(Spatial.before(every)).values()))
        judged = [
            (i, touches) for i, touches in enumerate(local.of)
            if touches.kept or every.outlasted[local.patches[i].outputs].any()
        ]  # fmt: skip
        for k, (i, touches) in enumerate(judged):
            patch = local.patches[i]
            cells = patch.inputs
            asked = around[cells]
            asked[patch.place] = True
            model = _Trusting(self.model_of(i, touches), asked)
            scale, tolerance = self.scale.of(cells), self.reference.tolerance
            of_patch = finished(stuck_evidence(touches.kept, every.of(cells), model, scale, tolerance, self.caution))
            for name, values in vars(of_patch).items():
                getattr(total, name)[patch.outputs] = values[patch.place]
            if _pause_after(k, len(judged)):
                yield
        return total

    @property
    def _crowded(self) -> bool:
        return any(len(touches.kept) > MOST_TOUCHES for touches in self.local.of)

    def _remember(self, root: Array, numbers: NDArray[np.intp], jumped: Mask) -> None:
        start = self.runs.start
        self.local = self.local.extend(root, numbers, self.scale.root_near, start, jumped)
        skin = self.touches.extend(root, numbers, self.scale.root_near, start, jumped)
        self.touches = skin.split(KEPT_TOUCHES)[1].bare()  # more would say no more

    def _comparable(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        # On a line of a hundred cells one is always dead: what never moved does not tell two lines apart.
        return np.where(self.runs.moved, frames, np.nan)

    def _let_go(self) -> Generator[None, None, None]:
        old, kept = [], []
        for touches in self.local.of:
            crowded = len(touches.kept) > MOST_TOUCHES
            gone, left = touches.split(KEPT_TOUCHES) if crowded else (Touches(), touches)
            old.append(gone)
            kept.append(left)
        settled = (yield from self._judged(self.local.replaced(old), self.cells(None), self.runs.moved)).surprise
        self.local, self.settled = self.local.replaced(kept), settled


def _pause_after(k: int, n: int) -> bool:
    return k * _PAUSES // n != (k + 1) * _PAUSES // n


def remembering(layout: SensorLayout, reference: Reference, caution: Caution, needed: Mask | None = None) -> Memory:
    """Return an empty memory of the kind that an array needs: large ones are remembered patch by patch.

    ``caution`` says what evidence is worth; when a cell of a large array is suspicious, this module says. The touches
    of a patch without a cell that is ``needed`` (bool ``[D]``; None: all) are not remembered.
    """
    if layout.present.sum() > MOST_CELLS:
        return PatchedMemory(layout, reference, caution, needed)
    return Memory(layout, reference, caution)
