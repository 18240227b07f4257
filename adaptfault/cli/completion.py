"""Completions of the command line in shells, which shtab writes: ``shtab --shell bash
adaptfault.cli.completion.parser``."""

from __future__ import annotations

import argparse
from typing import Any

from adaptfault.cli import parser_of
from adaptfault.cli.parser import Parser
from adaptfault.cli.paths import Read, Written


def parser() -> Parser:
    """Return the parser of all commands with all their options; those that take a path complete
    one."""
    import shtab

    made = parser_of()
    _complete(made, shtab.FILE)
    return made


def _complete(parser: argparse.ArgumentParser, path: Any) -> None:
    if isinstance(parser, Parser):
        parser.fill()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _complete(below, path)
        elif isinstance(action.type, type) and issubclass(action.type, Read | Written):
            action.complete = path  # type: ignore[attr-defined]  # shtab looks for it
