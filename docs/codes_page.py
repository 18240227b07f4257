"""Writes docs/codes.md, the page of all codes, from their registry."""

from __future__ import annotations

from pathlib import Path

from adaptfault.inspection.code import Code
from adaptfault.inspection.code_list import CODES

PAGE = Path(__file__).with_name("codes.md")

_HEAD = """\
# Codes

Each finding of `adaptfault check` has a code, the same for ever. A notice is severity 0, a warning
1, an error 2 ([exit codes](command-line.md#exit-codes)). What needs a reference, classes or times
is not looked for without them, and then listed as not checked.
`python docs/codes_page.py` writes this page.
"""


def page() -> str:
    """Return the page."""
    return "\n".join([_HEAD, *map(_section, CODES)])


def _section(code: Code) -> str:
    needs = "" if code.needs is None else f" Needs: {code.needs}."
    return (
        f"## {code} {code.name}\n\n"
        f"{code.what} {code.why}\n\n"
        f"- Level: {code.severity}.{needs}\n"
        f"- Limits: {code.limits}\n"
        f"- Not found: {code.not_found}\n"
    )


if __name__ == "__main__":
    PAGE.write_text(page())
