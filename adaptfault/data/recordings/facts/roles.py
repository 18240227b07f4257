"""What the name of a column, a feature or an array says that it holds: times, episodes, classes, or
readings. Every format follows these rules."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import product

from adaptfault.data.recordings.recording import Shape

EPISODES = ("episode_index", "episode", "episode_id", "recording", "trial")
"""Names of what numbers the episodes, in the order of preference."""

LABELS = ("label", "labels", "class", "object", "task")
"""Names of classes, in the order of preference."""

TOUCH = re.compile(r"tactile|taxel|pressure|touch|skin|fsr", re.IGNORECASE)
"""A word for touch in the name of readings."""

_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), "s"),
    **dict.fromkeys(("ms", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "micros", "microseconds"), "us"),
    "ns": "ns",
}
_ALONE = ("seconds", "secs", "millis", "milliseconds", "micros", "microseconds")
"""Units that name times by themselves."""

_UNIT = rf"[\[(]?({'|'.join(_UNITS)})[\])]?"
_WORDS = "time[_ ]?stamps?|times?|stamps?|clock|epoch|elapsed|zeit|uhrzeit"
_CLOCK = re.compile(
    rf"[%#]?(?:rosbag[_ ]?)?_*(?:{_WORDS}|ts|t)(?:[_ ]?{_UNIT})?", re.IGNORECASE | re.ASCII
)
"""Names of times, also as rostopic, plotjuggler and Arduino sketches write them."""

_OF_DEVICE = re.compile(rf"(?:\w+[_ ])(?:{_WORDS})(?:[_ ]?{_UNIT})?", re.IGNORECASE | re.ASCII)
"""Names of times behind a word that says whose they are, as ``host_time``."""

_ENDS_IN_UNIT = re.compile(rf"[_ ]{_UNIT}", re.IGNORECASE | re.ASCII)

_COUNTER = re.compile(
    r"|unnamed: 0|index|sn|seq(?:uence)?|counter"
    r"|(?:frame|sample|packet|row|line)(?:[_ ]?(?:id|no|nr|number|count|counter))?",
    re.IGNORECASE,
)
"""Names of what counts the frames, where they stand before the readings."""

_COUNTERS = ("frame_index", "frame_id", "sample_index", "task_index")
"""Names of it wherever they stand."""

_STATUS = re.compile(r"(?:.*_)?(?:flags?|status|state|valid|checksum|crc(?:8|16|32)?)", re.I)
"""Names of what accompanies readings."""

_DIGITS = re.compile(r"\d+")


def _last(name: str) -> str:
    """Return the last part of a name, as ``stamp`` of ``header.stamp``."""
    return re.split(r"[./]", name.strip())[-1]


def unit_of(name: str) -> str | None:
    """Return the unit in the name of times, as in ``elapsed_ms``; None: it states none."""
    last = _last(name)
    found = _CLOCK.fullmatch(last) or _OF_DEVICE.fullmatch(last)
    if found is not None:
        return None if found[1] is None else _UNITS[found[1].lower()]
    if last.lower() in _ALONE:
        return _UNITS[last.lower()]
    ends = [*_ENDS_IN_UNIT.finditer(last)]
    at_end = [one for one in ends if one.end() == len(last)]
    return _UNITS[at_end[0][1].lower()] if at_end else None


def is_clock(name: str) -> bool:
    """Return whether a name is that of times."""
    last = _last(name)
    found = _CLOCK.fullmatch(last) or _OF_DEVICE.fullmatch(last)
    return found is not None or name.strip().lower() in _ALONE


def clock_of(names: Iterable[str]) -> str | None:
    """Return the name of the times; None without one. ``time`` goes before ``host_time``."""
    found = [name for name in names if is_clock(name)]
    plain = [name for name in found if not _OF_DEVICE.fullmatch(_last(name))]
    return next(iter([*plain, *found]), None)


def first_of(wanted: Sequence[str], names: Sequence[str]) -> str | None:
    """Return the first wanted name among some names, whatever their case."""
    lower = [name.strip().lower() for name in names]
    return next((names[lower.index(name)] for name in wanted if name in lower), None)


def no_readings(names: Sequence[str]) -> list[int]:
    """Return which of the columns with some names hold times, episodes, classes or numbers of
    frames."""
    found = []
    leads = True
    for column, name in enumerate(names):
        plain = name.strip().lower()
        is_aside = is_clock(plain) or plain in (*EPISODES, *LABELS, *_COUNTERS)
        if is_aside or (leads and _COUNTER.fullmatch(plain)):
            found.append(column)
            continue
        leads = False
    return found


def families(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the columns whose names differ in their numbers alone, by the name with ``*`` in place
    of the number: ``L_ch*`` for ``L_ch0`` to ``L_ch15``."""
    found: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        stem = _DIGITS.sub("*", name)
        if stem != name:
            found.setdefault(stem, []).append(column)
    return {stem: columns for stem, columns in found.items() if len(columns) > 1}


def readings(names: Sequence[str], cells: int | None = None) -> list[int]:
    """Return which of the columns with some names are readings: those that are numbered, as ``c0``
    to ``c15``, where these are most; of several kinds those with a word for touch. A state, as
    ``flags``, is none.

    Args:
        names: of columns of numbers that are no times, episodes or classes.
        cells: of the array, where it is known; as many columns are all readings.
    """
    every = [column for column, name in enumerate(names) if not _STATUS.fullmatch(name)]
    found = families(names)
    kept = sorted(column for columns in found.values() for column in columns)
    if len(names) == cells:
        return list(range(len(names)))
    if len(every) == cells or 2 * len(kept) <= len(every):
        return every
    touch = [column for stem in found if TOUCH.search(stem) for column in found[stem]]
    return sorted(touch) if touch and len(kept) != cells else kept


def shape_of(names: Sequence[str]) -> tuple[Shape, str] | None:
    """Return the shape that the names of the readings show, and how: numbers of rows and columns
    in them (``c_0_0`` to ``c_3_5``), or equal families, each a pad without rows.

    None where they show neither, or stand in another order than row by row.
    """
    found = families(names)
    columns = [column for family in found.values() for column in family]
    sizes = {len(family) for family in found.values()}
    if columns != list(range(len(names))) or len(sizes) != 1:
        return None
    stems = list(found)
    grids = {_grid(names[family[0] : family[-1] + 1]) for family in found.values()}
    grid = grids.pop()
    if not grids and grid is not None and (len(stems) == 1 or grid[0] == 1):
        shown = f"names {names[0]} to {names[-1]}"
        return (len(stems) * grid[0], grid[1], grid[2]), shown
    if len(stems) == 1:
        return None
    shown = f"{', '.join(stems)}: {len(stems)} times {len(columns) // len(stems)} columns"
    return (len(stems), 1, sizes.pop()), shown


def _grid(names: Sequence[str]) -> Shape | None:
    """Return pads, rows and columns that two or three numbers in each name count row by row."""
    numbers = [tuple(map(int, _DIGITS.findall(name))) for name in names]
    axes = list(zip(*numbers, strict=True))
    axes = [axis for axis in axes if len(set(axis)) > 1]
    if len(axes) not in (2, 3):
        return None
    counted = [sorted(set(axis)) for axis in axes]
    if list(zip(*axes, strict=True)) != list(product(*counted)):
        return None
    pads, rows, cols = (1,) * (3 - len(axes)) + tuple(map(len, counted))
    return pads, rows, cols
