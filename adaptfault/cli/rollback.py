"""adaptfault rollback: returns to the previous version."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, command, emit


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "rollback", "return to the previous version", "  adaptfault rollback robot.bundle")
    parser.add_argument("bundle", metavar="BUNDLE", help="folder written by adaptfault train --out X.bundle")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Roll back."""
    from adaptfault.robot.bundle import Bundle

    bundle = Bundle.open(args.bundle)
    left = bundle.active().number
    version = bundle.rollback()
    result = {"schema": "adaptfault.rollback/1", "left": left, "version": version.number}
    emit(args, result, f"{version} runs; version {left} is not deployed for the same faults again")
    return 0
