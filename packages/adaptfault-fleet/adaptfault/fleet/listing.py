"""The list of a fleet, a TOML file: bundle and recordings of each robot, as entries or by a
pattern."""

from __future__ import annotations

import glob
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from string import Formatter
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from adaptfault.data.documents import members
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.sizes import check_file

_ENTRY = {"name", "bundle", "recordings", "tags", "commissioned"}
_LISTING = {"bundles", "recordings", "tags", "robots"}
_EXPECTED = (
    'expected [[robots]] with name, bundle, recordings, or bundles = "robots/*/robot.bundle" and'
    " recordings"
)


@dataclass(frozen=True)
class Robot:
    """One robot: paths of its bundle and its recordings.

    Attributes:
        name: unique in the fleet.
        bundle: path of its bundle.
        recordings: files, folders or glob patterns, expanded when the robot is processed.
        tags: free text, as its site.
        commissioned: first day of its sensor in service, ISO 8601; None if unknown.
    """

    name: str
    bundle: str
    recordings: tuple[str, ...]
    tags: tuple[str, ...] = ()
    commissioned: str | None = None

    def paths(self) -> list[str]:
        """Return files and folders, with patterns expanded.

        Raises:
            FileNotFoundError: a pattern matches nothing.
        """
        found: list[str] = []
        for pattern in self.recordings:
            fitting = (
                sorted(glob.glob(pattern, recursive=True)) if glob.has_magic(pattern) else [pattern]
            )
            if not fitting:
                raise FileNotFoundError(f"{pattern}: no recording matches this pattern")
            found += fitting
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return members(self)


@dataclass(frozen=True)
class Fleet:
    """The robots of a fleet.

    Args:
        robots: at least one.
        source: the file that lists them, if any.

    Raises:
        ValueError: no robot, or two of the same name or bundle.
    """

    robots: tuple[Robot, ...]
    source: str = ""

    def __post_init__(self) -> None:
        where = f"{self.source}: " if self.source else ""
        if not self.robots:
            raise ValueError(f"{where}it lists no robot; {_EXPECTED}")
        for what, values in (
            ("name", [r.name for r in self.robots]),
            ("bundle", [r.bundle for r in self.robots]),
        ):
            value, times = Counter(values).most_common(1)[0]
            if times > 1:
                raise ValueError(
                    f"{where}{times} robots have the {what} {value!r}; each needs its own"
                )

    def __len__(self) -> int:
        return len(self.robots)

    def __str__(self) -> str:
        return f"{len(self.robots)} robots" + (f" of {self.source}" if self.source else "")

    def paths(self) -> list[str]:
        """Return the bundles and the recordings that are there."""
        found = [robot.bundle for robot in self.robots]
        for robot in self.robots:
            with suppress(FileNotFoundError):
                found += robot.paths()
        return found

    @classmethod
    def read(cls, path: str | Path) -> Fleet:
        """Read a list of robots; paths in it are relative to the file.

        As entries::

            [[robots]]
            name = "r001"
            bundle = "r001/robot.bundle"
            recordings = ["r001/today/*.npz"]   # or one string: a file, a folder, a pattern
            tags = ["hall 3"]                   # optional
            commissioned = 2025-03-01           # optional: faults by age

        or by a pattern, where the text matched by the stars is the robot's name; ``{bundle_dir}``
        is the folder that holds the bundle, ``{name}`` the robot's name::

            bundles = "robots/*/robot.bundle"
            recordings = "{bundle_dir}/recordings"

        Raises:
            OSError: the file cannot be read.
            ValueError: it is no file or not TOML, a key is missing, unknown or of the wrong type,
                or robots are not distinct.
        """
        path = Path(path)
        try:
            check_file(path)
            listed = tomllib.loads(path.read_text(encoding="utf-8"))
        except InputError:
            raise
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: not a TOML file ({error})") from None
        _known(listed, _LISTING, str(path))
        entries = listed.get("robots", [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ValueError(f"{path}: `robots` is not an array of tables; {_EXPECTED}")
        home = path.resolve().parent
        robots = [_robot(entry, home, f"{path}, robot {i}") for i, entry in enumerate(entries, 1)]
        if "bundles" in listed:
            robots += _matching(listed, home, path)
        elif "recordings" in listed or "tags" in listed:
            raise ValueError(
                f"{path}: `recordings` and `tags` outside [[robots]] need `bundles`; {_EXPECTED}"
            )
        return cls(tuple(robots), str(path))


def _robot(entry: Mapping[str, Any], home: Path, where: str) -> Robot:
    name = _text(entry, "name", where)
    where = f"{where} ({name!r})"
    _known(entry, _ENTRY, where)
    bundle = _text(entry, "bundle", where)
    recordings = _texts(entry, "recordings", where)
    if not recordings:
        raise ValueError(
            f"{where}: `recordings` is missing or empty; name a file, a folder or a pattern"
        )
    commissioned = entry.get("commissioned")
    if commissioned is not None and not isinstance(commissioned, date):
        raise ValueError(
            f"{where}: `commissioned` is {commissioned!r}; expected a date as 2025-03-01, without"
            " quotes"
        )
    day = commissioned.date() if isinstance(commissioned, datetime) else commissioned
    return Robot(
        name,
        os.path.normpath(home / bundle),
        tuple(_pattern(home, pattern) for pattern in recordings),
        _texts(entry, "tags", where),
        None if day is None else day.isoformat(),
    )


def _matching(listed: Mapping[str, Any], home: Path, path: Path) -> Iterator[Robot]:
    """Yield the robots whose bundles match the pattern, sorted."""
    pattern = _text(listed, "bundles", str(path))
    recordings = _texts(listed, "recordings", str(path))
    if not recordings:
        raise ValueError(
            f'{path}: `bundles` needs `recordings`, as recordings = "{{bundle_dir}}/recordings"'
        )
    found = sorted(glob.glob(pattern, root_dir=home, recursive=True))
    if not found:
        raise ValueError(f"{path}: no bundle matches {pattern}")
    for fitting in found:
        bundle = os.path.normpath(home / fitting)
        name = _name(fitting, pattern)
        values = {"bundle_dir": glob.escape(os.path.dirname(bundle)), "name": glob.escape(name)}
        try:
            filled = tuple(_pattern(home, _filled(text, values)) for text in recordings)
        except ValueError:
            known = "expected only {bundle_dir} and {name} in braces"
            raise ValueError(f"{path}: `recordings` is {list(recordings)}; {known}") from None
        yield Robot(name, bundle, filled, _texts(listed, "tags", str(path)))


def _filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text with the values in place of their names in braces.

    Raises:
        ValueError: other names, attributes of values, formats, or a brace alone.
    """
    for _, field, form, conversion in Formatter().parse(text):
        if field is not None and (field not in values or form or conversion):
            raise ValueError(f"{{{field}}} is no name of a value")
    return text.format(**values)


def _name(bundle: str, pattern: str) -> str:
    """Return the text matched by the stars; with a ``**``, everything from the first star on."""
    parts = Path(bundle).parts
    stars = Path(pattern).parts
    if "**" in stars:
        kept = parts[next(i for i, part in enumerate(stars) if glob.has_magic(part)) :]
    else:
        kept = (
            tuple(part for part, star in zip(parts, stars, strict=True) if glob.has_magic(star))
            or parts[-1:]
        )
    return "/".join(kept).removesuffix(".bundle")


def _pattern(home: Path, pattern: str) -> str:
    # A star in the name of the list's own folder is literal.
    return os.path.normpath(
        pattern if os.path.isabs(pattern) else os.path.join(glob.escape(str(home)), pattern)
    )


def _known(table: Mapping[str, Any], keys: set[str], where: str) -> None:
    if unknown := sorted(set(table) - keys):
        raise ValueError(
            f"{where}: unknown key {', '.join(unknown)}; expected {', '.join(sorted(keys))}"
        )


def _text(table: Mapping[str, Any], key: str, where: str) -> str:
    if key not in table:
        raise ValueError(f"{where}: `{key}` is missing")
    if not isinstance(table[key], str) or not table[key]:
        raise ValueError(f"{where}: `{key}` is {table[key]!r}; expected text")
    return str(table[key])


def _texts(table: Mapping[str, Any], key: str, where: str) -> tuple[str, ...]:
    value = table.get(key, [])
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not all(isinstance(text, str) and text for text in texts):
        raise ValueError(f"{where}: `{key}` is {value!r}; expected text or a list of texts")
    return tuple(texts)
