"""Doubts about recordings that can be read: what they hold is not what it looks like.

Each is one warning, however many files it concerns.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import Problem, located
from adaptfault.data.recordings.facts.labels import natural_order
from adaptfault.data.recordings.survey import Content
from diagnostics import SensorLayout
from diagnostics.preprocessing.copies import find_copies

_TOO_HIGH = 0.1  # of the full scale: healthy contacts go further
_APART = 50.0  # times, between the largest readings of two groups of files
_SHARE = 0.2  # of the files that a group has at least
_SHOWN = 4
_NAMED = re.compile(r"(?P<name>.*?[^\W\d_])[-_ ]*\d+")


def doubts(contents: Sequence[Content], layout: SensorLayout, *, labelled: bool) -> list[Problem]:
    """Return warnings about files that can be read.

    Args:
        contents: of those that are used.
        layout: the array.
        labelled: whether the recordings have classes, or targets.
    """
    found = [
        _two_scales(contents),
        _too_high(contents, layout),
        None if labelled else _classes_in_names(contents),
    ]
    return [Problem("warning", text) for text in found if text is not None]


def copies(recordings: Sequence[NDArray[Any]], names: Sequence[str]) -> list[Problem]:
    """Return one warning about recordings that are copies of others: they count once in a fit, in a
    certificate, and on each side of a split."""
    of = find_copies(recordings)
    copied = np.flatnonzero(of != np.arange(len(of)))
    if not len(copied):
        return []
    shown = [f"{names[i]} of {names[of[i]]}" for i in copied[:_SHOWN]]
    more = f" and {len(copied) - _SHOWN} more" if len(copied) > _SHOWN else ""
    are = "recording is a copy" if len(copied) == 1 else "recordings are copies"
    what = (
        f"{len(copied)} of {len(of)} {are}, exact or nearly: {', '.join(shown)}{more}; they count"
        " once in a reference, in training and in tests"
    )
    return [Problem("warning", what)]


def _two_scales(contents: Sequence[Content]) -> str | None:
    """Return that the files fall into two groups of other scale."""
    largest = np.array([content.largest for content in contents])
    order = np.argsort(largest)
    sizes = largest[order]
    if len(sizes) < 4 or not sizes[0] > 0:
        return None
    ratios = sizes[1:] / sizes[:-1]
    place = int(np.argmax(ratios)) + 1
    fewer = min(place, len(sizes) - place)
    if ratios[place - 1] < _APART or fewer < _SHARE * len(sizes):
        return None
    low = contents[order[place - 1]]
    high = contents[order[place]]
    return (
        f"readings of {place} files reach {sizes[place - 1]:.4g} ({low.path.name}), those of"
        f" {len(sizes) - place} others {sizes[-1]:.4g} ({high.path.name}): two units in one folder?"
        " Read them apart"
    )


def _too_high(contents: Sequence[Content], layout: SensorLayout) -> str | None:
    """Return that the full scale that a file states is far above all readings."""
    stated = [content for content in contents if content.facts.full_scale is not None]
    largest = max(content.largest for content in contents)
    share = largest / layout.full_scale
    if not stated or not 0 < share < _TOO_HIGH:
        return None
    what = (
        f"peaks reach {share:.0%} of the full scale, {layout.full_scale:g} {layout.unit}: is it the"
        " same unit? --full-scale and --unit state another one"
    )
    return located(stated[0].path, what)


def _classes_in_names(files: Sequence[Content]) -> str | None:
    """Return that the names of files in one folder begin with a few words, each of several
    files."""
    names = [_NAMED.fullmatch(file.path.stem) for file in files]
    found = [match["name"] for match in names if match is not None]
    words = natural_order(found)
    each = [found.count(word) for word in words]
    if len(found) < len(files) or not 2 <= len(words) <= len(files) // 2 or min(each) < 2:
        return None
    shown = ", ".join(words[:_SHOWN]) + (", ..." if len(words) > _SHOWN else "")
    return (
        f"no labels, but the names of the files begin with {len(words)} words ({shown}): are these"
        " the classes? Put them into folders of these names, or give --labels TABLE (file,label)"
    )
