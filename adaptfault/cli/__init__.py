"""The command line: one module a command; results go to stdout, messages to stderr; errors are one
line."""

from __future__ import annotations

import argparse
import logging
import math
import sys
import traceback
from collections.abc import Callable, Sequence
from pkgutil import extend_path
from typing import Any, NoReturn

from adaptfault import __version__
from adaptfault.cli.options import LogAboveBars
from adaptfault.cli.paths import check_paths
from adaptfault.cli.streams import finish, is_unread, one_line, prepare, settle
from adaptfault.data.plugins import plugins, what_to_install
from adaptfault.data.shortage import is_shortage

__path__ = extend_path(__path__, __name__)  # the packages of the repository add commands

GROUP = "adaptfault.commands"

BUILT_IN = {
    "info": "adaptfault.cli.info",
    "check": "adaptfault.cli.check",
    "convert": "adaptfault.cli.convert",
    "view": "adaptfault.cli.view",
    "simulate": "adaptfault.cli.simulate",
    "diagnose": "adaptfault.cli.diagnose",
    "selftest": "adaptfault.cli.selftest",
    "train": "adaptfault.cli.train",
    "evaluate": "adaptfault.cli.evaluate",
    "predict": "adaptfault.cli.predict",
    "forecast": "adaptfault.cli.forecast",
    "adapt": "adaptfault.cli.adapt",
    "restore": "adaptfault.cli.restore",
    "demo": "adaptfault.cli.demo",
    "maintain": "adaptfault.cli.maintain",
    "rollback": "adaptfault.cli.rollback",
    "history": "adaptfault.cli.history",
    "report": "adaptfault.cli.report",
    "listen": "adaptfault.cli.listen",
    "fleet": "adaptfault.cli.fleet",
    "reproduce": "adaptfault.cli.reproduce",
}
"""The commands in the order of ``--help``, as the entry points of the repository name them. Another
package adds one by a module with ``add(subparsers)`` and an entry point in the same group."""

# exit code for unusable input or usage, as monitoring tools understand it ("unknown")
BAD_INPUT = 3


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
        description=(
            "Finds the dead cells of a tactile array and repairs the classifier that reads it."
        ),
        epilog=(
            "Try: adaptfault info RECORDINGS on your own files, or adaptfault demo on simulated"
            " ones."
        ),
    )
    parser.add_argument("--version", action="version", version=f"adaptfault {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for module in plugins(GROUP, BUILT_IN).values():
        module.add(commands)
    return parser


def _with_left_out(args: argparse.Namespace, code: int) -> int:
    """Return the exit code of a command; where files were left out, it is 1 at least, and the last
    line says so."""
    left_out = getattr(args, "left_out", 0)
    if not left_out:
        return code
    were = "1 file or recording was" if left_out == 1 else f"{left_out} files or recordings were"
    print(f"adaptfault {args.command}: {were} left out; see the errors above", file=sys.stderr)
    return max(code, 1)


def _failed(args: argparse.Namespace, error: Exception) -> int:
    """Tell an error in one line; return the exit code.

    Python's own code for a traceback, 1, would read as "degraded but handled".
    """
    if is_unread(error):
        return 0
    what = what_to_install(error)
    if isinstance(error, RecursionError):
        what = "what it reads nests too deep; check the files that were given"
    elif isinstance(error, ValueError | OSError) or is_shortage(error):
        what = one_line(error)
    if what is not None:
        print(f"adaptfault {args.command}: error: {what}", file=sys.stderr)
        return BAD_INPUT
    traceback.print_exception(error)
    print(
        f"adaptfault {args.command}: internal error; please report the lines above",
        file=sys.stderr,
    )
    return BAD_INPUT


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code: 0 fine, 1 degraded but handled, 2 needs a technician, 3
    unusable input."""
    prepare()
    try:
        return _run(argv)
    finally:
        settle()


def _run(argv: Sequence[str] | None) -> int:
    parser = _parser()
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 0
    log = logging.getLogger("adaptfault")
    handler = LogAboveBars()
    log.addHandler(handler)
    try:
        check_paths(args)
        code = int(args.run(args))
        return finish(args, _with_left_out(args, code))
    except KeyboardInterrupt:
        further = "; run the same command to continue" if getattr(args, "continues", False) else ""
        print(f"adaptfault {args.command}: interrupted{further}", file=sys.stderr)
        return 130
    except Exception as error:
        return _failed(args, error)
    finally:
        log.removeHandler(handler)
