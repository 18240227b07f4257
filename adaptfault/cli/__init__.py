"""The command line: one module a command; results go to stdout, messages to stderr; errors are one
line."""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Sequence
from pkgutil import extend_path

from adaptfault import __version__
from adaptfault.cli.command import Command, Foreign
from adaptfault.cli.parser import BAD_INPUT, Parser
from adaptfault.cli.paths import check_paths
from adaptfault.cli.streams import LogAboveBars, finish, is_unread, one_line, prepare, settle
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


def _parser() -> Parser:
    """Return the parser of all commands."""
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
    for module in plugins(GROUP, BUILT_IN).values():
        module.add(commands)
    return parser


def _with_left_out(command: Command, code: int) -> int:
    """Return the exit code of a command; where files were left out, it is 1 at least, and the last
    line says so."""
    if not command.left_out:
        return code
    were = f"{command.left_out} files or recordings were"
    if command.left_out == 1:
        were = "1 file or recording was"
    print(f"adaptfault {command.command}: {were} left out; see the errors above", file=sys.stderr)
    return max(code, 1)


def _failed(name: str, error: Exception) -> int:
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
        print(f"adaptfault {name}: error: {what}", file=sys.stderr)
        return BAD_INPUT
    traceback.print_exception(error)
    print(f"adaptfault {name}: internal error; please report the lines above", file=sys.stderr)
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
    command = args.make(args)
    try:
        check_paths(command)
        code = command.run()
        return finish(command, _with_left_out(command, code))
    except KeyboardInterrupt:
        further = "; run the same command to continue" if command.continues else ""
        print(f"adaptfault {args.command}: interrupted{further}", file=sys.stderr)
        return 130
    except Exception as error:
        return _failed(args.command, error)
    finally:
        log.removeHandler(handler)
