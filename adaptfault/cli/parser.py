"""The parser of the command line."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from typing import Any, NoReturn

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


class Parser(argparse.ArgumentParser):
    """A parser whose numbers are finite and not negative, and whose exit code for wrong usage is 3.

    argparse's own, 2, means here that a technician is needed.

    Attributes:
        later: adds the options, once they are needed: not for ``adaptfault --help``.
    """

    later: Callable[[Parser], None] | None = None

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for kind in (int, float):
            self.register("type", kind, _number(kind))

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and exit."""
        self.print_usage(sys.stderr)
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")

    def fill(self) -> None:
        """Add the options."""
        later, self.later = self.later, None
        if later is not None:
            later(self)

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Parse, with the options of this command alone; what it does not know is refused here,
        with the usage of this command."""
        self.fill()
        known, unknown = super().parse_known_args(*args, **options)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown
