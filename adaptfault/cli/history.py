"""adaptfault history: lists the maintenance runs and versions of a robot."""

from __future__ import annotations

import argparse
from typing import Any

from adaptfault.cli.options import Commands, command, emit

_EXAMPLE = """  adaptfault history robot.bundle --last 10
  adaptfault history robot.bundle --confirm
      ends the probation of the version that runs"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "history", "list maintenance runs and versions", _EXAMPLE)
    parser.add_argument("bundle", metavar="BUNDLE", help="folder written by adaptfault train --out X.bundle")
    parser.add_argument("--last", type=int, metavar="N", help="only the last N entries")
    parser.add_argument("--confirm", action="store_true", help="end the probation of the version that runs")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """List runs and versions."""
    from adaptfault.robot.bundle import Bundle
    from adaptfault.robot.pointer import Pointer

    bundle = Bundle.open(args.bundle)
    if args.confirm:
        bundle.confirm()
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
