"""adaptfault report: the technician's page about a robot's skin."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, add_count_from, add_trust, command, emit, trust
from adaptfault.cli.paths import Read, WrittenFolder


def add(commands: Commands) -> None:
    """Add the command."""
    example = "  adaptfault report robot.bundle --out report.html"
    parser = command(
        commands, "report", "write the technician's report: what is broken, what to check", example
    )
    parser.add_argument(
        "bundle",
        type=Read,
        metavar="BUNDLE",
        help="folder written by adaptfault train --out X.bundle",
    )
    parser.add_argument(
        "--out",
        type=WrittenFolder,
        default="report.html",
        metavar="FILE",
        help="default report.html",
    )
    parser.add_argument(
        "--name", metavar="NAME", help="of the robot (default: of the bundle or its folder)"
    )
    add_count_from(parser)
    add_trust(parser)
    parser.set_defaults(run=run)  # the folder of the page is made


def run(args: argparse.Namespace) -> int:
    """Write the page."""
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.technician_report import write_report

    bundle = Bundle.open(args.bundle, **trust(args))
    path = write_report(args.out, bundle, name=args.name, count_from=args.count_from)
    emit(args, {"schema": "adaptfault.report/1", "report": str(path)}, f"report: {path}")
    return 0
