"""The command line: one module a command; results go to stdout, messages to stderr; errors are one line."""

from __future__ import annotations

import argparse
import logging
import math
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from adaptfault import __version__
from adaptfault.cli import (
    adapt,
    convert,
    demo,
    diagnose,
    evaluate,
    fleet,
    forecast,
    history,
    info,
    listen,
    maintain,
    predict,
    report,
    reproduce,
    restore,
    rollback,
    simulate,
    train,
)
from adaptfault.cli.options import LogAboveBars, refuse_missing
from adaptfault.data.printable import printable

COMMANDS = (
    info,
    convert,
    simulate,
    diagnose,
    train,
    evaluate,
    predict,
    forecast,
    adapt,
    restore,
    demo,
    maintain,
    rollback,
    history,
    report,
    listen,
    fleet,
    reproduce,
)

BAD_INPUT = 3  # exit code for unusable input or usage, as monitoring tools understand it ("unknown")


def _number(convert: Callable[[str], float]) -> Callable[[str], float]:
    """Return a converter of the text of an option that refuses what is negative or not finite."""

    def converted(text: str) -> float:
        number = convert(text)
        if not 0 <= number < math.inf:
            raise argparse.ArgumentTypeError(f"expected a finite number, not below 0, got {text!r}")
        return number

    converted.__name__ = convert.__name__  # argparse names it
    return converted


class _Parser(argparse.ArgumentParser):
    """A parser whose numbers are finite and not negative, and whose exit code for wrong usage is 3.

    argparse's own, 2, means here that a technician is needed.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for kind in (int, float):
            self.register("type", kind, _number(kind))

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")


def _parser() -> _Parser:
    """Return the parser of all commands."""
    parser = _Parser(
        prog="adaptfault",
        description="Finds the dead cells of a tactile array and repairs the classifier that reads it.",
        epilog="Try: adaptfault info RECORDINGS on your own files, or adaptfault demo on simulated ones.",
    )
    parser.add_argument("--version", action="version", version=f"adaptfault {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code: 0 fine, 1 degraded but handled, 2 needs a technician, 3 unusable input."""
    parser = _parser()
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 0
    log, handler = logging.getLogger("adaptfault"), LogAboveBars()
    log.addHandler(handler)
    try:
        refuse_missing(args)
        return int(args.run(args))
    except (ValueError, OSError) as error:
        print(f"adaptfault {args.command}: error: {printable(' '.join(str(error).split()))}", file=sys.stderr)
        return BAD_INPUT
    except MemoryError as error:
        print(f"adaptfault {args.command}: error: not enough memory ({error})", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"adaptfault {args.command}: interrupted", file=sys.stderr)
        return 130
    except Exception:  # Python's own exit code for a traceback, 1, would read as "degraded but handled"
        traceback.print_exc()
        print(f"adaptfault {args.command}: internal error; please report the lines above", file=sys.stderr)
        return BAD_INPUT
    finally:
        log.removeHandler(handler)
