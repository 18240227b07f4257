"""Data classes are written as JSON holds them, and rebuilt from it."""

import json
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from adaptfault.data.documents import members, rebuilt
from diagnostics import FaultSet


@dataclass(frozen=True)
class Part:
    name: str
    size: float | None = None


@dataclass(frozen=True)
class Whole:
    kind: Literal["a", "b"]
    parts: tuple[Part, ...]
    pair: tuple[int, float] = (0, 0.0)


WHOLE = Whole("a", (Part("x", 1.5), Part("y")), (2, 0.5))


def test_a_set_of_cells_is_a_list_and_what_is_not_finite_is_none():
    @dataclass
    class Held:
        cells: FaultSet
        values: np.ndarray
        part: Part

    held = Held(FaultSet((1, 3), 5), np.array([[1.0, np.nan]]), Part("x", np.inf))
    assert members(held) == {
        "cells": [1, 3],
        "values": [[1.0, None]],
        "part": {"name": "x", "size": None},
    }
    assert members(held, "cells") == {"cells": [1, 3]}


def test_a_data_class_is_rebuilt_from_its_json():
    document = json.loads(json.dumps({"schema": "s/1", **members(WHOLE)}))
    assert rebuilt(document, Whole, schema="s/1") == WHOLE


@pytest.mark.parametrize(
    "part",
    [
        {"kind": "c"},
        {"pair": [1]},
        {"pair": 3},
        {"parts": [{"size": 1.0}]},
        {"parts": [{"name": 3}]},
        {"more": 1},
        {"schema": "s/2"},
    ],
)
def test_another_document_is_refused(part):
    with pytest.raises(ValueError, match="expected"):
        rebuilt({"schema": "s/1", **members(WHOLE), **part}, Whole, schema="s/1")
