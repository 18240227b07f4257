"""The command line: one module a command; results go to stdout, messages to stderr; errors are one
line."""

from __future__ import annotations

import atexit
import gc
import logging
import sys
import traceback
from collections.abc import Sequence
from pkgutil import extend_path

from adaptfault import __version__
from adaptfault.cli.command import Command, Foreign
from adaptfault.cli.parser import BAD_INPUT, Parser
from adaptfault.cli.paths import check_paths
from adaptfault.cli.streams import LogAboveBars, is_unread, one_line, prepare, settle
from adaptfault.data.plugins import plugins, what_to_install
from adaptfault.data.shortage import is_shortage

__path__ = extend_path(__path__, __name__)  # the packages of the repository add commands

# Python looks through all that is left for garbage when it ends, a sixth of the time of a short
# command
atexit.register(gc.freeze)

GROUP = "adaptfault.commands"

_NAMES = (
    "info",
    "check",
    "explain",
    "convert",
    "view",
    "simulate",
    "diagnose",
    "selftest",
    "train",
    "evaluate",
    "predict",
    "forecast",
    "adapt",
    "restore",
    "demo",
    "maintain",
    "rollback",
    "history",
    "report",
    "listen",
    "export-monitor",
    "fleet",
    "reproduce",
)

BUILT_IN = {name: f"adaptfault.cli.{name.replace('-', '_')}" for name in _NAMES}
"""The commands in the order of ``--help``, as the entry points of the repository name them. Another
package adds one by a module with ``add(subparsers)`` and an entry point in the same group."""


def parser_of(only: str | None = None) -> Parser:
    """Return the parser of all commands, or where there is one called ``only``, of that."""
    parser = Parser(
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
    parser.set_defaults(make=Foreign.of)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for module in plugins(GROUP, BUILT_IN, only).values():
        module.add(commands)
    return parser


def _failed(command: Command, error: Exception) -> int:
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
    if what is None or command.verbose:
        traceback.print_exception(error)
    if what is None:
        command.complain("internal error; please report the lines above")
    else:
        command.complain(f"error: {what}")
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
    given = sys.argv[1:] if argv is None else argv
    parser = parser_of(given[0] if given else None)
    args = parser.parse_args(given)
    if args.command is None:
        parser.print_help()
        return 0
    log = logging.getLogger("adaptfault")
    handler = LogAboveBars()
    log.addHandler(handler)
    command: Command = args.make(args)
    if command.verbose:
        log.setLevel(logging.DEBUG)
    try:
        check_paths(command)
        return command.finish(command.run())
    except KeyboardInterrupt:
        further = "; run the same command to continue" if command.continues else ""
        command.complain(f"interrupted{further}")
        return 130
    except Exception as error:
        return _failed(command, error)
    finally:
        log.removeHandler(handler)
        log.setLevel(logging.NOTSET)
