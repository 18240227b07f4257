"""The option --inject: faults written as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from diagnostics import Fault, FaultKind, SensorLayout

INJECT_HELP = (
    "break the sensor, WHERE=HOW: cell:PAD:ROW:COL, row:PAD:ROW, column:PAD:COL or random:COUNT;"
    " open, short or stuck:VALUE; may be given several times"
)


def parse_faults(
    texts: Sequence[str], layout: SensorLayout, rng: np.random.Generator
) -> list[Fault]:
    """Read faults such as ``row:0:3=open``, ``cell:1:4:5=stuck:2.5``, ``random:5=short``.

    Random cells are drawn from the present ones, none twice.

    Raises:
        ValueError: a text of another form, or a place or value that the layout does not have.
    """
    import numpy as np

    from diagnostics import Fault, Line, line_fault

    faults: list[Fault] = []
    free = rng.permutation(np.flatnonzero(layout.present)).tolist()
    for text in texts:
        try:
            where, how = text.split("=")
            place, *numbers = where.split(":")
            positions = [int(n) for n in numbers]
            kind, value = _kind(how, layout)
            match place, positions:
                case "cell", [pad, row, column]:
                    faults.append(Fault(kind, (layout.cell(pad, row, column),), value=value))
                case ("row" | "column") as line, [pad, index]:
                    faults.append(line_fault(layout, Line(pad, line, index), kind, value=value))
                case "random", [count] if 0 < count <= len(free):
                    faults += [Fault(kind, (free.pop(),), value=value) for _ in range(count)]
                case _:
                    raise ValueError("no such place")
        except (ValueError, IndexError) as error:
            raise ValueError(f"--inject {text}: {error}; expected {INJECT_HELP}") from None
    return faults


def _kind(how: str, layout: SensorLayout) -> tuple[FaultKind, float | None]:
    from diagnostics import FaultKind

    name, colon, number = how.partition(":")
    kind = FaultKind(name)
    if kind not in (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK):
        raise ValueError(f"{kind} needs more than a value")
    if not colon:
        return kind, layout.full_scale / 2 if kind is FaultKind.STUCK else None
    value = float(number)
    if not 0 <= value <= layout.full_scale:
        raise ValueError(f"{value:g} lies outside 0..{layout.full_scale:g} {layout.unit}")
    return kind, value
