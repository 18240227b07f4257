"""The fitted model of the proof of life: of cells, of wires, and of groups."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.life.healthy_table import (
    AMID,
    BEFORE,
    BESIDE,
    FAULTS,
    FEWEST_CELLS,
    FULL,
    GUESS,
    STATES,
    UNLOADED,
    Cells,
    ConditionalMean,
    Floats,
    HealthyTable,
    Levels,
    Mask,
    levels_of,
    loaded_beside,
)
from diagnostics.preprocessing.levels import LEAST_LOADED, LOW, MAJORITY
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.wiring import LineKind

_NOISIER = 2  # single frames than their mean in a piece


def cells_on_lines(layout: SensorLayout, kinds: Collection[LineKind]) -> Mask:
    """Return the cells on each line of some kinds that others can tell of, bool ``[L, D]``: three
    of them at least, and not all; lines with the same cells once."""
    present = layout.present.ravel()
    found: dict[bytes, Mask] = {}
    for line in layout.lines:
        cells = layout.cells_on(line)
        if line.kind in kinds and FEWEST_CELLS <= len(cells) < present.sum():
            on = np.zeros(layout.n_cells, bool)
            on[cells] = True
            found.setdefault(on.tobytes(), on)
    every = np.array(list(found.values()))
    return every.reshape(-1, layout.n_cells).astype(np.bool_)


@dataclass(frozen=True)
class WireModel(HealthyTable):
    """Mean loads of healthy wires, given the cells that are not on them.

    Attributes:
        on: bool ``[W, D]``, cells on each wire.
        beside: bool ``[W, D]``, cells beside these that are not.
    """

    on: Mask
    beside: Mask

    @property
    def per_level(self) -> int:
        """Number of contexts of each predicted level."""
        return (len(BESIDE) + 1) * BEFORE

    def told(self, loads: Array, known: Mask) -> Mask:
        """Return in which pieces some known cell off each wire is loaded, bool ``[n, W]``.

        The others tell nothing of a wire where none of them is loaded: the pieces that are kept of
        a log hold some load, which is then its own, or that of a faulty cell.
        """
        others = (~self.on & known).astype(np.float32)
        found: Mask = (loads > UNLOADED).astype(np.float32) @ others.T > 0
        return found

    def contexts(
        self, expected: Floats, means: Floats, loads: Array, piece: Cells, known: Mask
    ) -> NDArray[np.intp]:
        """Return what the others say of each wire, 0 to M - 1, int ``[n, W]``.

        Where no cell lies beside it, so does the piece before: what nothing touched then is likely
        to be untouched.

        Args:
            expected: mean loads that they predict, ``[n, W]``.
            means: mean loads of the wires, ``[n, W]``.
            loads: root loads ``[n, D]``.
            piece: number of each, int ``[n]``.
            known: bool ``[D]``, cells that predict others.
        """
        near = (self.beside & known).astype(np.float32)
        loaded = (loads > UNLOADED).astype(np.float32) @ near.T
        share = loaded / np.maximum(near.sum(axis=1), 1)
        level = levels_of(expected, self.predicted).astype(np.intp)
        around = level * (len(BESIDE) + 1) + levels_of(share, np.asarray(BESIDE))
        before = np.zeros(around.shape, np.intp)
        follows = (np.diff(piece) == 1)[:, None] & ~self.beside.any(axis=1)
        before[1:] = np.where(follows, 1 + (means[:-1] > UNLOADED), 0)
        return around * BEFORE + before

    def means(self, values: Array, eligible: Mask) -> Floats:
        """Return the means ``[n, W]`` over the eligible cells (bool ``[D]``) of each wire, of
        values ``[n, D]``."""
        of = (self.on & eligible).astype(np.float64)
        found: Floats = values @ (of / np.maximum(of.sum(axis=1, keepdims=True), 1)).T
        return found

    def expected(
        self, means: Sequence[ConditionalMean], loads: Array, known: Mask, eligible: Mask
    ) -> Floats:
        """Return the mean load that the known cells off each wire predict, ``[n, W]``.

        Args:
            means: predictions of the cells.
            loads: root loads ``[n, D]``.
            known: bool ``[D]``, cells that predict others.
            eligible: bool ``[D]``, cells over which the mean is taken.
        """
        found = np.zeros((len(loads), len(self.on)))
        for w, on in enumerate(self.on):
            of = on & eligible
            for mean in means:
                if of[mean.outputs].any():
                    found[:, w] += mean.expected_sum(loads, known, on, of)
            found[:, w] /= max(1, of.sum())
        return found


@dataclass(frozen=True)
class GroupModel(HealthyTable):
    """P(state | state a piece ago) of healthy groups.

    Attributes:
        on: bool ``[G, D]``, cells of each group.
        tolerance: readings within +- this of a value are that value, in the layout's unit.
        noise: whether readings that do not change are rare in the reference.
    """

    on: Mask
    tolerance: float
    noise: bool

    @property
    def n_levels(self) -> int:
        """Number of states."""
        return STATES

    def as_one(self, root: Array, frames: NDArray[np.floating]) -> Mask:
        """Return in which of successive frames each group reads as one, bool ``[t, G]``.

        All its cells read one value, and some are loaded, or are exactly equal though they have
        noise; or none changes, from the frame before or to the next one.

        Args:
            root: root loads ``[t, D]``.
            frames: readings ``[t, D]``.
        """
        found = np.zeros((len(frames), len(self.on)), bool)
        for g, on in enumerate(self.on):
            own = frames[:, on]
            spread = np.ptp(own, axis=1)
            one = spread <= _NOISIER * 2 * self.tolerance
            found[:, g] = one & (root[:, on].astype(bool).mean(axis=1) > MAJORITY)
            if self.noise:
                same = np.all(own[1:] == own[:-1], axis=1)
                found[:, g] |= spread == 0
                found[1:, g] |= same
                found[:-1, g] |= same
        return found

    def states(
        self,
        loads: NDArray[np.floating],
        readings: NDArray[np.floating],
        constant: Mask,
        eligible: Mask,
    ) -> Levels:
        """Return the state of each group in each piece, ``[n, G]``.

        Args:
            loads: mean root loads ``[n, D]``.
            readings: mean readings ``[n, D]``, in the layout's unit.
            constant: bool ``[n, D]``, where the reading did not change.
            eligible: bool ``[D]``, cells that tell of their group.
        """
        state = np.zeros((len(loads), len(self.on)), np.uint8)
        for g, on in enumerate(self.on):
            cells = np.flatnonzero(on & eligible)
            if len(cells) < FEWEST_CELLS:
                continue
            full = loads[:, cells] >= FULL
            all_full = full.all(axis=1)
            # Of one cell alone it may be noise.
            loaded = (loads[:, cells] > UNLOADED).mean(axis=1) > MAJORITY
            where = np.where(all_full, 2, loaded)
            spread = np.ptp(readings[:, cells], axis=1)
            one = spread <= 2 * self.tolerance  # of missing ones: not
            held: Mask = np.all(constant[:, cells], axis=1) & self.noise
            # Rest levels that creep below the range of the converter have no noise.
            at_rest = where == 0
            if held[at_rest].sum() > (1 - LEAST_LOADED) * at_rest.sum():
                held &= ~at_rest
            # Under a contact that is too heavy, some cells at its edge are not at full scale.
            at_edge = (full.mean(axis=1) >= MAJORITY) & ~all_full
            usual = ~one & ~held
            if at_edge.sum() > LOW * all_full.sum():
                usual |= all_full
            state[:, g] = np.where(usual, 0, 1 + 3 * (one + 2 * held - 1) + where)
        return state


@dataclass(frozen=True)
class LifeModel(HealthyTable):
    """What healthy cells do, given the others: ``reached`` is of the ``FAULTS``.

    Attributes:
        means: predictions, for each tile; each cell is an output of one.
        equal: float ``[D, 8]``, probability that a healthy cell reads the same as one beside it
            throughout a unit.
        amid: float ``[D, 5]``, probability of each level of how far a healthy cell reads from the
            mean beside it.
        tolerance: a cell whose readings lie within this of its highest one reads it, in the
            layout's unit.
        wires: of the cells' wires; None: there are none with enough cells.
        groups: of what a bus, a converter or a connector holds; None: there is none.
    """

    means: tuple[ConditionalMean, ...]
    equal: Floats
    amid: Floats
    tolerance: float
    wires: WireModel | None
    groups: GroupModel | None

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless this is a model of ``layout``."""
        outputs = np.concatenate([mean.outputs for mean in self.means])
        if not np.array_equal(np.sort(outputs), np.flatnonzero(layout.present)):
            raise ValueError(f"the proof of life does not cover each cell of {layout} exactly once")
        shape = (self.n_contexts, self.n_levels)
        if self.table.shape not in ((1, *shape), (layout.n_cells, *shape)):
            raise ValueError(f"expected a table [1 or {layout.n_cells}, {shape[0]}, {shape[1]}]")
        if self.reached.shape != (len(FAULTS), layout.n_cells):
            raise ValueError(f"expected reached [{len(FAULTS)}, {layout.n_cells}]")
        if self.errs.shape != (layout.n_cells,):
            raise ValueError(f"expected errs [{layout.n_cells}]")
        if self.equal.shape != layout.beside.shape or self.amid.shape != (
            layout.n_cells,
            len(AMID) + 1,
        ):
            raise ValueError(f"expected equal and amid of {layout}")
        probabilities = np.concatenate(
            [[self.independent], self.errs, self.equal.ravel(), self.amid.ravel()]
        )
        if not ((probabilities > 0) & (probabilities <= 1)).all():
            raise ValueError("expected probabilities between 0 and 1")

    @property
    def n_contexts(self) -> int:
        """Number M of contexts."""
        return (len(self.predicted) + 1) * (len(BESIDE) + 1)

    def expected(self, loads: Array, known: Mask) -> Floats:
        """Return the expected root loads ``[n, D]``, given those of the ``known`` cells (bool
        ``[D]``)."""
        found = np.zeros(loads.shape)
        for mean in self.means:
            found[:, mean.outputs] = mean.predict(loads, known)
        return found

    def contexts(self, loads: Array, known: Mask, beside: Cells) -> NDArray[np.intp]:
        """Return what the others say of each cell, 0 to M - 1, int ``[n, D]``."""
        level = np.zeros(loads.shape, np.uint8)
        for mean in self.means:
            level[:, mean.outputs] = levels_of(mean.predict(loads, known), self.predicted)
        around = loaded_beside(loads, known, beside)
        return level.astype(np.intp) * (len(BESIDE) + 1) + around

    def otherwise(self, gain: float, offset: float, cells: Cells) -> Floats:
        """Return P(observed level | context) of cells with a gain and an offset (of full scale),
        ``[cells, M, K]``."""
        above = np.append(self.levels, 1.0)
        below = np.append(0.0, self.levels)
        middle = (above + below) / 2
        middle[0] = 0.0
        load = np.clip(gain * middle**2 + offset, 0.0, 1.0)
        becomes = levels_of(np.sqrt(load), self.levels)
        table = self.probabilities[self.of_cell(cells)]
        found = np.full(table.shape, GUESS / len(middle))
        for before, after in enumerate(becomes.tolist()):
            found[:, :, after] += (1 - GUESS) * table[:, :, before]
        return found
