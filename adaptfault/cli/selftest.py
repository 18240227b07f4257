"""adaptfault selftest: the fewest recordings of the robot's repertoire that test its skin."""

from __future__ import annotations

import argparse
import json

from adaptfault.cli.options import (
    Commands,
    add_recordings,
    add_trust,
    command,
    emit,
    load_recordings,
)
from adaptfault.cli.paths import Read, Written

_EXAMPLE = """\
  adaptfault selftest robot.bundle grasps/ --number 4 --out routine.json
      the four recordings whose repetition tests most of what matters for the accuracy
  adaptfault selftest robot.bundle grasps/ --seconds 20"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "selftest",
        "choose the fewest recordings whose repetition tests the cells that matter",
        _EXAMPLE,
    )
    parser.add_argument("bundle", type=Read, metavar="BUNDLE", help="folder that the robot carries")
    add_recordings(parser)
    parser.add_argument(
        "--number", type=int, metavar="N", help="largest number of recordings (default: as needed)"
    )
    parser.add_argument("--seconds", type=float, metavar="S", help="longest time of all of them")
    parser.add_argument("--out", type=Written, metavar="FILE", help="write the routine as JSON")
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Plan the routine."""
    from adaptfault.cli.trained_model import open_bundle
    from adaptfault.data.atomic import atomic_write
    from adaptfault.robot.selftest import plan_selftest

    bundle = open_bundle(args, args.bundle)
    assert bundle is not None  # the path was checked
    repertoire = load_recordings(args, args.recordings, layout=bundle.layout)
    routine = plan_selftest(bundle, repertoire, seconds=args.seconds, n=args.number)
    if args.out:
        atomic_write(args.out, json.dumps(routine.to_dict(), allow_nan=False).encode())
    emit(args, routine.to_dict(), str(routine))
    return 0
