"""What tests share: a diagnosis that is fitted again to the same recordings is the first one, and
so is what an inspection tells of the same log.

Both depend on what they are given alone, as tests prove that compute them anew. What was made is
kept as a file, so that nobody changes what another test gets.
"""

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

from adaptfault.robot import maintenance
from diagnostics import SelfDiagnosis
from diagnostics.model import fitting, predictor

Progress = Callable[[float], None]


def kept(folder: Path, asked: Any, make: Callable[[], Any]) -> Any:
    """Return what was made for the same question, by any process that shares the folder."""
    rough = (predictor._STEPS, fitting._LOGS)
    place = folder / hashlib.blake2b(pickle.dumps((asked, rough)), digest_size=16).hexdigest()
    if not place.exists():
        made = pickle.dumps(make())
        unfinished = place.with_name(f"{place.name}.{os.getpid()}")
        unfinished.write_bytes(made)
        unfinished.replace(place)
    return pickle.loads(place.read_bytes())


@contextmanager
def made_once_each(folder: Path) -> Iterator[None]:
    """Make each fit, and each inspection of a maintenance run, once for all processes that share
    the folder."""
    fit = SelfDiagnosis._fit
    inspect = maintenance.inspect

    @functools.wraps(fit)
    def fit_once(
        own: SelfDiagnosis, recordings: Any, progress: Progress, *rest: Any, **stated: Any
    ) -> SelfDiagnosis:
        def make() -> tuple[dict[str, Any], list[float]]:
            told: list[float] = []
            fit(own, recordings, told.append, *rest, **stated)
            return vars(own), told

        asked = (vars(own), recordings.given, rest, sorted(stated.items()))
        state, told = kept(folder, asked, make)
        vars(own).update(state)
        for share in told:
            progress(share)
        return own

    @functools.wraps(inspect)
    def inspect_once(recordings: Any, diagnoser: SelfDiagnosis, *, reference: Any) -> Any:
        asked = ("inspect", recordings, vars(diagnoser), reference)
        return kept(folder, asked, lambda: inspect(recordings, diagnoser, reference=reference))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SelfDiagnosis, "_fit", fit_once)
        patch.setattr(maintenance, "inspect", inspect_once)
        yield
