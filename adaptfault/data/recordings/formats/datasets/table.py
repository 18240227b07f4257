"""Rows of a table by episode: what Parquet files, LeRobot data sets and JSON lines have in
common."""

from __future__ import annotations

import re
from collections.abc import Sequence

CLOCK = re.compile(
    r"(?:.*[./_])?(?:time|times|timestamp|stamp|t)(?:_?(s|ms|us|ns))?", re.IGNORECASE
)
"""Name of a column of times, and its unit."""

EPISODES = ("episode_index", "episode", "episode_id", "recording", "trial")
"""Names of a column that numbers the episodes, in the order of preference."""

LABELS = ("label", "class", "object", "task")
"""Names of a column of classes, in the order of preference."""


def first_of(wanted: Sequence[str], columns: Sequence[str]) -> str | None:
    """Return the first wanted name among the columns."""
    return next((name for name in wanted if name in columns), None)


def clock_of(columns: Sequence[str]) -> tuple[str | None, str | None]:
    """Return the column of times and its unit; None where there is none, or it is not stated."""
    for name in columns:
        if found := CLOCK.fullmatch(name):
            unit = found[1]
            return name, None if unit is None else unit.lower()
    return None, None
