"""Writes a copy of a LeRobot data set whose frames say which readings of touch are valid."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, foreseeing
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import VALID
from adaptfault.data.recordings.formats.datasets.statistics import Statistics, of_masks
from adaptfault.data.recordings.formats.datasets.valid_rows import ValidRows
from adaptfault.data.recordings.valid import column_of

_EPISODE = "episode_index"
_INFO = "meta/info.json"
_STATS = "meta/stats.json"
_EPISODE_LINES = "meta/episodes_stats.jsonl"  # version 2.1
_NO_JSON = "is no JSON of statistics; write them again, or leave the file out"

Of = dict[str, Statistics]  # by feature


def write(place: Path, source: Path, rows: ValidRows) -> None:
    """Write a copy into a folder.

    Args:
        place: the folder of the copy.
        source: of the data set.
        rows: which readings are valid.

    Raises:
        InputError: an episode has another number of rows than of frames.
        OSError: a file cannot be read or written.
    """
    data = sorted(source.glob("data/**/*.parquet"), key=lambda file: natural_key(str(file)))
    shutil.copytree(source, place, dirs_exist_ok=True, ignore=_ignoring(source, data))
    of_all: Of = {}
    of_each: dict[int, Of] = {}
    for file in data:
        copy = place / file.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        write_table(copy, file, rows, of_all, of_each)
    _write_info(place, rows)
    _write_stats(place, of_all)
    _write_episodes(place, of_each)


def write_table(
    place: Path,
    source: Path,
    rows: ValidRows,
    of_all: Of | None = None,
    of_each: dict[int, Of] | None = None,
) -> None:
    """Write a copy of a table, row group by row group, with a column ``<feature>.valid`` for each
    feature.

    Args:
        place: of the copy.
        source: the table.
        rows: which readings are valid.
        of_all, of_each: statistics that take in the readings, of all and of each episode.
    """
    with foreseeing(source):
        _write_groups(place, source, rows, of_all, of_each)


def _write_groups(
    place: Path,
    source: Path,
    rows: ValidRows,
    of_all: Of | None,
    of_each: dict[int, Of] | None,
) -> None:
    pa = imported("pyarrow", source)
    parquet = imported("pyarrow.parquet", source)
    with parquet.ParquetFile(source) as file:
        names = file.schema_arrow.names
        column = next((name for name in names if name == _EPISODE), None)
        episodes = None
        if column is not None:
            episodes = file.read([column])[column].to_numpy().astype(np.int64)
        masks = rows.of(episodes, file.metadata.num_rows)
        about = file.metadata
        kind = about.row_group(0).column(0).compression if about.num_row_groups else "SNAPPY"
        writer = None
        first = 0
        for group in range(about.num_row_groups):
            table = file.read_row_group(group)
            part = slice(first, first + len(table))
            for name, mask in zip(rows.features, masks, strict=True):
                readings = table[name]
                table = table.append_column(f"{name}{VALID}", column_of(pa, mask[part]))
                if of_all is not None and of_each is not None and episodes is not None:
                    values = _numbers(readings, mask[part].shape)
                    _take(of_all, of_each, name, values, mask[part], episodes[part])
            writer = writer or parquet.ParquetWriter(place, table.schema, compression=kind)
            writer.write_table(table)
            first = part.stop
        if writer is not None:
            writer.close()


def _numbers(column: Any, sizes: tuple[int, ...]) -> NDArray[Any]:
    """Return a column of lists as an array."""
    flat = column.combine_chunks()
    while hasattr(flat, "flatten") and flat.type.num_fields:
        flat = flat.flatten()
    return np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64).reshape(sizes)


def _take(
    of_all: Of,
    of_each: dict[int, Of],
    name: str,
    readings: NDArray[Any],
    valid: NDArray[np.bool_],
    episodes: NDArray[np.int64],
) -> None:
    """Take frames into the statistics of a feature and of its mask."""
    sizes = readings.shape[1:]
    for number in np.unique(episodes).tolist():
        at = episodes == number
        for held in (of_all, of_each.setdefault(number, {})):
            held.setdefault(name, Statistics(sizes)).add(readings[at], valid[at])
            masks = held.setdefault(f"{name}{VALID}", Statistics(sizes))
            masks.add(valid[at], np.ones_like(valid[at]))


def _ignoring(source: Path, files: list[Path]) -> Any:
    """Return what leaves out the files that are written anew."""
    left = {file.relative_to(source) for file in files}

    def ignored(folder: str, names: list[str]) -> list[str]:
        within = Path(folder).relative_to(source)
        return [name for name in names if within / name in left]

    return ignored


def _write_info(place: Path, rows: ValidRows) -> None:
    path = place / _INFO
    info = json.loads(path.read_text("utf-8"))
    features = info["features"]
    for name in rows.features:
        features[f"{name}{VALID}"] = {**features[name], "dtype": "bool"}
    path.write_text(json.dumps(info, indent=4, ensure_ascii=False), "utf-8")


def _write_stats(place: Path, of_all: Of) -> None:
    """Write the statistics of the whole data set, where it has some."""
    path = place / _STATS
    if not path.is_file():
        return
    try:
        told = json.loads(path.read_text("utf-8"))
    except ValueError:
        raise InputError.at(path, _NO_JSON) from None
    path.write_text(json.dumps(_told(told, of_all), indent=4), "utf-8")


def _told(told: Mapping[str, Any], held: Of) -> dict[str, Any]:
    """Return the statistics of features with those of touch anew."""
    new = dict(told)
    for name, statistics in held.items():
        if name.endswith(VALID):
            new[name] = of_masks(statistics)
        elif isinstance(told.get(name), Mapping):
            new[name] = statistics.as_told(told[name])
    return new


def _write_episodes(place: Path, of_each: dict[int, Of]) -> None:
    """Write the statistics of each episode, where the data set has some."""
    lines = place / _EPISODE_LINES
    if lines.is_file():
        written = []
        for line in lines.read_text("utf-8").splitlines():
            try:
                about = json.loads(line)
                held = of_each.get(about[_EPISODE], {})
                stats = _told(about["stats"], held)
            except (ValueError, KeyError, TypeError):
                raise InputError.at(lines, _NO_JSON) from None
            written.append(json.dumps({**about, "stats": stats}))
        lines.write_text("\n".join(written) + "\n", "utf-8")
    for path in sorted((place / "meta/episodes").glob("**/*.parquet")):
        _write_episode_table(path, of_each)


def _write_episode_table(path: Path, of_each: dict[int, Of]) -> None:
    pa = imported("pyarrow", path)
    parquet = imported("pyarrow.parquet", path)
    table = parquet.read_table(path)
    numbers = table[_EPISODE].to_pylist()
    for place, field in enumerate(table.schema):
        _, _, rest = field.name.partition("stats/")
        name, _, which = rest.rpartition("/")
        if not any(name in held for held in of_each.values()):
            continue
        values = table[field.name].to_pylist()
        for row, number in enumerate(numbers):
            if values[row] is not None and name in of_each.get(number, {}):
                values[row] = of_each[number][name].as_told({which: values[row]})[which]
        table = table.set_column(place, field, pa.array(values, type=field.type))
    parquet.write_table(table, path)
