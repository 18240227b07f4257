"""adaptfault info: the content of recordings, and what was inferred about the array."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import (
    Commands,
    add_recordings,
    command,
    emit,
    open_reported,
    report_range,
    summary_of,
)
from adaptfault.cli.paths import Written

_EXAMPLE = """  adaptfault info grasps.npz --picture grasps.png
  adaptfault info today/ --shape 10x10 --full-scale 3.3 --unit V
  adaptfault info today/ --write-layout layout.toml
      with --layout layout.toml, or as layout.toml in the folder, nothing is inferred any more"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "info",
        "show what is in recordings: shape, range, rate, classes, silent cells",
        _EXAMPLE,
    )
    add_recordings(parser)
    parser.add_argument(
        "--picture", type=Written, metavar="FILE", help="write mean and peak of each cell as PNG"
    )
    parser.add_argument(
        "--write-layout",
        type=Written,
        metavar="FILE",
        help="write what was stated and inferred of the array as TOML, for --layout",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the summary."""
    opened = open_reported(args, args.recordings)
    summary = summary_of(opened, opened.inferred)
    report_range(opened)
    if args.write_layout:
        from adaptfault.data.recordings.facts.layout_file import write_layout

        write_layout(args.write_layout, opened.layout, opened.inferred)
    if args.picture:
        from adaptfault.data.atomic import atomic_figure

        atomic_figure(args.picture, summary.plot(), dpi=150)
    emit(args, summary.to_dict(), str(summary))
    return 0
