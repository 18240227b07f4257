"""Gives each recording its class: from the file, from a table of labels, or from the folder that
holds the file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import Problem
from adaptfault.data.recordings.facts.labels import natural_order, read_label_table
from adaptfault.data.recordings.files import Found
from adaptfault.data.recordings.survey import Content


def label_files(
    contents: Sequence[Content],
    given: str | PathLike[str] | None,
    problems: list[Problem],
    beside: Sequence[Found] = (),
) -> list[Content]:
    """Label the files that carry no labels, by table or folder; a file without one among others is
    left out.

    ``beside``: other files without labels, of which nothing is read.
    """
    table = None if given is None else Path(given)
    known: dict[Path, dict[Path, str]] = {}
    listings = {table or content.file.table for content in contents}
    for path in sorted(path for path in listings if path is not None):
        known[path], wrong = read_label_table(path)
        problems += wrong
    files = [*beside, *(content.file for content in contents if content.labels is None)]
    bare = [file for file in files if not (table or file.table)]
    nested = {file.root for file in bare if not file.is_direct}
    many = bool(nested) or len({file.path.parent.resolve() for file in bare}) > 1
    labelled = []
    for content in contents:
        file = content.file
        listing = table or file.table
        if content.labels is not None or not (listing or many):
            labelled.append(content)
            continue
        label = None
        remedy = "lies beside the folders of the classes: left out; move it into one"
        if listing is not None:
            label = known[listing].get(file.path.resolve())
            remedy = f"is not in the table {listing}: left out; add a line for it"
        elif file.root not in nested or not file.is_direct:
            label = file.path.resolve().parent.name
        if label is None:
            problems.append(Problem.warning(file.path, remedy))
        else:
            labelled.append(replace(content, labels=(label,) * len(content.recordings)))
    return labelled


def class_indices(
    labels: Sequence[str | None], orders: Iterable[tuple[str, ...]], problems: list[Problem]
) -> tuple[NDArray[np.int64] | None, tuple[str, ...]]:
    """Return the class index of each recording and the names, in the order that a file gives or in
    natural order."""
    if all(label is None for label in labels):
        return None, ()
    if any(label is None for label in labels):
        missing = sum(label is None for label in labels)
        what = (
            f"labels: {missing} of {len(labels)} recordings have none, so all go without; load them"
            " apart"
        )
        problems.append(Problem("warning", what))
        return None, ()
    known = [order for order in orders if order]
    every = {label for label in labels if label is not None}.union(*known)
    class_names = next((order for order in known if every <= set(order)), natural_order(every))
    index = {name: i for i, name in enumerate(class_names)}
    return (
        np.array([index[label] for label in labels if label is not None], dtype=np.int64),
        class_names,
    )
