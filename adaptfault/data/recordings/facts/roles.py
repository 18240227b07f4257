"""What the name of a column, a feature or an array says that it holds: times, episodes, classes, or
readings. Every format follows these rules."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.recording import Shape

EPISODES = (
    *("episode_index", "episode", "episode_id", "recording", "trial"),
    *("recording_id", "trial_id", "demo_id", "grasp_id"),
)
"""Names of what numbers the episodes, in the order of preference."""

LABELS = ("label", "labels", "class", "object", "task")
"""Names of classes, in the order of preference."""

TOUCH = re.compile(r"tactile|taxel|pressure|touch|skin|fsr|electrode", re.IGNORECASE)
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
_WORDS = (
    "time[_ ]?stamps?|times?|stamps?|clock|epoch|elapsed|zeit|uhrzeit|unix(?:time)?|utc|datetime"
)
_CLOCK = re.compile(
    rf"[%#]?(?:rosbag[_ ]?)?_*(?:{_WORDS}|ts|t)(?:[_ ]?{_UNIT})?", re.IGNORECASE | re.ASCII
)
"""Names of times, also as rostopic, plotjuggler and Arduino sketches write them."""

_OF_DEVICE = re.compile(rf"(?:\w+[_ ])(?:{_WORDS})(?:[_ ]?{_UNIT})?", re.IGNORECASE | re.ASCII)
"""Names of times behind a word that says whose they are, as ``host_time``."""

_ENDS_IN_UNIT = re.compile(rf"[_ ]{_UNIT}", re.IGNORECASE | re.ASCII)

_SINCE = re.compile(
    r"(?:(s|sec|secs|seconds?)|(ms|msecs?|milliseconds?)|(us|microseconds?)|(ns|nanoseconds?))"
    r"(?: since .*)?",
    re.IGNORECASE,
)

_COUNTER = re.compile(
    r"|unnamed: 0|index|sn|seq(?:uence)?|counter"
    r"|(?:frame|sample|packet|row|line)(?:[_ ]?(?:id|no|nr|number|count|counter))?",
    re.IGNORECASE,
)
"""Names of what counts the frames, where they stand before the readings."""

SCAN = "scan"
"""Name of the levels of a scan of the read-out."""

COUNTERS = ("frame_index", "frame_id", "sample_index", "task_index")
"""Names of it wherever they stand."""

_STATUS = re.compile(r"(?:.*_)?(?:flags?|status|state|valid|checksum|crc(?:8|16|32)?)", re.I)
"""Names of what accompanies readings."""

_SUMMARY = re.compile(
    r"(?:.*[_ .])?(?:peak|max|maximum|mean|avg|average|median|std|rms)(?:[_ .]?\d*|[_ .].*)",
    re.IGNORECASE,
)
"""Names of values of a whole grasp."""

_OF_PADS = re.compile(
    r"(?:.*[_ .])?(?:f|finger|fingertip|tip|pad|hand|foot|module|patch)[_ ]?\*.*\*.*",
    re.IGNORECASE,
)
"""Names, with stars for their numbers, of which the first counts pads."""

_AXIS = re.compile(r"(.*\d.*?)[_ .]?([xyz])", re.IGNORECASE)

_SHOWN = 12  # columns in a message
_DIGITS = re.compile(r"\d+")
_COLUMN_FIRST = re.compile(r"x.*\*.*y.*\*|c.*\*.*r.*\*", re.IGNORECASE)
"""Names, with stars for their numbers, of which the first counts columns."""


def _last(name: str) -> str:
    """Return the last part of a name, as ``stamp`` of ``header.stamp``."""
    return re.split(r"[./]", name.strip())[-1]


def unit_of(name: str, units: object = None) -> str | None:
    """Return the unit of times: what their attribute ``units`` says, as "milliseconds since
    2020-01-01", or the end of their name, as in ``elapsed_ms``; None: nothing states it."""
    stated = _SINCE.fullmatch(units.strip()) if isinstance(units, str) else None
    if stated is not None:
        return ("s", "ms", "us", "ns")[(stated.lastindex or 1) - 1]
    last = _last(name)
    found = _CLOCK.fullmatch(last) or _OF_DEVICE.fullmatch(last)
    if found is not None:
        return None if found[1] is None else _UNITS[found[1].lower()]
    if last.lower() in _ALONE:
        return _UNITS[last.lower()]
    ends = [one for one in _ENDS_IN_UNIT.finditer(last) if one.end() == len(last)]
    return _UNITS[ends[0][1].lower()] if ends else None


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


def no_readings(names: Sequence[str]) -> list[int]:
    """Return which of the columns with some names hold times, episodes, classes or numbers of
    frames."""
    found = []
    leads = True
    for column, name in enumerate(names):
        plain = name.strip().lower()
        is_aside = is_clock(plain) or plain in (*EPISODES, *LABELS, *COUNTERS)
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


def in_order(names: Sequence[str], shape: Shape | None = None) -> list[int]:
    """Return the columns with some names in the order of their numbers, where the file has another
    one for no reason of the sensor: names that were sorted as text (``c0, c1, c10, c2``), or whose
    numbers count rows and columns. Each family stays in its own places; others are as they stand.

    Args:
        names: of columns of readings.
        shape: ``(pads, rows, cols)`` where it is known; numbers that count others say nothing.
    """
    order = list(range(len(names)))
    for stem, columns in families(names).items():
        counted = sorted(columns, key=lambda column: _numbers(names[column]))
        stand = [names[column] for column in columns]
        grid = None if _COLUMN_FIRST.search(stem) else _grid([names[i] for i in counted])
        is_grid = grid is not None and (shape is None or grid[1:] == shape[1:])
        if is_grid or stand == sorted(stand):
            for place, column in zip(columns, counted, strict=True):
                order[place] = column
    return order


def reordered(stand: Sequence[str], ordered: Sequence[str], option: str) -> str:
    """Return the sentence that columns are read in another order than they stand in; "" where they
    are not."""
    for there, read in zip(stand, ordered, strict=True):
        if there != read:
            what = f"{read} is read where {there} stands"
            return f"columns in the order of their numbers: {what}; otherwise give --{option}"
    return ""


def left_out(others: Sequence[str], kept: Sequence[str], option: str) -> str:
    """Return the sentence that columns are taken for no readings; "" where there are none."""
    if not others:
        return ""
    more = f", ... ({len(others)} in all)" if len(others) > _SHOWN else ""
    kinds = ", ".join(families(kept))
    beside = f" beside {kinds}" if kinds else ""
    what = f"{', '.join(others[:_SHOWN])}{more} left out, as no reading{beside}"
    return f"{what}; otherwise give --{option}"


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
        if grid[0] == 1 and len(stems) == 1 and _OF_PADS.fullmatch(stems[0]):
            grid = grid[1], 1, grid[2]
        return (len(stems) * grid[0], grid[1], grid[2]), shown
    if len(stems) == 1:
        return None
    shown = f"{', '.join(stems)}: {len(stems)} times {len(columns) // len(stems)} columns"
    return (len(stems), 1, sizes.pop()), shown


def is_summary(name: str) -> bool:
    """Return whether a name is that of a value of a whole grasp, as ``peak_3`` or ``c2_mean``."""
    return _SUMMARY.fullmatch(name) is not None


def sizes_of(names: Sequence[str]) -> tuple[list[tuple[int, ...]], str] | None:
    """Return the sizes of pads that differ, as the names of their readings show them, and how:
    families that stand one behind the other, each of rows and columns or of a row.

    None where they show none.
    """
    found = families(names)
    columns = [column for family in found.values() for column in family]
    if len(found) < 2 or columns != list(range(len(names))):
        return None
    sizes: list[tuple[int, ...]] = []
    for family in found.values():
        grid = _grid([names[i] for i in family])
        sizes.append((len(family),) if grid is None else grid if grid[0] > 1 else grid[1:])
    told = ", ".join(
        f"{stem} {' x '.join(map(str, size))}" for stem, size in zip(found, sizes, strict=True)
    )
    return sizes, told


def axes_of(names: Sequence[str]) -> tuple[int, list[int]]:
    """Return how many axes each position has, and the columns in the order of positions and axes:
    names as ``taxel_12_x``. One axis, where they show none."""
    every = list(range(len(names)))
    parts = [_AXIS.fullmatch(name) for name in names]
    if not names or any(part is None for part in parts):
        return 1, every
    of: dict[str, dict[str, int]] = {}
    for column, part in enumerate(parts):
        assert part is not None
        of.setdefault(part[1], {})[part[2].lower()] = column
    axes = [sorted(one) for one in of.values()]
    if len(axes) < 2 or len(axes[0]) < 2 or any(one != axes[0] for one in axes):
        return 1, every
    if len(names) != len(axes) * len(axes[0]):
        return 1, every
    return len(axes[0]), [one[axis] for one in of.values() for axis in axes[0]]


def _numbers(name: str) -> tuple[int, ...]:
    return tuple(map(int, _DIGITS.findall(name)))


def _grid(names: Sequence[str]) -> Shape | None:
    """Return pads, rows and columns that two or three numbers in each name count row by row."""
    numbers = list(map(_numbers, names))
    axes = list(zip(*numbers, strict=True))
    axes = [axis for axis in axes if len(set(axis)) > 1]
    if len(axes) not in (2, 3):
        return None
    counted = [sorted(set(axis)) for axis in axes]
    if list(zip(*axes, strict=True)) != list(product(*counted)):
        return None
    pads, rows, cols = (1,) * (3 - len(axes)) + tuple(map(len, counted))
    return pads, rows, cols
