"""Options that several commands share."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from adaptfault.cli.paths import Read, Written
from adaptfault.cli.streams import tell
from adaptfault.data.printable import printable

if TYPE_CHECKING:
    from adaptfault.data.recordings import Loaded, Opened, Problem, Recordings
    from adaptfault.data.summary import Summary
    from diagnostics import Diagnosis, FaultSet, SelfDiagnosis, SensorLayout
    from diagnostics.when.reference_findings import ReferenceFinding

Commands = Any  # argparse's private type of subparsers

_PLACES = ("key", "topic", "field", "columns", "ignore", "time_column", "label_column")
"""Options that say where the readings are in a file."""


def command(commands: Commands, name: str, summary: str, example: str) -> argparse.ArgumentParser:
    """Add a command whose ``--help`` ends with an example, and the option ``--json``."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example:\n{example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    return parser


def add_recordings(
    parser: argparse.ArgumentParser,
    *,
    option: bool = False,
    labels: bool = True,
    least: int = 1,
    targets: bool = False,
) -> None:
    """Add the paths of recordings, as ``least`` arguments or as an ``option``, and how they are
    read; ``targets``: models of values, too, learn from them."""
    help_ = (
        "file or folder of recordings: CSV and other text, NPZ, NPY, ROS 2 bags, LeRobot, Zarr,"
        " HDF5, netCDF, MAT, Parquet, JSON lines"
    )
    if option:
        parser.add_argument("--recordings", type=Read, nargs="+", metavar="FILE", help=help_)
    else:
        parser.add_argument(
            "recordings", type=Read, nargs="+" if least else "*", metavar="RECORDINGS", help=help_
        )
    group = add_array(parser)
    if labels:
        group.add_argument(
            "--labels", type=Read, metavar="TABLE", help="CSV table with the columns file,label"
        )
    group.add_argument(
        "--key",
        metavar="NAME",
        help="arrays of a data set that hold the readings, one a pad, as tactile_left,tactile_right"
        " or 'observation.tactile.*'",
    )
    if targets:
        group.add_argument(
            "--targets",
            type=Read,
            metavar="TABLE",
            help=(
                "for a regression: CSV table with the columns file and one for each value, or"
                " file,frame and one for each value"
            ),
        )
    group.add_argument(
        "--topic",
        metavar="NAMES",
        help="topics of a bag that hold the readings, one a pad: names or patterns as '/tactile/*'",
    )
    group.add_argument(
        "--field",
        metavar="PATH",
        help="array in its messages that holds them, as data or sensors.values",
    )
    group.add_argument(
        "--columns",
        metavar="NAMES",
        help="columns of a text file that hold the readings: names, patterns, or numbers as 2-33",
    )
    group.add_argument("--ignore", metavar="NAMES", help="columns that hold none, in this form")
    group.add_argument("--time-column", metavar="NAME", help="column, feature or array of times")
    group.add_argument(
        "--label-column",
        metavar="NAME",
        help="column, feature or array of the class: the most frequent value is that of the"
        " recording",
    )
    group.add_argument(
        "--frames", type=int, metavar="T", help="refuse recordings of another length"
    )


def add_untested_code(parser: argparse.ArgumentParser) -> None:
    """Add the exit code of a log that tests nothing."""
    parser.add_argument(
        "--untested-code",
        type=int,
        default=1,
        choices=range(4),
        metavar="CODE",
        help=(
            "exit code where no fault is found and less than 5 %% of the cells are tested"
            " (default 1)"
        ),
    )


def add_count_from(parser: argparse.ArgumentParser) -> None:
    """Add the number of the first pad, row and column."""
    parser.add_argument(
        "--count-from",
        type=int,
        default=0,
        choices=(0, 1),
        metavar="N",
        help=(
            "number of the first pad, row, column and cell in text, pages and pictures, 0 or 1"
            " (default 0; JSON counts from 0)"
        ),
    )


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """Add the file of metrics."""
    parser.add_argument(
        "--metrics",
        type=_metrics_file,
        metavar="FILE.prom",
        help="write metrics for Prometheus, as node_exporter's textfile collector reads them",
    )


def _metrics_file(text: str) -> Written:
    if not text.endswith(".prom"):
        what = "expected a name that ends in .prom: node_exporter reads no other"
        raise argparse.ArgumentTypeError(f"{what}; got {text!r}")
    return Written(text)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add whose signature a bundle needs."""
    group = parser.add_argument_group("signed bundles")
    group.add_argument(
        "--trust",
        type=Read,
        action="append",
        metavar="KEY",
        help="PEM file of a public ed25519 key that must have signed the bundle; may be repeated",
    )
    group.add_argument(
        "--least-serial",
        type=int,
        metavar="N",
        help="with --trust: smallest serial number of the signature",
    )


def add_sign(parser: argparse.ArgumentParser, when: str) -> None:
    """Add the key that signs a bundle."""
    parser.add_argument(
        "--sign", type=Read, metavar="KEY", help=f"sign {when} with this private ed25519 key (PEM)"
    )


def trust(args: argparse.Namespace) -> dict[str, Any]:
    """Return whose signature a bundle needs, as ``Bundle.open`` takes it; the key that signs is
    trusted, too.

    Raises:
        ValueError: a serial number without a key.
    """
    keys = list(args.trust or [])
    if args.least_serial is not None and not keys:
        raise ValueError("--least-serial needs --trust KEY")
    sign = getattr(args, "sign", None)
    if sign is not None:
        keys.append(sign)
    return {"keys": keys or None, "least_serial": args.least_serial or 0}


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option of the device that trains networks."""
    parser.add_argument(
        "--device", default="auto", help="auto, cpu or cuda (default auto: cuda where there is one)"
    )


def device(args: argparse.Namespace) -> str:
    """Return the device that networks are trained on.

    Raises:
        ValueError: there is no such device.
    """
    import torch

    name: str = args.device
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(
            f"--device {name}: {str(error).splitlines()[0]}; use auto, cpu or cuda"
        ) from None
    return name


def add_array(
    parser: argparse.ArgumentParser, *, calibration: bool = True
) -> argparse._ArgumentGroup:
    """Add the options that describe the array; returns their group."""
    group = parser.add_argument_group("how recordings are read" if calibration else "the array")
    group.add_argument(
        "--layout",
        type=Read,
        metavar="FILE",
        help="layout of the array, its wiring and direction of load: a JSON or TOML file",
    )
    group.add_argument(
        "--shape", metavar="PxRxC", help="shape: pads x rows x columns, as 2x13x6; 10x10 is one pad"
    )
    group.add_argument(
        "--full-scale", type=float, metavar="X", help="largest value a cell can report"
    )
    group.add_argument("--unit", metavar="U", help="unit of the recordings, as N or count")
    group.add_argument("--rate", type=float, metavar="HZ", help="frames per second")
    if calibration:
        group.add_argument(
            "--calibration",
            type=Read,
            metavar="TABLE",
            help="CSV table cell,raw,force: raw counts to newtons",
        )
    return group


def layout_of(
    args: argparse.Namespace, *, full_scale: float | None = None, unit: str | None = None
) -> SensorLayout:
    """Return the array that the options describe, the paper's where they state nothing.

    Args:
        args: the options of :func:`add_array`.
        full_scale, unit: used where the options state none.

    Raises:
        ValueError: the options make no layout, or state it twice.
    """
    from dataclasses import replace

    from adaptfault.data.recordings.facts.resolve import given_array
    from diagnostics import SensorLayout

    array = given_array(_array(args)) or SensorLayout.paper()
    layout = array if isinstance(array, SensorLayout) else SensorLayout(*array)
    stated = {
        "full_scale": full_scale if args.full_scale is None else args.full_scale,
        "unit": unit if args.unit is None else args.unit,
        "rate": args.rate,
    }
    return replace(layout, **{name: value for name, value in stated.items() if value is not None})


def load_recordings(
    args: argparse.Namespace,
    paths: Sequence[str],
    *,
    labelled: bool = False,
    layout: SensorLayout | None = None,
) -> Recordings:
    """Read recordings as the options state; problems and inferred facts go to stderr.

    Args:
        args: the options of :func:`add_recordings`.
        paths: files and folders.
        labelled: whether labels are required.
        layout: the layout that the recordings must have, as a model's; options and files may not
            contradict it.

    Raises:
        ValueError: nothing could be read, labels are required and missing, or an option contradicts
            ``layout``.
    """
    loaded = load_reported(args, paths, layout)
    report_inferred(args, loaded.inferred)
    recordings = loaded.recordings
    if labelled and recordings.labels is None and recordings.targets is None:
        raise ValueError(
            f"{paths[0]}: the recordings have no labels; give --labels TABLE, one folder for each"
            " class, or labels in the .npz; --targets TABLE for a regression"
        )
    return loaded.recordings


def load_reported(
    args: argparse.Namespace, paths: Sequence[str], layout: SensorLayout | None = None
) -> Loaded:
    """Read recordings as :func:`load_recordings`; only the problems are printed."""
    from adaptfault.data.recordings import load

    tables: dict[str, Any] = {name: getattr(args, name, None) for name in ("labels", "targets")}
    loaded = load(paths, frames=args.frames, **tables, **_options_of(args, layout))
    report_problems(args, loaded.problems)
    return loaded


def open_reported(
    args: argparse.Namespace, paths: Sequence[str], layout: SensorLayout | None = None
) -> Opened:
    """Open recordings of any size, as the options state; the problems found so far are printed.

    Args:
        args: the options of :func:`add_recordings`.
        paths: files and folders.
        layout: as for :func:`load_recordings`.

    Raises:
        ValueError: nothing could be read, or an option contradicts ``layout``.
    """
    from adaptfault.data.recordings import open_recordings

    with reading_bar(args) as advance:
        opened = open_recordings(
            paths,
            labels=getattr(args, "labels", None),
            frames=args.frames,
            progress=advance,
            **_options_of(args, layout),
        )
    report_problems(args, opened.problems)
    return opened


def summary_of(opened: Opened, inferred: Sequence[str] = ()) -> Summary:
    """Return what recordings hold, ``inferred`` facts of the array included."""
    from collections import Counter

    from adaptfault.data.summary import summarise

    classes = {}
    if opened.labels is not None:
        counts = Counter(opened.labels.tolist())
        classes = {name: counts[i] for i, name in enumerate(opened.class_names)}
    return summarise(
        opened.pieces(),
        opened.layout,
        lengths=opened.lengths,
        classes=classes,
        inferred=tuple(inferred),
        seconds=opened.seconds,
    )


def report_range(opened: Opened) -> None:
    """Print what the last reading of recordings found, after their problems were printed."""
    for problem in opened.late_problems:
        print(problem, file=sys.stderr)


def _options_of(args: argparse.Namespace, layout: SensorLayout | None) -> dict[str, Any]:
    """Return how recordings are read, as :func:`adaptfault.load` takes it."""
    if layout is None:
        return _array_options(args)
    return {**_agreeing(args, layout), "layout": layout, "strict": True}


def report_problems(args: argparse.Namespace, problems: Sequence[Problem]) -> None:
    """Print the problems; recordings that are left out make the exit code 1 at least."""
    for problem in problems:
        print(problem, file=sys.stderr)
    args.left_out = getattr(args, "left_out", 0) + sum(p.level == "error" for p in problems)


def report_inferred(args: argparse.Namespace, inferred: Sequence[str]) -> None:
    """Print on stderr what was inferred about the array."""
    for text in inferred:
        say(args, f"inferred: {text}")


def _array(args: argparse.Namespace) -> str | tuple[int, int, int] | None:
    """Return the file of the layout or the shape that the options state.

    Raises:
        ValueError: both are given, or the shape is none.
    """
    from adaptfault.data.recordings.facts.layout_file import parse_shape

    if args.layout and args.shape:
        raise ValueError("--layout and --shape both given: one of them is enough")
    layout: str | None = args.layout
    return layout if args.shape is None else parse_shape(args.shape)


def _array_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options that describe the array, as :func:`adaptfault.load` takes them."""
    names = ("calibration", "full_scale", "unit", "rate", *_PLACES)
    return {"layout": _array(args), **{name: getattr(args, name) for name in names}}


def _agreeing(args: argparse.Namespace, layout: SensorLayout) -> dict[str, Any]:
    """Return the options that remain where the layout is known, after a check that none contradicts
    it."""
    from adaptfault.data.recordings.facts.resolve import given_array, same_rate
    from diagnostics import SensorLayout

    options = _array_options(args)
    array = given_array(options["layout"])
    shape = array.shape if isinstance(array, SensorLayout) else array
    if shape is not None and shape != layout.shape:
        raise ValueError(
            f"--shape or --layout gives {' x '.join(map(str, shape))} cells, expected {layout}"
        )
    if args.full_scale is not None and args.full_scale != layout.full_scale:
        raise ValueError(
            f"--full-scale {args.full_scale:g} given, expected {layout.full_scale:g} {layout.unit}"
        )
    if args.rate is not None and not same_rate(args.rate, layout.rate):
        raise ValueError(f"--rate {args.rate:g} given, expected {layout.rate:g} Hz")
    return {name: options[name] for name in ("calibration", *_PLACES)}


def fault_set(text: str, layout: SensorLayout) -> FaultSet:
    """Read F: a diagnosis written by ``adaptfault diagnose --out``, or cell indices as ``3,17,200``
    ("" = none).

    Raises:
        ValueError: neither, or F is over another array.
    """
    from diagnostics import FaultSet

    try:
        cells = tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError:
        return _diagnosed(Path(text), layout)
    return FaultSet(cells, layout.n_cells)


def _diagnosed(path: Path, layout: SensorLayout) -> FaultSet:
    if not path.is_file():
        raise ValueError(f"--faults {path}: no such file, and not cell indices as 3,17,200")
    diagnosis = read_diagnosis(path)
    if diagnosis.layout.shape != layout.shape:
        raise ValueError(
            f"{path}: a diagnosis of {diagnosis.layout}, but the model is for {layout}"
        )
    return diagnosis.fault_set


def read_diagnosis(path: Path) -> Diagnosis:
    """Read a diagnosis that ``adaptfault diagnose --out`` wrote.

    Raises:
        ValueError: the file holds none.
    """
    from adaptfault.data.recordings.formats.text import read_json_object
    from diagnostics import Diagnosis

    try:
        return Diagnosis.from_dict(read_json_object(path))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: not a diagnosis ({error}); write one with adaptfault diagnose --out"
        ) from None


def progress(args: argparse.Namespace) -> bool | None:
    """Return whether progress is shown; None shows it on a terminal."""
    return False if args.quiet else None


def fit_diagnoser(
    args: argparse.Namespace, recordings: Recordings, *, told: bool = True
) -> SelfDiagnosis:
    """Return the healthy model of recordings, with a bar while it is fitted.

    With ``--reference`` it is kept beside the reference, unless ``--no-cache`` is given.
    ``told``: print what the recordings themselves show.
    """
    from adaptfault.inspection.fit_cache import FitCache
    from diagnostics import SelfDiagnosis
    from diagnostics.when.reference_findings import ReferenceWarning

    kept = None
    if getattr(args, "reference", None) and not args.no_cache:
        kept = FitCache(Path(args.reference[0]), recordings.frames, recordings.layout)
        fitted = kept.load()
        if fitted is not None:
            say(args, f"taking the healthy model from {kept.path}")
            return fitted
    say(args, f"fitting the healthy model of the diagnosis on {len(recordings)} recordings")
    fitted = SelfDiagnosis(recordings.layout)
    with fitting_bar(args) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore", ReferenceWarning)  # told below, with names
        fitted.fit(recordings.frames, progress=advance)
    if told:
        warn_of_reference(fitted.reference_findings_, recordings.names)
    if kept is not None:
        kept.save(fitted)
    return fitted


def warn_of_reference(findings: Sequence[ReferenceFinding], names: Sequence[str]) -> None:
    """Print what a reference itself shows, with the names of its recordings."""
    for finding in findings:
        print(f"warning: {finding.named(names)}", file=sys.stderr)


def add_cache(parser: argparse.ArgumentParser) -> None:
    """Add the option that keeps no fit."""
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="fit anew, and keep nothing beside the reference (.adaptfault/)",
    )


_KNOWN_FROM = 0.1  # share of a fit from which on its time is told where no bar is shown
_WORTH_TELLING = 5.0  # seconds


@contextmanager
def fitting_bar(args: argparse.Namespace) -> Iterator[Callable[[float], None]]:
    """Show a bar while something is fitted; it is called with the share of the work that is
    done."""
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}]"
    hide = None if (shown := progress(args)) is None else not shown
    first: tuple[float, float] | None = None
    told = False
    with tqdm(total=1.0, desc="fitting", bar_format=form, disable=hide, leave=False) as bar:

        def advance(share: float) -> None:
            nonlocal first, told
            bar.update(share - bar.n)
            if first is None and share > 0:  # what comes before is no part of the share
                first = (monotonic(), share)
            elif first is not None and bar.disable and not told and share >= first[1] + _KNOWN_FROM:
                told = True
                began, before = first
                left = (monotonic() - began) * (1 - share) / (share - before)
                if left >= _WORTH_TELLING:
                    say(args, f"fitting: about {left:.0f} s left")

        yield advance


@contextmanager
def reading_bar(args: argparse.Namespace) -> Iterator[Callable[[int], None]]:
    """Show the frames that are read; it is called with the number of more frames."""
    from tqdm import tqdm

    hide = None if (shown := progress(args)) is None else not shown
    with tqdm(unit="frame", desc="reading", disable=hide, leave=False, unit_scale=True) as bar:

        def advance(frames: int) -> None:
            bar.update(frames)

        yield advance


def say(args: argparse.Namespace, text: str) -> None:
    """Print a step on stderr, above a progress bar if one is shown."""
    if not args.quiet:
        above_bars(text)


def above_bars(text: str) -> None:
    """Print on stderr, above a progress bar if one is shown."""
    text = printable(text)
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)
    else:
        print(text, file=sys.stderr, flush=True)


class LogAboveBars(logging.Handler):
    """Prints warnings of the library as :func:`say` prints steps: a line of its own, above a
    progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        above_bars(self.format(record))


def emit(args: argparse.Namespace, result: dict[str, Any], text: str) -> None:
    """Print the result on stdout."""
    tell(args, json.dumps(result, indent=1, allow_nan=False) if args.json else printable(text))
