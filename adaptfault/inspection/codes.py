"""Codes of what ``check`` tells: one for each kind of fault and each finding, the same for ever.

A code says what was found, why it matters to whoever trains, how far it can be trusted, and what
is not found. How bad it is stands in :mod:`adaptfault.inspection.severity`, what is faulty in the
finding itself. Numbers are never used again:

- 100 to 119 cells and wires, by the kind of the fault
- 120 to 139 what the whole array or a pad does
- 140 to 159 frames, readings and times
- 160 to 179 recordings that mislead whoever trains on them
- 190 to 199 what was not checked; such a finding is never a pass
"""

from __future__ import annotations

from collections.abc import Mapping

from adaptfault.inspection.code import PREFIX, Code, Need
from adaptfault.inspection.code_list import CODES
from diagnostics.faults import FaultKind

BY_NAME: Mapping[str, Code] = {code.name: code for code in CODES}
"""The code of each kind of fault and each name of a finding."""

BY_CODE: Mapping[str, Code] = {str(code): code for code in CODES}


def code_of(text: str) -> Code:
    """Return the code that a text names: ``TOUCH-103``, ``103``, or what it tells, as ``stuck``.

    Raises:
        ValueError: it names none.
    """
    wanted = text.strip()
    upper = wanted.upper()
    for known, key in ((BY_CODE, upper), (BY_CODE, f"{PREFIX}{upper}"), (BY_NAME, wanted.lower())):
        if key in known:
            return known[key]
    raise ValueError(
        f"{text!r} is no code; expected one of {CODES[0]} to {CODES[-1]}, or a name as"
        f" {FaultKind.STUCK}; adaptfault explain lists them"
    )


def unchecked(given: set[Need]) -> dict[Need, list[Code]]:
    """Return the codes that nobody looked for, by what they need and was not given."""
    left: dict[Need, list[Code]] = {}
    for code in CODES:
        if code.needs is not None and code.needs not in given:
            left.setdefault(code.needs, []).append(code)
    return left
