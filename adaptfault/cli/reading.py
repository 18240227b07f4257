"""The options that describe an array and its recordings, and how these are read."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import Command, argument, option
from adaptfault.cli.paths import Read

if TYPE_CHECKING:
    from adaptfault.data.recordings import Loaded, Opened, Recordings
    from diagnostics import SensorLayout

_PLACES = ("key", "topic", "field", "columns", "ignore", "time_column", "label_column")
"""Options that say where the readings are in a file."""

_RECORDINGS = (
    "file or folder of recordings: CSV and other text, NPZ, NPY, ROS 2 bags, LeRobot, Zarr, HDF5,"
    " netCDF, MAT, Parquet, JSON lines"
)


def _described(help: str, metavar: str, **how: Any) -> Any:
    """Return an option that describes an array or its recordings."""
    return option(help, metavar, section="array_section", describes=True, **how)


class Array(Command):
    """The options that describe the array."""

    array_section = "the array"

    layout: Read | None = _described(
        "layout of the array, its wiring and direction of load: a JSON or TOML file", "FILE"
    )
    shape: str | None = _described(
        "shape: pads x rows x columns, as 2x13x6; 10x10 is one pad", "PxRxC"
    )
    full_scale: float | None = _described("largest value a cell can report", "X")
    unit: str | None = _described("unit of the recordings, as N or count", "U")
    rate: float | None = _described("frames per second", "HZ")

    def stated_layout(
        self, *, full_scale: float | None = None, unit: str | None = None
    ) -> SensorLayout:
        """Return the array that the options describe, the paper's where they state nothing.

        Args:
            full_scale, unit: used where the options state none.

        Raises:
            ValueError: the options make no layout, or state it twice.
        """
        from adaptfault.data.recordings.facts.resolve import given_array
        from diagnostics import SensorLayout

        array = given_array(self._array()) or SensorLayout.paper()
        layout = array if isinstance(array, SensorLayout) else SensorLayout(*array)
        stated: dict[str, Any] = {
            "full_scale": full_scale if self.full_scale is None else self.full_scale,
            "unit": unit if self.unit is None else self.unit,
            "rate": self.rate,
        }
        known = {name: value for name, value in stated.items() if value is not None}
        return replace(layout, **known)

    def _array(self) -> str | tuple[int, int, int] | None:
        """Return the file of the layout or the shape that the options state.

        Raises:
            ValueError: both are given, or the shape is none.
        """
        from adaptfault.data.recordings.facts.layout_file import parse_shape

        if self.layout and self.shape:
            raise ValueError("--layout and --shape both given: one of them is enough")
        return self.layout if self.shape is None else parse_shape(self.shape)


class CalibratedArray(Array):
    """An array whose readings a table may convert."""

    array_section = "how recordings are read"

    calibration: Any = _described(
        "CSV table cell,raw,force: raw counts to newtons", "TABLE", type=Read
    )


class Reading(CalibratedArray):
    """The paths of recordings, and how they are read.

    Attributes:
        takes_labels, takes_targets: whether classes, and values of a regression, matter.
    """

    takes_labels = True
    takes_targets = False
    reads = True

    recordings: list[Read] = argument(_RECORDINGS, "RECORDINGS", describes=True)
    labels: Read | None = _described(
        "CSV table with the columns file,label", "TABLE", if_="takes_labels"
    )
    key: str | None = _described(
        "arrays of a data set that hold the readings, one a pad, as tactile_left,tactile_right or"
        " 'observation.tactile.*'",
        "NAME",
    )
    targets: Read | None = _described(
        "for a regression: CSV table with the columns file and one for each value, or file,frame"
        " and one for each value",
        "TABLE",
        if_="takes_targets",
    )
    topic: str | None = _described(
        "topics of a bag that hold the readings, one a pad: names or patterns as '/tactile/*'",
        "NAMES",
    )
    field: str | None = _described(
        "array in its messages that holds them, as data or sensors.values", "PATH"
    )
    columns: str | None = _described(
        "columns of a text file that hold the readings: names, patterns, or numbers as 2-33",
        "NAMES",
    )
    ignore: str | None = _described("columns that hold none, in this form", "NAMES")
    time_column: str | None = _described("column, feature or array of times", "NAME")
    label_column: str | None = _described(
        "column, feature or array of the class: the most frequent value is that of the recording",
        "NAME",
    )
    frames: int | None = _described("refuse recordings of another length", "T")

    def load(
        self,
        paths: Sequence[str],
        *,
        labelled: bool = False,
        layout: SensorLayout | None = None,
    ) -> Recordings:
        """Read recordings as the options state; problems and inferred facts go to stderr.

        Args:
            paths: files and folders.
            labelled: whether labels are required.
            layout: the layout that the recordings must have, as a model's; options and files may
                not contradict it.

        Raises:
            ValueError: nothing could be read, labels are required and missing, or an option
                contradicts ``layout``.
        """
        loaded = self.load_whole(paths, layout)
        self.say_inferred(loaded.inferred)
        recordings = loaded.recordings
        if labelled and recordings.labels is None and recordings.targets is None:
            raise ValueError(
                f"{paths[0]}: the recordings have no labels; give --labels TABLE, one folder for"
                " each class, or labels in the .npz; --targets TABLE for a regression"
            )
        return recordings

    def load_whole(self, paths: Sequence[str], layout: SensorLayout | None = None) -> Loaded:
        """Read recordings as :meth:`load`; only the problems are printed."""
        from adaptfault.data.recordings import load

        loaded = load(
            paths,
            frames=self.frames,
            labels=self.labels,
            targets=self.targets,
            **self._options_of_load(layout),
        )
        self.tell_problems(loaded.problems)
        return loaded

    def open(
        self,
        paths: Sequence[str],
        layout: SensorLayout | None = None,
        select: Callable[[int], Iterable[int]] | None = None,
    ) -> Opened:
        """Open recordings of any size, as the options state; the problems found so far are printed.

        Args:
            paths: files and folders.
            layout: as for :meth:`load`.
            select: as for ``adaptfault.data.recordings.open_recordings``.

        Raises:
            ValueError: nothing could be read, or an option contradicts ``layout``.
        """
        from adaptfault.data.recordings import open_recordings

        with self._bar() as advance:
            opened = open_recordings(
                paths, progress=advance, select=select, **self.how_to_open(layout)
            )
        self.tell_problems(opened.problems)
        return opened

    def how_to_open(self, layout: SensorLayout | None = None) -> dict[str, Any]:
        """Return what the options state, as ``adaptfault.data.recordings.open_recordings`` takes
        it; ``layout`` as for :meth:`load`."""
        options = {"labels": self.labels, "frames": self.frames}
        return {**options, **self._options_of_load(layout)}

    @contextmanager
    def _bar(self) -> Iterator[Callable[[int], None]]:
        """Show the frames that are read; it is called with the number of more frames."""
        if self.quiet or not sys.stderr.isatty():
            yield lambda frames: None
            return
        from tqdm import tqdm

        with tqdm(unit="frame", desc="reading", leave=False, unit_scale=True) as bar:

            def advance(frames: int) -> None:
                bar.update(frames)

            yield advance

    def _options_of_load(self, layout: SensorLayout | None) -> dict[str, Any]:
        """Return how recordings are read, as :func:`adaptfault.load` takes it; where the layout is
        known, after a check that no option contradicts it."""
        places = {name: getattr(self, name) for name in ("calibration", *_PLACES)}
        if layout is not None:
            self._check_agreement(layout)
            return {**places, "layout": layout, "strict": True}
        stated = {name: getattr(self, name) for name in ("full_scale", "unit", "rate")}
        return {**places, **stated, "layout": self._array()}

    def _check_agreement(self, layout: SensorLayout) -> None:
        """Raise ValueError where an option contradicts the layout."""
        from adaptfault.data.recordings.facts.resolve import given_array, same_rate
        from diagnostics import SensorLayout

        array = given_array(self._array())
        shape = array.shape if isinstance(array, SensorLayout) else array
        if shape is not None and shape != layout.shape:
            raise ValueError(
                f"--shape or --layout gives {' x '.join(map(str, shape))} cells, expected {layout}"
            )
        if self.full_scale is not None and self.full_scale != layout.full_scale:
            raise ValueError(
                f"--full-scale {self.full_scale:g} given, expected {layout.full_scale:g}"
                f" {layout.unit}"
            )
        if self.rate is not None and not same_rate(self.rate, layout.rate):
            raise ValueError(f"--rate {self.rate:g} given, expected {layout.rate:g} Hz")


def perhaps_recordings() -> Any:
    """Return the argument of recordings that may be left out."""
    return argument(_RECORDINGS, "RECORDINGS", describes=True, nargs="*")


def recordings_option() -> Any:
    """Return recordings as an option."""
    return option(_RECORDINGS, "FILE", describes=True, default=[])


def report_range(opened: Opened) -> None:
    """Print what the last reading of recordings found, after their problems were printed."""
    for problem in opened.late_problems:
        print(problem, file=sys.stderr)
