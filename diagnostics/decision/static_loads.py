"""Static loads: an object or a strap that lies still on the array looks like stuck cells, and is no
fault.

Tests neighbouring cells that hold a load since the same time: an object, or independent faults? All
other cells were unloaded at some time since, so that the loads that are left are those of the
object alone. The log odds of an object, by the chain rule over the cells i of the group,

    log P(object)
        + sum over i of  log P(v_i | object, cells before i, other cells unloaded)
                         - log P(i stuck at v_i)

take the first probability from the healthy model, in which the loads of a contact support each
other, and the second from the share of cells that are stuck elsewhere on the array. The cells with
the highest sum are the object; its probability is the logistic function of the log odds. Cells of
an object are neither faulty nor tested.

No object holds a cell at full scale or below its rest, nor a pad where it rests with its cells
(:mod:`diagnostics.preprocessing.offset`).

Not detected: objects on fewer than three cells; objects of a shape or load that no contact of the
reference had; objects without a reference. Cells that are stuck at values that an object could have
look like one, unless they lost noise that they had in the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.decision.line_cover import PROVEN
from diagnostics.decision.static_load import StaticLoad
from diagnostics.evidence.conditional_test import HeldValues
from diagnostics.preprocessing.levels import ANYWHERE, EXPECTED, P_MIN, SLIGHT, TESTED

if TYPE_CHECKING:
    from diagnostics.evidence.spatial import Spatial
    from diagnostics.evidence.stream_state import StreamState

_FEWEST = 3  # cells of an object
_EXPECTED_OBJECTS = 0.1  # prior probability of an object in a log
_ANY_SHAPE = 0.05  # share of objects of a shape and load that the healthy model does not know
_BESIDE = 0.3  # probability that such an object loads the cell beside a loaded one

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]


def find_static_loads(
    stream: StreamState,
    spatial: Spatial,
    faulty: Mask,
    excluded: Mask,
    known: Sequence[StaticLoad],
    *,
    beside: bool = False,
) -> list[StaticLoad]:
    """Return the static loads: those that are ``known``, with more cells, and new ones.

    Args:
        stream: the log.
        spatial: the result of the spatial test, in which the cells of known loads had no part.
        faulty: bool ``[D]``, cells that look faulty; a new load has to explain one of them.
        excluded: bool ``[D]``, cells that are explained otherwise.
        known: loads found before.
        beside: whether a faulty cell beside the load suffices. Cells that move on an object are
            healthy, but mislead the test of the cells around it.
    """
    if stream.reference.model is None or not faulty.any():
        return list(known)
    held = _HeldLoads.of(stream, spatial, faulty, excluded)
    blamed = held.faulty & (held.root > 0)
    broken = _on_broken_wires(blamed & spatial.scored, stream)
    broken |= stream.without_noise()  # an object takes none away
    loaded = _mask([cell for load in known for cell in load.cells], len(faulty))
    holding = (held.root > 0) & ~broken

    def explains(cells: Mask) -> bool:
        near = stream.layout.with_neighbours(cells) if beside else cells
        return bool((near & held.faulty).any())

    def groups(cells: Mask) -> list[Mask]:
        group_of = stream.layout.connected(cells)
        every = (group_of == i for i in range(1, group_of.max() + 1))
        return [group for group in every if group.sum() >= _FEWEST and explains(group)]

    # The surprisal asks the model: only where there can be a load.
    new = groups(loaded | (holding & (held.surprisal > TESTED))) if groups(loaded | holding) else []
    found = [load for load in known if not any(group[list(load.cells)].any() for group in new)]
    if not new:
        return found
    supported = held.with_object(np.flatnonzero(np.any(new, axis=0)))
    for group in new:
        own = [load for load in known if group[list(load.cells)].any()]
        expected = np.log(_EXPECTED_OBJECTS / stream.present.sum())
        if own:
            expected = logit(min(*(load.probability for load in own), 1 - P_MIN))
        first = [cell for load in own for cell in load.cells]
        otherwise = held.without_object(blamed & ~group)
        cells, odds = held.most_likely(group, otherwise, supported, first, float(expected))
        if own or (odds > PROVEN and len(cells) >= _FEWEST and explains(_mask(cells, len(faulty)))):
            found.append(
                StaticLoad.on(
                    cells, float(expit(odds)), int(np.median(held.since[cells])), stream.layout
                )
            )
    return found


@dataclass(frozen=True)
class _HeldLoads:
    """What each cell holds up to the end of the log, ``[D]`` each.

    Attributes:
        stream: the log.
        spatial: the result of the spatial test.
        faulty: bool, cells that look faulty, except those with another gain before the load.
        excluded: bool, cells that are explained otherwise.
        root: float, root load; 0: none.
        since: int, the frame since which it is held.
        values: the loads as values.
    """

    stream: StreamState
    spatial: Spatial
    faulty: Mask
    excluded: Mask
    root: Floats
    since: Cells
    values: HeldValues

    @classmethod
    def of(cls, stream: StreamState, spatial: Spatial, faulty: Mask, excluded: Mask) -> _HeldLoads:
        """Return the loads of a log; the arguments are those of :func:`find_static_loads`."""
        scale = stream.scale
        runs = stream.runs
        least, since = stream.least_loads()
        value = np.minimum(np.nan_to_num(runs.value), scale.baseline + scale.full_scale)
        root = np.where(spatial.scored, scale.root_load(value), least)
        since = np.where(
            spatial.scored, np.where(least > 0, np.minimum(runs.start, since), runs.start), since
        )
        root[since >= max(stream.begun, default=0)] = (
            0.0  # the load of the last contact, which may still go on
        )
        root[excluded | ~stream.present | (stream.reference.dead > 0) | (root**2 < SLIGHT)] = 0.0
        level = stream.rest_of_pads()
        root[(level > 0) & (root**2 * scale.full_scale <= level + scale.near)] = 0.0
        values = HeldValues.of(
            scale.baseline + root**2 * scale.full_scale, scale, stream.reference.tolerance
        )
        root[np.isinf(values.high)] = 0.0  # full scale is no load of an object
        faulty = faulty & ~(np.isfinite(spatial.factor) & (spatial.since < since))
        return cls(stream, spatial, faulty, excluded, root, since, values)

    @cached_property
    def surprisal(self) -> Floats:
        """-log P(these readings | healthy, no object) of cells with a load: as a value, drift or
        unbroken contacts."""
        drift = self.spatial.offset + np.maximum(self.spatial.gain, 0.0)
        return np.maximum(
            self.spatial.surprisal + drift, self.stream.never_unloaded(self.root > 0, self.others)
        )

    def without_object(self, blamed: Mask) -> Floats:
        """Return the log likelihood without an object, ``[D]``; ``blamed`` (bool ``[D]``) are the
        faults elsewhere."""
        constant = self.spatial.scored
        present = self.stream.present
        anywhere = 4 * self.stream.reference.tolerance / self.stream.scale.full_scale
        stuck = np.ones(len(self.root))
        for alike in (constant, ~constant):
            share = max(EXPECTED * ANYWHERE, (blamed & alike).sum() / present.sum())
            stuck[alike] = share * anywhere
        log_likely: Floats = np.logaddexp(np.log(stuck), -self.surprisal)
        return log_likely

    def with_object(self, chosen: Sequence[int] | Cells) -> Floats:
        """Return the log likelihood of each load, ``[D]``, with an object on it and the ``chosen``
        cells."""
        held = np.flatnonzero(self.root > 0)
        predictors = self.others | _mask(chosen, len(self.root))
        log_likely = np.zeros(len(self.root))
        of_model = np.exp(self.stream.log_held(self.root, predictors, self.values)[held])
        any_shape = np.where(np.isnan(of_model), 1.0, _ANY_SHAPE)
        log_likely[held] = np.log(
            (1 - any_shape) * np.nan_to_num(of_model) + any_shape * _BESIDE * self.width[held]
        )
        return log_likely

    @cached_property
    def others(self) -> Mask:
        """Cells that hold no load and may be predictors, bool ``[D]``."""
        doubtful = self.stream.suspected(self.spatial) | self.faulty | self.excluded
        others: Mask = self.stream.present & ~doubtful & (self.root == 0)
        return others

    @cached_property
    def width(self) -> Floats:
        """Of the root loads that count as the value of each cell, ``[D]``."""
        width: Floats = np.minimum(self.values.high, 1.0) - np.minimum(self.values.low, 1.0)
        return np.maximum(width, P_MIN)  # full scale has none

    def most_likely(
        self,
        group: Mask,
        otherwise: Floats,
        supported: Floats,
        first: Sequence[int],
        expected: float,
    ) -> tuple[Cells, float]:
        """Return the cells of a group that one object explains best, and the log odds of the
        object.

        Args:
            group: bool ``[D]``, neighbouring cells that hold a load.
            otherwise: float ``[D]``, log likelihood of each without an object.
            supported: float ``[D]``, the same with an object, given all other cells of the group.
            first: cells that are known to lie under the object.
            expected: log odds of the object with these; of one at a given place where there are
                none.
        """
        chosen = list(first)
        sums = [expected]
        if not chosen:
            gain = np.where(group, supported - otherwise, -np.inf)
            best = int(gain.argmax())
            begin = expected + float(np.log(self.width[best]) - otherwise[best])
            if begin + np.maximum(gain, 0.0).sum() - gain[best] <= 0:
                return np.flatnonzero(group), -np.inf
            chosen = [best]
            sums = [begin]
        known = len(chosen)
        while len(chosen) < group.sum():
            on = _mask(chosen, len(group))
            beside = self.stream.layout.with_neighbours(on) & ~on & group
            gain = np.where(beside, self.with_object(chosen) - otherwise, -np.inf)
            # As many again as are known: few predictions, and cells that join together do not
            # support each other.
            more = np.argsort(-gain, kind="stable")[: min(len(chosen), int(beside.sum()))]
            if not len(more):
                break
            chosen += more.tolist()
            sums += (sums[-1] + np.cumsum(gain[more])).tolist()
        most = int(np.argmax(sums))
        return np.array(sorted(chosen[: known + most])), sums[most]


def _mask(cells: Cells | Sequence[int], n: int) -> Mask:
    on = np.zeros(n, bool)
    on[list(cells)] = True
    return on


def _on_broken_wires(blamed: Mask, stream: StreamState) -> Mask:
    """Return the ``blamed`` cells (bool ``[D]``) that read the same as most cells on one of their
    wires do."""
    explained = np.zeros(len(blamed), bool)
    value = stream.runs.value
    for line in stream.layout.lines:
        cells = stream.layout.cells_on(line)
        held = cells[blamed[cells]]
        if len(held) > max(2, len(cells) / 2):
            same = held[
                np.abs(value[held] - np.median(value[held])) <= stream.reference.tolerance / 2
            ]
            if len(same) > max(2, len(cells) / 2):
                explained[same] = True
    return explained
