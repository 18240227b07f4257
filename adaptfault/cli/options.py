"""Options that several commands share, and how they are read."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.recordings.blocks import Stream
    from diagnostics import FaultSet, SensorLayout

Commands = Any  # argparse's private type of subparsers


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
    parser: argparse.ArgumentParser, *, option: bool = False, labels: bool = True, least: int = 1
) -> None:
    """Add where recordings come from: ``least`` arguments, or an ``option`` for a command that can do without."""
    help_ = "file or folder of recordings (.csv, .npz, .npy; ROS 2 bags: folder, .mcap, .db3)"
    if option:
        parser.add_argument("--recordings", nargs="+", metavar="FILE", help=help_)
    else:
        parser.add_argument("recordings", nargs="+" if least else "*", metavar="RECORDINGS", help=help_)
    group = add_array(parser)
    if labels:
        group.add_argument("--labels", metavar="TABLE", help="CSV table with the columns file,label")
    group.add_argument("--topic", metavar="NAME", help="topic of a bag that holds the readings")
    group.add_argument(
        "--field", metavar="PATH", help="array in its messages that holds them, as data or sensors.values"
    )
    group.add_argument("--frames", type=int, metavar="T", help="refuse recordings of another length")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add where networks are trained."""
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default auto: cuda where there is one)")


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
        raise ValueError(f"--device {name}: {str(error).splitlines()[0]}; use auto, cpu or cuda") from None
    return name


def add_array(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add what describes the array; returns the group of options."""
    group = parser.add_argument_group("how recordings are read")
    group.add_argument("--layout", metavar="FILE", help="layout of the array, a JSON file")
    group.add_argument("--shape", metavar="PxRxC", help="layout from a shape: pads x rows x columns, as 2x13x6")
    group.add_argument("--full-scale", type=float, metavar="X", help="largest value a cell can report")
    group.add_argument("--unit", metavar="U", help="unit of the recordings, as N or count")
    group.add_argument("--rate", type=float, metavar="HZ", help="frames per second")
    group.add_argument("--calibration", metavar="TABLE", help="CSV table cell,raw,force: raw counts to newtons")
    return group


def load_recordings(args: argparse.Namespace, paths: Sequence[str], *, labelled: bool = False) -> Recordings:
    """Read recordings as the options say; problems go to stderr.

    Raises:
        ValueError: nothing could be read, or labels are needed and missing.
    """
    from adaptfault.data.recordings import load

    _one_layout(args)
    loaded = load(
        paths,
        layout=args.layout or args.shape,
        labels=getattr(args, "labels", None),
        frames=args.frames,
        calibration=args.calibration,
        full_scale=args.full_scale,
        unit=args.unit,
        rate=args.rate,
        topic=args.topic,
        field=args.field,
    )
    for problem in loaded.problems:
        print(problem, file=sys.stderr)
    if labelled and loaded.recordings.labels is None:
        raise ValueError(
            f"{paths[0]}: the recordings have no labels; give --labels TABLE, one folder for each class,"
            " or labels in the .npz"
        )
    return loaded.recordings


def stream_recordings(args: argparse.Namespace, paths: Sequence[str]) -> Stream:
    """Open recordings that are too large to be loaded, as the options say; problems are known after an iteration.

    Raises:
        ValueError: nothing could be read.
    """
    from adaptfault.data.recordings.blocks import Stream

    _one_layout(args)
    return Stream(
        paths,
        layout=args.layout or args.shape,
        calibration=args.calibration,
        full_scale=args.full_scale,
        unit=args.unit,
        rate=args.rate,
        topic=args.topic,
        field=args.field,
    )


def _one_layout(args: argparse.Namespace) -> None:
    if args.layout and args.shape:
        raise ValueError("--layout and --shape both given: one of them is enough")


def fault_set(text: str, layout: SensorLayout) -> FaultSet:
    """Read F: a diagnosis written by ``adaptfault diagnose --out``, or cell indices as ``3,17,200`` ("" = none).

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
    from diagnostics import Diagnosis

    if not path.is_file():
        raise ValueError(f"--faults {path}: no such file, and not cell indices as 3,17,200")
    try:
        diagnosis = Diagnosis.from_dict(json.loads(path.read_text()))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a diagnosis ({error}); write one with adaptfault diagnose --out") from None
    if diagnosis.layout.shape != layout.shape:
        raise ValueError(f"{path}: a diagnosis of {diagnosis.layout}, but the model is for {layout}")
    return diagnosis.fault_set


def progress(args: argparse.Namespace) -> bool | None:
    """Return what tqdm should do: None shows progress on a terminal."""
    return False if args.quiet else None


def say(args: argparse.Namespace, text: str) -> None:
    """Tell what is being done, on stderr."""
    if not args.quiet:
        print(text, file=sys.stderr, flush=True)


def emit(args: argparse.Namespace, result: dict[str, Any], text: str) -> None:
    """Print the result on stdout."""
    print(json.dumps(result, indent=1, allow_nan=False) if args.json else text)
