"""Records frames as CSV files; a power cut loses at most the last second."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.atomic import atomic_write, make_folder, sync
from adaptfault.data.recordings.facts.layout_file import read_layout
from diagnostics import Scan, SensorLayout

INTERVAL = 1.0
"""Seconds between two syncs to the disk: the most that a power cut loses."""

LONGEST = 3600.0
"""Seconds after which a recording continues in a new file."""

# seconds; lost frames up to that are written as missing readings, a longer pause begins a new
# recording
_GAP = 1.0


@dataclass(frozen=True)
class Recorded:
    """A recording that is complete and on the disk."""

    path: Path
    frames: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.path}: {self.frames} frames, {self.seconds:.1f} s"


class Recorder:
    """Writes the frames of one device as CSV recordings into a folder, which
    :func:`adaptfault.load` reads.

    One frame per line, one cell per column, no header; lost frames become lines of missing
    readings. Each line is written at once and synced every ``interval`` seconds by a thread, so the
    caller does not wait for the disk.
    :func:`adaptfault.load` reads a truncated file up to its last complete line. ``layout.json``
    holds the layout.

    Args:
        folder: created where missing.
        layout: the array.
        device: prefix of the file names.
        longest: seconds after which a new file begins.
        interval: seconds between two syncs.

    Raises:
        ValueError: the folder holds recordings of another layout.
        OSError: the folder cannot be created or written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        layout: SensorLayout,
        device: str = "frames",
        *,
        longest: float = LONGEST,
        interval: float = INTERVAL,
    ) -> None:
        self.folder = Path(folder)
        self.layout = layout
        self.device = device
        self.longest = longest
        self.interval = interval
        make_folder(self.folder)
        try:
            _write_layout(self.folder / "layout.json", layout)
        except OSError as error:
            # a full disk may have room when the first recording begins
            if error.errno != errno.ENOSPC:
                raise
        self._file: TextIO | None = None
        self._path = self.folder
        self._first = self._last = 0.0
        self._frames = 0
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="recorder")
        self._syncing: Future[None] | None = None
        self._synced = 0.0

    @property
    def path(self) -> Path | None:
        """The file that is being written, if any."""
        return None if self._file is None else self._path

    def write(self, values: ArrayLike, at: float) -> Recorded | None:
        """Append a frame ``[D]`` taken at ``at`` (seconds, increasing); open a file where none is
        open.

        Returns:
            The recording that ended before this frame, because of a pause or its length; None
            otherwise.

        Raises:
            ValueError: the frame has another size.
            OSError: the disk is full or missing; the file is closed.
        """
        frame = np.asarray(values, dtype=np.float64).ravel()
        if frame.size != self.layout.n_cells:
            raise ValueError(
                f"expected a frame of {self.layout.n_cells} readings ({self.layout}), got"
                f" {frame.size}"
            )
        ended = None
        if self._file is not None and (
            at - self._last > _GAP + 1 / self.layout.rate or at - self._first > self.longest
        ):
            ended = self.close()
        try:
            file = self._file or self._open(at)
            lost = max(0, round((at - self._last) * self.layout.rate) - 1)
            file.write((",".join(["nan"] * frame.size) + "\n") * lost + _line(frame))
            file.flush()
            self._sync(file)
        except OSError:
            self._abandon()
            raise
        self._frames += lost + 1
        self._last = at
        return ended

    def close(self) -> Recorded | None:
        """End the recording and sync it to the disk. None where nothing is being recorded."""
        file = self._file
        self._file = None
        if file is None:
            return None
        with file:
            self._settle()
            os.fsync(file.fileno())
        return Recorded(self._path, self._frames, self._last - self._first + 1 / self.layout.rate)

    def write_scan(self, scan: Scan) -> Path:
        """Write a scan of the read-out into a file of its own: a column ``scan``, and one a cell.

        Raises:
            OSError: the file cannot be written.
        """
        began = datetime.now(timezone.utc)
        stem = f"{self.device.replace(':', '-')}_{began:%Y%m%dT%H%M%S_%f}_scan.csv"
        names = [f"c{i}" for i in range(scan.readings.shape[1])]
        rows = np.column_stack([scan.levels, scan.readings])
        text = ",".join(["scan", *names]) + "\n" + "".join(map(_line, rows))
        atomic_write(self.folder / stem, text.encode("ascii"))
        return self.folder / stem

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        finally:
            self._disk.shutdown()

    def _open(self, at: float) -> TextIO:
        _write_layout(self.folder / "layout.json", self.layout)
        began = datetime.now(timezone.utc)
        number = 0
        while True:  # after the clock is set back a name may exist already
            number += 1
            name = f"{self.device.replace(':', '-')}_{began:%Y%m%dT%H%M%S}_{number}.csv"
            try:
                self._file = open(self.folder / name, "x", encoding="ascii", newline="\n")  # noqa: SIM115
                break
            except FileExistsError:
                continue
        self._path = self.folder / name
        self._first = at
        self._last = at
        self._frames = 0
        self._synced = time.monotonic()
        self._syncing = self._disk.submit(sync, self.folder)
        return self._file

    def _sync(self, file: TextIO) -> None:
        now = time.monotonic()
        if now - self._synced >= self.interval and (self._syncing is None or self._syncing.done()):
            self._settle()
            self._synced = now
            self._syncing = self._disk.submit(os.fsync, file.fileno())

    def _settle(self) -> None:
        """Wait for the running sync and raise its error."""
        waiting = self._syncing
        self._syncing = None
        if waiting is not None:
            waiting.result()

    def _abandon(self) -> None:
        file = self._file
        self._file = None
        if file is not None:
            with contextlib.suppress(OSError):  # close repeats the failed write
                file.close()


def _line(frame: NDArray[np.float64]) -> str:
    return ",".join([f"{value:.9g}" for value in frame.tolist()]) + "\n"


def _write_layout(path: Path, layout: SensorLayout) -> None:
    if path.exists():
        if (there := read_layout(path)) != layout:
            raise ValueError(
                f"{path.parent} holds recordings of {there}, not of {layout}; record into another"
                " folder"
            )
        return
    atomic_write(path, json.dumps(layout.to_dict(), allow_nan=False).encode())
