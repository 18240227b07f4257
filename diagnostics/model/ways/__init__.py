"""The ways to fail, one file each; a new one is added to the tuple."""

from __future__ import annotations

from diagnostics.model.ways.clamped import CLAMPED
from diagnostics.model.ways.comes_and_goes import COMES_AND_GOES
from diagnostics.model.ways.copies import COPIES
from diagnostics.model.ways.drift import DRIFTS
from diagnostics.model.ways.floats import FLOATS
from diagnostics.model.ways.holds import DITHERS, HOLDS
from diagnostics.model.ways.keeps import KEEPS
from diagnostics.model.ways.late import LATE, LATER
from diagnostics.model.ways.way import Way
from diagnostics.model.ways.weak import WEAK

WAYS = (HOLDS, DITHERS, FLOATS, COMES_AND_GOES, LATE, LATER, CLAMPED, KEEPS, COPIES, WEAK, DRIFTS)

__all__ = ["COMES_AND_GOES", "FLOATS", "WAYS", "Way"]
