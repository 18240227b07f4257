"""Faults that coincide with classes: they show in all recordings of some classes and in hardly any
of the others, so that whoever trains on the recordings learns the fault for the class."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics import Diagnosis, Fault, SensorLayout, Verdict
from diagnostics.preprocessing.levels import DOUBTED, LEAST_LOADED

_LISTED = 5


def coinciding(diagnosis: Diagnosis, classes: ArrayLike, what: str = "class") -> list[str]:
    """Return a sentence for each set of classes that faults separate from the others.

    Args:
        diagnosis: of a log, by recording.
        classes: name or number of the class of each recording, ``[n]``.
        what: they are, as "session".
    """
    label = np.asarray(classes)
    if diagnosis.states is None or len(label) != len(diagnosis.states):
        return []
    of: dict[tuple[str, ...], list[Fault]] = {}
    for fault in diagnosis.faults:
        shown = (diagnosis.states[:, list(fault.cells)] == int(Verdict.FAULTY)).any(axis=1)
        separated = _separated(shown, label)
        if separated:
            of.setdefault(separated, []).append(fault)
    return [_sentence(names, faults, diagnosis.layout, what) for names, faults in of.items()]


def _separated(shown: NDArray[np.bool_], label: NDArray[np.generic]) -> tuple[str, ...]:
    """Return the classes in nearly all of whose recordings a fault shows (bool ``[n]``); empty
    where it shows in part of a class, in all classes or in none."""
    names = np.unique(label)
    share = np.array([shown[label == name].mean() for name in names])
    whole = share >= 1 - LEAST_LOADED
    if whole.all() or not (whole | (share <= DOUBTED)).all():
        return ()
    return tuple(map(str, names[whole].tolist()))


def _sentence(
    names: Sequence[str], faults: Sequence[Fault], layout: SensorLayout, what: str
) -> str:
    places = [str(one.line) if one.line else layout.place(one.cells[0]) for one in faults]
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    several = what
    if len(names) > 1:
        several += "es" if what.endswith("s") else "s"
    verb = "coincide" if len(places) > 1 else "coincides"
    return (
        f"{'; '.join(places[:_LISTED])}{more} {verb} with {several} {', '.join(names)} and no"
        f" other: a model may learn the fault for the {what}; leave out these cells, or these"
        " recordings"
    )
