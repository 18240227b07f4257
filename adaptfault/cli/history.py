"""adaptfault history: lists the maintenance runs and versions of a robot, and what drifts over
them."""

from __future__ import annotations

import argparse
from typing import Any

from adaptfault.cli.options import Commands, add_trust, command, emit, trust
from adaptfault.cli.paths import Read, Written

_EXAMPLE = """  adaptfault history robot.bundle --last 10
  adaptfault history robot.bundle --confirm
      ends the probation of the version that runs
  adaptfault history robot.bundle --trend --picture trend.png
      cells and lines whose gain, offset, noise or blinks drift, and when they cross their limits"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "history", "list maintenance runs and versions", _EXAMPLE)
    parser.add_argument(
        "bundle",
        type=Read,
        metavar="BUNDLE",
        help="folder written by adaptfault train --out X.bundle",
    )
    parser.add_argument("--last", type=int, metavar="N", help="only the last N entries")
    parser.add_argument(
        "--confirm", action="store_true", help="end the probation of the version that runs"
    )
    parser.add_argument(
        "--trend", action="store_true", help="what drifts from run to run, in place of the runs"
    )
    parser.add_argument(
        "--picture",
        type=Written,
        metavar="FILE",
        help="with --trend: write the drifting series as PNG",
    )
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """List runs and versions."""
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.pointer import Pointer

    bundle = Bundle.open(args.bundle, **trust(args))
    if args.picture and not args.trend:
        raise ValueError("--picture shows trends: give --trend, too")
    if args.confirm:
        bundle.confirm()
    if args.trend:
        from adaptfault.prognosis.cell_condition import AgeingTable

        report = AgeingTable.of(bundle).report()
        if args.picture:
            report.write_picture(args.picture)
        emit(args, report.to_dict(), str(report))
        return 0
    pointer = Pointer.read(bundle.path)
    runs = bundle.journal.runs(args.last)
    problems = bundle.problems(repair=False)
    result = {
        "schema": "adaptfault.history/1",
        "version": bundle.active().number,
        "probation": pointer.probation,
        "versions": bundle.versions.numbers,
        "runs": runs,
        "problems": problems,
    }
    state = f", on probation, started {pointer.starts} times" if pointer.probation else ""
    lines = [f"{bundle.active()} runs{state}", *(line(run) for run in runs)]
    emit(args, result, "\n".join([*lines, *(f"damage: {problem}" for problem in problems)]))
    return 0


def line(run: dict[str, Any]) -> str:
    """Return one line of text for a run."""
    about = {
        "confirmed": lambda: f"version {run['version']}",
        "rollback": lambda: f"version {run['from']} -> {run['to']}: {run['reason']}",
    }
    text = about.get(run["what"], lambda: f"version {run['version']}: {run['reason']}")()
    return f"{run['time']}  {run['what']:10s} {text}"
