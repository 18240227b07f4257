"""From what is known of each cell of a log to its diagnosis: root causes, and what was tested."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.judged import Judged, Mask
from diagnostics.decision.result import Diagnosis
from diagnostics.decision.root_causes import cut_off, pulling, root_causes
from diagnostics.evidence.stream_state import StreamState
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout


def concluded(
    stream: StreamState,
    judged: Judged,
    n_recordings: int,
    layout: SensorLayout,
    order: NDArray[np.intp],
    *,
    falls: bool | None,
) -> Diagnosis:
    """Return the diagnosis of a log.

    Args:
        stream: the log, each axis of a pad as a pad of its own.
        judged: what is known of its cells.
        n_recordings: of which it consists.
        layout: of the array.
        order: int ``[D]``, cell of the layout that each cell of the stream is.
        falls: whether a load, as the stream holds it, may lower the reading; None: unknown.
    """
    place = np.argsort(order)
    found = judged.found.of(place)
    causes, possible = root_causes(found, judged.aliases, layout)
    at_rest = stream.unused(found.alive[order])[place]
    unused = _unused(at_rest, causes, layout, contradicted=judged.contradicting > 0)
    unused &= found.refuted < 0  # what moves by itself does not rest
    if unused.any():
        found = found.without(unused)
        causes, possible = root_causes(found, judged.aliases, layout)
    probability = found.probability.copy()
    still = [load.of(order, layout) for load in judged.still]
    for load in still:
        probability[list(load.cells)] = 1 - load.probability
    probability, inferred = _with_causes(probability, causes)
    # Noise alone is no test; nor is movement, where the reference tells how cells depend on each
    # other; nor is a line that a shorted crossing pulls.
    pulled = _pulled(judged, causes, inferred[order], place)
    causes = pulling(causes, pulled, layout)
    scale = stream.scale
    working = np.empty_like(inferred)
    moved = bool((stream.runs.moved & stream.present).any())
    working[place] = ~inferred & (found.alive if moved else layout.is_cell)
    # Where cells moved, loads of a frozen frame come or go: other cells have another offset.
    rest = np.maximum(scale.baseline, stream.lowest) if moved else scale.baseline
    return Diagnosis(
        layout=layout,
        faults=causes,
        probability=probability,
        tested=(found.alive & judged.shown[place] & ~pulled) | inferred,
        transport=stream.transport.faults(
            rest + scale.near, working, layout.rate, moved, falls=falls
        ),
        evidence={name: values[place] for name, values in judged.evidence.items()},
        n_frames=stream.transport.seen,
        n_recordings=n_recordings,
        possible=(*possible, *cut_off(unused, layout)),
        static_loads=tuple(still),
        contradicting=judged.contradicting,
    )


def _pulled(
    judged: Judged, causes: Sequence[Fault], inferred: Mask, place: NDArray[np.intp]
) -> Mask:
    """Return the cells that shorted crossings pull, bool ``[D]``.

    Args:
        judged: cells of the stream.
        causes: on cells of the layout.
        inferred: bool ``[D]``, cells of the stream that they explain.
        place: int ``[D]``, cell of the stream that each cell of the layout is.
    """
    shorts = [f.cells[0] for f in causes if f.kind is FaultKind.SHORT and f.line is None]
    if judged.pulled is None or not shorts:
        return np.zeros_like(inferred)
    # a cell that reads a part of its load may be pulled
    misleads = inferred.copy()
    weak = np.array([c for f in causes if f.kind is FaultKind.WEAK for c in f.cells], np.intp)
    misleads[place[weak]] = False
    return judged.pulled(place[np.array(shorts)], misleads)[place]


def _unused(
    at_rest: Mask, causes: Sequence[Fault], layout: SensorLayout, *, contradicted: bool
) -> Mask:
    """Return the cells that are blamed although nothing may have touched their pad, and those at
    rest beside them, bool ``[D]``. Most logs leave some pad alone and blame no cell of it.

    Args:
        at_rest: bool ``[D]``, cells at rest of pads that nothing shows to be in use.
        causes: who is blamed.
        layout: of the array.
        contradicted: so many cells contradict what the others say that none is blamed for it.
    """
    blamed = np.zeros_like(at_rest)
    blamed[[cell for fault in causes for cell in fault.cells]] = True
    blamed |= contradicted
    pad = layout.pad_of
    return np.asarray(at_rest & np.isin(pad, pad[at_rest & blamed]))


def _with_causes(
    probability: NDArray[np.float64], causes: Sequence[Fault]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return P(faulty) ``[D]`` with the root causes, and the cells of these, bool ``[D]``."""
    found = probability.copy()
    blamed = np.zeros(len(found), bool)
    for fault in causes:
        cells = list(fault.cells)
        found[cells] = np.maximum(found[cells], fault.probability or 0.0)
        blamed[cells] = True
    return found, blamed
