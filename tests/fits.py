"""What tests share: a diagnosis that is fitted again to the same recordings is the first one, and
so are what an inspection tells of the same log, and the adaptation of a bundle to the same faults.

They depend on what they are given alone, as tests prove that compute them anew. What was made is
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

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.bundle.parts import Parts
from adaptfault.robot import maintenance
from diagnostics import SelfDiagnosis
from diagnostics.faults import Cells
from diagnostics.model import fitting, predictor

Progress = Callable[[float], None]


def kept(folder: Path, asked: Any, make: Callable[[], Any]) -> Any:
    """Return what was made for the same question, by any process that shares the folder."""
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK, effective_ids=True):
        return make()  # for a test that runs as another user
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
    """Make each fit, each inspection of a maintenance run, and each adaptation of a bundle without
    a budget, once for all processes that share the folder."""
    fit = SelfDiagnosis._fit
    inspect = maintenance.inspect
    adapter_of = Parts.adapter

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

    def adapter_once(parts: Parts) -> Adapter:
        adapter = adapter_of(parts)
        adapt = adapter.adapt
        hashes = sorted(parts._files.below("adapter").hashes.items())

        def adapt_once(faulty: Cells, **stated: Any) -> Adaptation:
            if stated.get("budget") is not None:
                return adapt(faulty, **stated)
            weights = [one.numpy() for one in adapter.model.state_dict().values()]
            asked = ("adapt", hashes, weights, tuple(faulty), sorted(stated.items()))
            return kept(folder, asked, lambda: adapt(faulty, **stated))

        adapter.__dict__["adapt"] = adapt_once
        return adapter

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Parts, "adapter", adapter_once)
        patch.setattr(SelfDiagnosis, "_fit", fit_once)
        patch.setattr(maintenance, "inspect", inspect_once)
        yield
