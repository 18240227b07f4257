"""adaptfault convert: recordings of any readable format into .npz, .npy, CSV files or a ROS 2
bag."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, add_recordings, command, emit, load_recordings, say
from adaptfault.cli.paths import WrittenRecordings
from adaptfault.cli.selection import add_selection, select

_EXAMPLE = """\
  adaptfault convert raw/ --shape 10x10 --full-scale 3.3 --unit V --rate 50 --out grasps.npz
      the archive states the layout: no later command needs these options
  adaptfault convert grasps.npz --out grasps-csv --times
  adaptfault convert grasps.npz --take ::5 --inject row:0:3=open --out broken.npz"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "convert", "write recordings in another format, with their layout", _EXAMPLE
    )
    add_recordings(parser)
    parser.add_argument(
        "--out",
        type=WrittenRecordings,
        required=True,
        metavar="PATH",
        help="X.npz, X.npy, X.bag (ROS 2 bag), or a folder for CSV files",
    )
    parser.add_argument(
        "--times",
        action="store_true",
        help="CSV files begin with a header and a column time_ms of whole milliseconds",
    )
    add_selection(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, select, write."""
    from adaptfault.data.recordings import save

    recordings = select(args, load_recordings(args, args.recordings))
    lost = save(args.out, recordings, times=args.times)
    for fact in lost:
        say(args, f"not stored in this format: {fact}")
    result = {
        "schema": "adaptfault.convert/1",
        "out": args.out,
        "recordings": len(recordings),
        "layout": recordings.layout.to_dict(),
        "not_stored": list(lost),
    }
    emit(args, result, f"{len(recordings)} recordings of {recordings.layout}: {args.out}")
    return 0
