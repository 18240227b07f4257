"""Numbers of recordings in words."""

from __future__ import annotations

from collections.abc import Sequence

_LISTED = 6


def ranges(numbers: Sequence[int]) -> str:
    """Return ascending numbers as ranges: "3, 5 to 7"."""
    begins = [n for i, n in enumerate(numbers) if i == 0 or numbers[i - 1] != n - 1]
    ends = [n for i, n in enumerate(numbers) if i == len(numbers) - 1 or numbers[i + 1] != n + 1]
    parts = [
        str(begin) if begin == end else f"{begin} to {end}"
        for begin, end in zip(begins, ends, strict=True)
    ]
    if len(parts) > _LISTED:
        return f"{', '.join(parts[:_LISTED])} and {len(parts) - _LISTED} more ranges"
    return ", ".join(parts)
