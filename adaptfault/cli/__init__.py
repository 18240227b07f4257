"""The command line: one module a command, results on stdout, everything else on stderr, never a traceback."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from adaptfault.cli import (
    adapt,
    demo,
    diagnose,
    evaluate,
    fleet,
    history,
    listen,
    maintain,
    report,
    reproduce,
    restore,
    rollback,
    train,
)

COMMANDS = (
    train,
    diagnose,
    adapt,
    restore,
    evaluate,
    demo,
    reproduce,
    maintain,
    rollback,
    history,
    report,
    listen,
    fleet,
)

BAD_INPUT = 3  # exit code for unusable input or usage, as monitoring tools understand it ("unknown")


class _Parser(argparse.ArgumentParser):
    """argparse's own exit code for wrong usage is 2, which here means that a technician is needed."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code: 0 fine, 1 degraded but handled, 2 needs a technician, 3 unusable input."""
    parser = _Parser(
        prog="adaptfault",
        description="Finds the dead cells of a tactile array and repairs the classifier that reads it.",
        epilog="Try: adaptfault demo",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    args = parser.parse_args(argv)
    try:
        return int(args.run(args))
    except (ValueError, OSError) as error:
        # One line, whatever happened: what came, what was expected, how to mend it.
        print(f"adaptfault {args.command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"adaptfault {args.command}: interrupted", file=sys.stderr)
        return 130
