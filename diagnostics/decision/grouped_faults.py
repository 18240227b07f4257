"""Single faults of one kind in one named group, told together: "triangle 7: 3 of its 10 cells are
stuck"."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.wiring import Line, action

_CONSTANT = (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK)


def by_group(faults: Iterable[Fault], layout: SensorLayout) -> list[Fault]:
    """Return the faults, with several single cells of one kind in one named group as one fault.

    It takes the place of the first of them. Its ``line`` is the innermost group. Faults without a
    named group stay as they are.
    """
    faults = list(faults)
    groups = [line for line in layout.lines if line.kind == "group"]
    group_of = {
        cell: group for group in reversed(groups) for cell in layout.cells_on(group).tolist()
    }
    alike: dict[tuple[Line, FaultKind], list[Fault]] = defaultdict(list)
    for fault in faults:
        if (key := _key(fault, group_of)) is not None:
            alike[key].append(fault)
    told = []
    for fault in faults:
        key = _key(fault, group_of)
        together = [] if key is None else alike[key]
        if key is None or len(together) < 2:
            told.append(fault)
        elif fault is together[0]:
            told.append(_merged(key[0], together, layout))
    return told


def _key(fault: Fault, group_of: dict[int, Line]) -> tuple[Line, FaultKind] | None:
    if fault.line is not None or len(fault.cells) != 1 or fault.cells[0] not in group_of:
        return None
    return group_of[fault.cells[0]], fault.kind


def _merged(group: Line, faults: list[Fault], layout: SensorLayout) -> Fault:
    kind = faults[0].kind
    cells = ", ".join(_named(fault, layout) for fault in faults)
    reason = (
        f"{group}: {len(faults)} of its {len(layout.cells_on(group))} cells"
        f" {kind.verb(plural=True)} ({cells}); {action(group)}"
    )
    known = [fault.probability for fault in faults if fault.probability is not None]
    return Fault(
        kind,
        tuple(fault.cells[0] for fault in faults),
        line=group,
        probability=min(known) if known else None,
        reason=reason,
        evidence=sum(fault.evidence or 0 for fault in faults) or None,
    )


def _named(fault: Fault, layout: SensorLayout) -> str:
    name = f"cell {fault.cells[0]}"
    reads = fault.value is not None and fault.kind in _CONSTANT
    return f"{name}: {fault.value:.4g} {layout.unit}" if reads else name
