"""Text of others, as names of files, for a terminal: it may hold escape sequences, or bytes that
are no UTF-8."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return text with every character escaped that is not printed, but line breaks (``\x1b[2J``,
    ``\udcff``)."""
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text
    )
