"""Fits that tests share: a diagnosis that is fitted again to the same recordings is the first
one."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from diagnostics import SelfDiagnosis
from diagnostics.model import fitting, predictor

Progress = Callable[[float], None]


@contextmanager
def fits_made_once(folder: Path) -> Iterator[None]:
    """Make each fit once for all processes that share the folder.

    A fit is known by its recordings, its parameters and how rough it is. It is kept as a file, so
    that nobody changes what another test gets.
    """
    fit = SelfDiagnosis._fit

    @functools.wraps(fit)
    def made_once(
        own: SelfDiagnosis, recordings: Any, progress: Progress, *rest: Any, **stated: Any
    ) -> SelfDiagnosis:
        rough = (predictor._STEPS, fitting._LOGS)
        asked = pickle.dumps((vars(own), recordings.given, rest, sorted(stated.items()), rough))
        place = folder / hashlib.blake2b(asked, digest_size=16).hexdigest()
        if place.exists():
            state, shares = pickle.loads(place.read_bytes())
            vars(own).update(state)
            for share in shares:
                progress(share)
            return own
        told: list[float] = []

        def seen(share: float) -> None:
            told.append(share)
            progress(share)

        fit(own, recordings, seen, *rest, **stated)
        unfinished = place.with_name(f"{place.name}.{os.getpid()}")
        unfinished.write_bytes(pickle.dumps((vars(own), told)))
        unfinished.replace(place)
        return own

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SelfDiagnosis, "_fit", made_once)
        yield
