"""What divides recordings beside their classes: robots, sessions, days, data sets.

A fault often begins with one of them, and a model learns it for whatever goes along. A table states
them, a row a recording: its name as ``check`` tells it, and one column for each division. Several
data sets that are checked together are a division by themselves, and so are the robots that files
state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from os import path as paths
from pathlib import Path

from adaptfault.data.printable import printable
from adaptfault.data.recordings import Opened
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.labels import table_lines
from adaptfault.inspection.coincidence import coinciding
from adaptfault.inspection.result import Finding
from adaptfault.inspection.severity import of_finding
from diagnostics import Diagnosis

RECORDING = "recording"
"""The column with the name of a recording."""

UNKNOWN = "unknown"
"""Where a recording belongs of which nothing is stated."""

Groupings = Mapping[str, Sequence[str]]
"""For each division, where each recording belongs."""


def read_groupings(path: str | Path, names: Sequence[str]) -> Groupings:
    """Return the divisions that a table states.

    Args:
        path: of the table, CSV with a header.
        names: of the recordings.

    Raises:
        InputError: it has no column ``recording`` and another one, or lacks a recording, or names
            one twice.
    """
    path = Path(path)
    header, lines = table_lines(path)
    if RECORDING not in header or len(header) < 2 or not lines:
        expected = f"expected a header as {RECORDING},robot,session and a row a recording"
        raise InputError.at(path, f"is no table of groups; {expected}")
    of: dict[str, dict[str, str]] = {}
    for number, cells in lines:
        row = dict(zip_longest(header, cells[: len(header)], fillvalue=""))
        name = printable(row.pop(RECORDING))
        if name in of:
            raise InputError.at(path, f"names {name} twice; leave one row of it", f"line {number}")
        of[name] = row
    missing = [name for name in names if name not in of]
    if missing:
        more = f" and {len(missing) - 1} more" if missing[1:] else ""
        what = f"has no row of {missing[0]}{more}; give one for each recording"
        raise InputError.at(path, f"{what}, by the names that adaptfault check tells")
    columns = [name for name in header if name and name != RECORDING]
    return {name: [of[one][name] for one in names] for name in columns}


def groupings_of(log: Opened, given: Sequence[str]) -> Groupings:
    """Return from which of the ``given`` paths each recording is, and from which robot, where files
    state it."""
    robots = [one.device or one.facts.device for one in log.origins]
    stated = {"robot": [one or UNKNOWN for one in robots]} if any(robots) else {}
    return {"data set": _data_sets_of(log, given), **stated}


def joined(parts: Sequence[tuple[Groupings, int]]) -> Groupings:
    """Return the divisions of parts of a data set, one behind the other; each with how many
    recordings it has."""
    names = dict.fromkeys(name for groupings, _ in parts for name in groupings)
    return {
        name: [one for given, n in parts for one in given.get(name, [UNKNOWN] * n)]
        for name in names
    }


def dividing(groupings: Groupings) -> Groupings:
    """Return the divisions in which not all recordings belong together."""
    return {name: values for name, values in groupings.items() if len(set(values)) > 1}


def _data_sets_of(log: Opened, given: Sequence[str]) -> list[str]:
    """Return from which of the ``given`` paths each recording is."""
    places = [paths.realpath(one) for one in given]
    found = []
    for origin in log.origins:
        of = paths.realpath(origin.facts.path)
        within = [i for i, place in enumerate(places) if of == place or _is_in(of, place)]
        found.append(given[within[0]] if within else str(origin.facts.path))
    return found


def coincide(diagnosis: Diagnosis, groupings: Groupings) -> list[Finding]:
    """Return a finding for each division that faults go along with."""
    return [
        Finding("coincides", of_finding("coincides"), text)
        for what, values in groupings.items()
        for text in coinciding(diagnosis, values, what)
    ]


def _is_in(path: str, folder: str) -> bool:
    return path.startswith(folder.rstrip(paths.sep) + paths.sep)
