"""How a result shows itself: one line at a prompt and in a debugger, its text in a notebook."""

from __future__ import annotations

from typing import Any, TypeVar

_WIDEST = 160  # characters

T = TypeVar("T", bound=type[Any])


def shown(cls: T) -> T:
    """Give a class, which has a text, a ``repr`` of one line and a page of HTML for notebooks."""
    result: Any = cls
    if result.__str__ is object.__str__:
        raise TypeError(f"{cls.__name__} has no text to show")
    result.__repr__ = _line
    result._repr_html_ = _page
    return cls


def _line(self: object) -> str:
    first = next((line.strip() for line in str(self).splitlines() if line.strip()), "")
    text = f"<{type(self).__name__}: {first}>"
    return text if len(text) <= _WIDEST else f"{text[: _WIDEST - 4]}...>"


def _page(self: object) -> str:
    from html import escape  # slow to import, and rarely needed

    return f"<pre>{escape(str(self))}</pre>"
