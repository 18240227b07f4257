"""How rows of a table are called that are no readings: times, episodes, classes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from adaptfault.data.recordings.errors import InputError

CLOCK = re.compile(
    r"(?:.*[./_])?(?:time|times|timestamp|timestamps|stamp|t)(?:_?(s|ms|us|ns))?", re.IGNORECASE
)
"""Name of a column of times, and its unit."""

_UNIT = re.compile(r"_(s|ms|us|ns)$", re.IGNORECASE)
_SINCE = re.compile(
    r"(?:(s|sec|secs|seconds?)|(ms|msecs?|milliseconds?)|(us|microseconds?)|(ns|nanoseconds?))"
    r"(?: since .*)?",
    re.IGNORECASE,
)
_SHOWN = 12  # columns in a message

EPISODES = ("episode_index", "episode", "episode_id", "recording", "trial")
"""Names of a column that numbers the episodes, in the order of preference."""

LABELS = ("label", "class", "object", "task")
"""Names of a column of classes, in the order of preference."""

NUMBERS = ("frame_index", "index", "task_index")
"""Names of columns of numbers that are no readings."""


def first_of(wanted: Sequence[str], columns: Sequence[str]) -> str | None:
    """Return the first wanted name among the columns."""
    return next((name for name in wanted if name in columns), None)


def named(path: Path, option: str, stated: str | None, columns: Sequence[str]) -> str | None:
    """Return the column that an option states, by its name or the last part of it; None where it
    states none.

    Raises:
        InputError: no column has this name, or several have.
    """
    if stated is None:
        return None
    found = [name for name in columns if name == stated]
    found = found or [name for name in columns if re.split(r"[./]", name)[-1] == stated]
    if len(found) == 1:
        return found[0]
    held = ", ".join([*columns[:_SHOWN], *(["..."] if len(columns) > _SHOWN else [])])
    count = "several have this name" if found else "there is none"
    raise InputError.at(path, f"--{option} {stated}: {count}; name one of {held}")


def unit_of(name: str, units: object = None) -> str | None:
    """Return the unit of times: what their attribute ``units`` says, as "milliseconds since
    2020-01-01", or the ending of their name, as in ``elapsed_ms``; None: nothing states it."""
    stated = _SINCE.fullmatch(units.strip()) if isinstance(units, str) else None
    if stated is not None:
        return ("s", "ms", "us", "ns")[(stated.lastindex or 1) - 1]
    found = _UNIT.search(name)
    return None if found is None else found[1].lower()


def clock_of(columns: Sequence[str]) -> tuple[str | None, str | None]:
    """Return the column of times and its unit; None where there is none, or it is not stated."""
    for name in columns:
        if found := CLOCK.fullmatch(name):
            unit = found[1]
            return name, None if unit is None else unit.lower()
    return None, None
