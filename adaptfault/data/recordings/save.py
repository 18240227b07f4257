"""Writes recordings in every format that :func:`adaptfault.load` reads."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.layout_file import LAYOUT_NAME
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.npz import save_npz
from adaptfault.data.recordings.recording import DECLARED
from diagnostics import SensorLayout

FORMATS = ".npz, .npy, .bag (a ROS 2 bag) or a folder of CSV files"

_TOPIC = "/tactile"
_KIND = "std_msgs/msg/Float32MultiArray"
_PAUSE = 5.0  # seconds between two recordings in a bag, which separate them
_BEGIN = 1_700_000_000  # unix time of the first message: a bag needs one, recordings have none


def save(
    path: str | PathLike[str], recordings: Recordings, *, times: bool = False
) -> tuple[str, ...]:
    """Write recordings in the format that the name ends in: ``.npz``, ``.npy``, ``.bag``; without
    an ending, CSV files.

    An archive (``.npz``) holds everything but the targets of a regression. An array (``.npy``)
    holds the frames alone, ``[n, T, pads, rows, cols]``, and needs recordings of one length. CSV
    files lie in one folder a class, with ``layout.json`` beside them. A bag holds one
    ``Float32MultiArray`` a frame on ``/tactile``, recordings separated by pauses.

    Args:
        path: the file, or the folder of CSV files.
        recordings: what to write.
        times: CSV files begin with a header and a column ``time_ms`` of whole milliseconds.

    Returns:
        What the format cannot hold, one item each.

    Raises:
        InputError: another ending, no recordings, lengths that differ (``.npy``), rosbags is
            missing (``.bag``), or ``times`` where no CSV files are written.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if not len(recordings):
        raise InputError.at(path, "there are no recordings to save; give at least one")
    if times and path.suffix:
        raise InputError.at(path, "only CSV files have times to write; name a folder")
    lost: tuple[str, ...] = () if recordings.targets is None else ("the targets of a regression",)
    if path.suffix.lower() in (".npy", ".bag") and set(DECLARED) & set(recordings.layout.to_dict()):
        lost = ("wiring, groups, axes, rest and device", *lost)
    match path.suffix.lower():
        case ".npz":
            save_npz(path, recordings)
            return lost
        case ".npy":
            return (*_save_npy(path, recordings), *lost)
        case ".bag":
            return (*_save_bag(path, recordings), *lost)
        case "":
            return (*_save_csv(path, recordings, times), *lost)
        case _:
            raise InputError.at(path, f"recordings are saved as {FORMATS}; choose another name")


def _save_npy(path: Path, recordings: Recordings) -> tuple[str, ...]:
    lengths = {len(frames) for frames in recordings}
    if len(lengths) > 1:
        what = (
            f"recordings of {min(lengths)} to {max(lengths)} frames do not fit one array; save them"
            " as .npz"
        )
        raise InputError.at(path, what)
    buffer = io.BytesIO()
    np.save(buffer, recordings.layout.grid(np.stack(recordings.frames)), allow_pickle=False)
    atomic_write(path, buffer.getvalue())
    return ("full scale, unit and rate", "masked positions", "labels", "names")


def _save_csv(path: Path, recordings: Recordings, times: bool) -> tuple[str, ...]:
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise InputError.at(path, "the folder is not empty; choose another name")
    atomic_write(path / LAYOUT_NAME, json.dumps(recordings.layout.to_dict(), indent=1).encode())
    digits = len(str(len(recordings) - 1))
    folders = _folders(recordings.class_names)
    for i, frames in enumerate(recordings):
        folder = path
        if recordings.labels is not None:
            folder = path / folders[int(recordings.labels[i])]
            folder.mkdir(exist_ok=True)
        rows = [",".join(map(_written, row)) for row in frames.tolist()]
        if times:
            rows = _timed(rows, recordings.layout)
        text = "".join(f"{row}\n" for row in rows)
        atomic_write(folder / f"{i:0{digits}d}.csv", text.encode())
    return ("names",)


def _timed(rows: list[str], layout: SensorLayout) -> list[str]:
    """Return a header, and the rows behind their times in whole milliseconds."""
    header = ",".join(["time_ms", *(f"cell{cell}" for cell in range(layout.n_cells))])
    period = 1000 / layout.rate
    return [header, *(f"{round(i * period)},{row}" for i, row in enumerate(rows))]


def _written(value: float) -> str:
    """Return a float32 as the shortest text that is read back as the same number; a missing reading
    is empty."""
    return "" if value != value else f"{value:.9g}"


def _folders(names: Sequence[str]) -> list[str]:
    """Return the name of a folder for each class; those that differ only in what no folder may be
    called, or in case, are numbered."""
    folders: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = re.sub(r"[^\w. +-]", "_", name).strip(". ") or "_"
        folder = plain
        number = 2
        while folder.casefold() in taken:
            folder = f"{plain} {number}"
            number += 1
        taken.add(folder.casefold())
        folders.append(folder)
    return folders


def _save_bag(path: Path, recordings: Recordings) -> tuple[str, ...]:
    what = "bags are written with rosbags; install it: pip install 'adaptfault[ros]'"
    rosbag2 = imported("rosbags.rosbag2", path, what)
    typesys = imported("rosbags.typesys", path, what)
    if path.exists():
        raise InputError.at(path, "exists; choose another name")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kinds = store.types
    sizes = recordings.layout.shape
    dim = kinds["std_msgs/msg/MultiArrayDimension"]
    strides = [int(np.prod(sizes[i:])) for i in range(3)]
    dims = [
        dim(label=n, size=s, stride=t)
        for n, s, t in zip(("pad", "row", "column"), sizes, strides, strict=True)
    ]
    about = kinds["std_msgs/msg/MultiArrayLayout"](dim=dims, data_offset=0)
    period = round(1e9 / recordings.layout.rate)
    at = _BEGIN * 10**9
    mcap = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(path, version=8, storage_plugin=mcap) as writer:  # Humble rejects version 9
        connection = writer.add_connection(_TOPIC, _KIND, typestore=store)
        for frames in recordings:
            for frame in frames:
                message = kinds[_KIND](layout=about, data=np.asarray(frame, np.float32))
                writer.write(connection, at, store.serialize_cdr(message, _KIND))
                at += period
            at += max(round(_PAUSE * 1e9), 10 * period)
    return ("full scale and unit", "masked positions", "labels", "names")
