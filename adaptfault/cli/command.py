"""A command is a data class: its fields are its options, its docstring is its summary.

What several commands have is a class that they inherit (:mod:`adaptfault.cli.reading`,
:mod:`adaptfault.cli.shared_options`), or a function that returns a field.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from functools import partial
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from adaptfault.cli.parser import BAD_INPUT, Parser
from adaptfault.cli.streams import above_bars, failure_of
from adaptfault.data.printable import printable

if TYPE_CHECKING:
    from typing import Self

    from adaptfault.data.recordings import Problem

Commands = Any  # argparse's private type of subparsers


def option(help: str, metavar: str | None = None, **how: Any) -> Any:
    """Return a field that is an option, ``--full-scale`` of a field ``full_scale``.

    The annotation says what it takes: ``bool`` is a switch, ``list[X]`` one value or more,
    ``Literal`` one of these.

    Args:
        help, metavar: as argparse takes them.
        how: more of it, and where the option stands: ``flag`` instead of the name of the field,
            ``short``: its letter,
            ``section``: attribute of the command with the title of the section, ``if_``: attribute
            that says whether the command has it at all, ``last``: behind the others.
    """
    return field(metadata={"help": help, "metavar": metavar, **how})


def argument(help: str, metavar: str, **how: Any) -> Any:
    """Return a field that is an argument without a name."""
    return option(help, metavar, positional=True, **how)


@dataclass(kw_only=True, eq=False)
class Command:
    """What all commands have.

    Attributes:
        called: its name on the command line; "": that of the class.
        example: ends the help.
        one_of: options of which one may be given; ``one_is_needed``: has to be.
        continues: after an interruption the same command continues.
        decides: the exit code is a decision for a robot.
        reads: recordings are its matter, and the options that describe them come first.
        command: its name as typed, in messages.
        left_out: number of recordings that were not used.
        untold: the result could not be printed.
    """

    called: ClassVar[str] = ""
    example: ClassVar[str]
    one_of: ClassVar[Sequence[str]] = ()
    one_is_needed: ClassVar[bool] = False
    continues: ClassVar[bool] = False
    decides: ClassVar[bool] = False
    reads: ClassVar[bool] = False

    command: str
    json: bool = option("print the result as JSON")
    quiet: bool = option("no progress on stderr", short="-q")
    verbose: bool = option(
        "tell on stderr how each file is read, and where in the code an error arose", short="-v"
    )
    left_out: int = field(default=0, init=False)
    untold: bool = field(default=False, init=False)

    def __init_subclass__(cls) -> None:
        dataclass(kw_only=True, eq=False)(cls)

    @classmethod
    def add(cls, commands: Commands) -> None:
        """Add the command to those of a parser."""
        summary = " ".join((cls.__doc__ or "").split()).removesuffix(".")
        parser = commands.add_parser(
            cls.called or cls.__name__.lower(),
            help=f"{summary[0].lower()}{summary[1:]}",
            description=f"{summary}.",
            epilog=f"example:\n{cls.example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if isinstance(parser, Parser):
            parser.later = cls.add_options
        else:
            cls.add_options(parser)

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """Add the options to the parser of the command."""
        places: dict[str, Any] = {"": parser}
        if cls.one_of:
            exclusive = parser.add_mutually_exclusive_group(required=cls.one_is_needed)
        hints = get_type_hints(cls)
        for one in cls._options():
            section = one.metadata.get("section", "")
            if section not in places:
                places[section] = parser.add_argument_group(getattr(cls, section))
            place = exclusive if one.name in cls.one_of else places[section]
            _add(place, one, hints[one.name])
        parser.set_defaults(make=cls.of)

    @classmethod
    def _options(cls) -> list[Field[Any]]:
        """Return the options in the order of the help: arguments, what describes recordings, the
        command's own, those that it inherits."""
        own = list(cls.__annotations__)

        def place(one: Field[Any]) -> tuple[int, int]:
            if one.name in Command.__annotations__:
                return 0, 0
            if one.metadata.get("describes") and cls.reads:
                return 2, "section" in one.metadata
            if one.name not in own or "last" in one.metadata:
                return 4, 0
            return 1 if "positional" in one.metadata else 3, own.index(one.name)

        options = [one for one in fields(cls) if one.metadata]
        had = [one for one in options if getattr(cls, one.metadata.get("if_", "add"))]
        return sorted(had, key=place)

    @classmethod
    def of(cls, args: argparse.Namespace) -> Self:
        """Return the command with the options that were parsed; what it does not have is None."""
        names = [one.name for one in fields(cls) if one.init]
        given: dict[str, Any] = {name: getattr(args, name, None) for name in names}
        return cls(**given)

    def values(self) -> dict[str, Any]:
        """Return the value of each option, in the order of the help."""
        return {one.name: getattr(self, one.name) for one in self._options()}

    def run(self) -> int:
        """Do it; returns the exit code."""
        raise NotImplementedError

    @property
    def progress(self) -> bool | None:
        """Whether progress is shown; None shows it on a terminal."""
        return False if self.quiet else None

    def say(self, text: str) -> None:
        """Print a step on stderr, above a progress bar if one is shown."""
        if not self.quiet:
            above_bars(text)

    def emit(self, result: dict[str, Any], text: str) -> None:
        """Print the result on stdout."""
        shown = json.dumps(result, indent=1, allow_nan=False) if self.json else printable(text)
        self._write(partial(print, shown, flush=True))

    def complain(self, text: str) -> None:
        """Print a line on stderr that names the command."""
        print(f"adaptfault {self.command}: {text}", file=sys.stderr)

    def finish(self, code: int) -> int:
        """Return the exit code of a command that ran; the last line says what is not as it should.

        A command that decides something for a robot has done so, where its result cannot be
        printed: its code still says what, as a warning.
        """
        if self.left_out:
            were = f"{self.left_out} files or recordings were"
            if self.left_out == 1:
                were = "1 file or recording was"
            self.complain(f"{were} left out; see the errors above")
            code = max(code, 1)
        with suppress(ValueError):  # closed
            self._write(sys.stdout.flush)
        if not self.untold:
            return code
        return max(code, 1 if self.decides else BAD_INPUT)

    def _write(self, write: Callable[[], None]) -> None:
        error = failure_of(write)
        if error is not None:
            self.untold = True
            self.complain(f"error: the result could not be printed: {error.strerror}")

    def tell_problems(self, problems: Sequence[Problem]) -> None:
        """Print problems; recordings that are left out make the exit code 1 at least."""
        for problem in problems:
            print(problem, file=sys.stderr)
        self.left_out += sum(problem.level == "error" for problem in problems)

    def say_inferred(self, inferred: Sequence[str]) -> None:
        """Print on stderr what was inferred about the array."""
        for text in inferred:
            self.say(f"inferred: {text}")


@dataclass(kw_only=True, eq=False)
class Foreign(Command):
    """The command of another package, which adds its options itself."""

    args: argparse.Namespace

    @classmethod
    def of(cls, args: argparse.Namespace) -> Self:
        """Return the command with the options that were parsed."""
        return cls(command=args.command, json=False, quiet=False, verbose=False, args=args)

    def values(self) -> dict[str, Any]:
        """Return what was given."""
        return vars(self.args)

    def run(self) -> int:
        """Do it."""
        return int(self.args.run(self.args))


_OURS = ("flag", "short", "section", "if_", "describes", "positional", "last")


def _add(place: Any, one: Field[Any], hint: Any) -> None:
    """Add an option to a parser or a group of it."""
    how = {
        name: value
        for name, value in one.metadata.items()
        if name not in _OURS and value is not None
    }
    if get_origin(hint) in (Union, UnionType):
        (hint,) = (kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is list:
        (hint,) = get_args(hint)
        if "action" not in how:
            how.setdefault("nargs", "+")
    if get_origin(hint) is Literal:
        how["choices"] = get_args(hint)
    elif hint is bool:
        how["action"] = "store_true"
    elif hint is not str:
        how.setdefault("type", hint)
    if "positional" in one.metadata:
        place.add_argument(one.name, **how)
    else:
        flag = one.metadata.get("flag", f"--{one.name.replace('_', '-')}")
        short = [one.metadata["short"]] if "short" in one.metadata else []
        place.add_argument(*short, flag, dest=one.name, **how)
