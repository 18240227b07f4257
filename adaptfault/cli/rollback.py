"""adaptfault rollback: returns to the previous version."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, add_trust, command, emit, trust
from adaptfault.cli.paths import Read


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "rollback", "return to the previous version", "  adaptfault rollback robot.bundle"
    )
    parser.add_argument(
        "bundle",
        type=Read,
        metavar="BUNDLE",
        help="folder written by adaptfault train --out X.bundle",
    )
    add_trust(parser)
    parser.set_defaults(run=run, decides=True)


def run(args: argparse.Namespace) -> int:
    """Roll back."""
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.sensor_state import SensorState

    bundle = Bundle.open(args.bundle, **trust(args))
    left = bundle.active().number
    version = bundle.rollback()
    unhandled = [fault.reason for fault in SensorState.of(bundle).unhandled]
    result = {
        "schema": "adaptfault.rollback/1",
        "left": left,
        "version": version.number,
        "not_handled": unhandled,
    }
    lines = [f"running: {version}; version {left} is not deployed for the same faults again"]
    emit(args, result, "\n".join([*lines, *(f"not handled now: {reason}" for reason in unhandled)]))
    return 0
