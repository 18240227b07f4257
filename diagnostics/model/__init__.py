"""One model of the array: what it shares, what each cell does, and when it fails.

``record`` (what each cell reads, by piece) -> ``rest`` (what a pad shares) -> ``observed`` (what
the others say of a cell, and what it read a piece ago) -> ``ways`` (to fail) -> ``judge`` (one
loop) -> ``findings``.
"""

from __future__ import annotations

from diagnostics.model.fitting import fit_model
from diagnostics.model.judge import Judgement, Model

__all__ = ["Judgement", "Model", "fit_model"]
