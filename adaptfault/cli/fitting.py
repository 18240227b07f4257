"""Fits the healthy model of the diagnosis, with a bar."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from adaptfault.cli.command import Command
    from adaptfault.data.recordings import Recordings
    from diagnostics import SelfDiagnosis
    from diagnostics.when.reference_findings import ReferenceFinding

_KNOWN_FROM = 0.1  # share of a fit from which on its time is told where no bar is shown
_WORTH_TELLING = 5.0  # seconds


def fit_diagnoser(
    command: Command, recordings: Recordings, *, told: bool = True, beside: str | None = None
) -> SelfDiagnosis:
    """Return the healthy model of recordings, with a bar while it is fitted.

    Args:
        command: that says so.
        recordings: healthy.
        told: print what the recordings themselves show.
        beside: path of the recordings, beside which the model is kept; None: it is not.
    """
    from adaptfault.inspection.fit_cache import FitCache
    from diagnostics import SelfDiagnosis
    from diagnostics.when.reference_findings import ReferenceWarning

    kept = None
    if beside is not None:
        kept = FitCache(Path(beside), recordings.frames, recordings.layout)
        fitted = kept.load()
        if fitted is not None:
            command.say(f"taking the healthy model from {kept.path}")
            return fitted
    command.say(f"fitting the healthy model of the diagnosis on {len(recordings)} recordings")
    fitted = SelfDiagnosis(recordings.layout)
    with fitting_bar(command) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore", ReferenceWarning)  # told below, with names
        fitted.fit(recordings.frames, progress=advance)
    if told:
        warn_of_reference(fitted.reference_findings_, recordings.names)
    if kept is not None:
        kept.save(fitted)
    return fitted


def warn_of_reference(findings: Sequence[ReferenceFinding], names: Sequence[str]) -> None:
    """Print what a reference itself shows, with the names of its recordings."""
    for finding in findings:
        print(f"warning: {finding.named(names)}", file=sys.stderr)


@contextmanager
def fitting_bar(command: Command) -> Iterator[Callable[[float], None]]:
    """Show a bar while something is fitted; it is called with the share of the work that is
    done."""
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}]"
    hide = True if command.quiet else None
    first: tuple[float, float] | None = None
    told = False
    with tqdm(total=1.0, desc="fitting", bar_format=form, disable=hide, leave=False) as bar:

        def advance(share: float) -> None:
            nonlocal first, told
            bar.update(share - bar.n)
            if first is None and share > 0:  # what comes before is no part of the share
                first = (monotonic(), share)
            elif first is not None and bar.disable and not told and share >= first[1] + _KNOWN_FROM:
                told = True
                began, before = first
                left = (monotonic() - began) * (1 - share) / (share - before)
                if left >= _WORTH_TELLING:
                    command.say(f"fitting: about {left:.0f} s left")

        yield advance
