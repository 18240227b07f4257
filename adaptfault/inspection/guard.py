"""A guard of training scripts: nobody trains on a data set with dead cells without knowing."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from os import PathLike
from typing import Any

from adaptfault.data.recordings import Opened, Recordings, open_recordings
from adaptfault.inspection.check_log import check_log
from adaptfault.inspection.findings import FailOn, Findings, level_of
from adaptfault.inspection.inspection import inspect
from adaptfault.inspection.long_log import inspect_parts
from adaptfault.inspection.naming import classes_of
from adaptfault.inspection.result import Finding
from diagnostics import SelfDiagnosis

__all__ = ["GuardError", "guard"]

_SHOWN = 5

PathName = str | PathLike[str]


class GuardError(RuntimeError):
    """A data set is not fit for training.

    Attributes:
        findings: all of them.
    """

    def __init__(self, message: str, findings: Findings) -> None:
        super().__init__(message)
        self.findings = findings


def guard(
    dataset: Recordings | PathName | Iterable[PathName] | Any,
    *,
    on: str = "error",
    reference: Recordings | None = None,
    **stated: Any,
) -> Findings:
    """Check the touch readings of a data set before training; raise where they are not fit for it.

    Findings that do not raise and are no mere notice come as a warning. What was not checked is in
    ``unchecked`` of what is returned.

    Args:
        dataset: recordings; or paths or a data set, as :func:`adaptfault.load` takes them.
        on: what raises: ``"error"``, ``"warning"``, ``"notice"``, ``"never"``, codes and begins of
            codes, divided by commas, as ``check --fail-on``.
        reference: healthy recordings of the same array; None: the data set is its own.
        stated: how paths are read, as for :func:`adaptfault.load`.

    Returns:
        The findings.

    Raises:
        GuardError: a finding that ``on`` names, or so little was tested or read that nothing can be
            said.
        InputError: nothing could be read.
        ValueError: ``on`` names what is none.
    """
    fails = FailOn.parse(on)
    log = _opened(dataset, stated)
    diagnoser = SelfDiagnosis(log.layout)
    healthy = None if reference is None else list(reference.frames)
    if healthy is not None:
        diagnoser.fit(healthy)
    classes = classes_of(log)
    if isinstance(log, Recordings):
        inspection = inspect(list(log.frames), diagnoser, reference=healthy, classes=classes)
    else:
        inspection = inspect_parts(
            log.parts(), diagnoser, reference=healthy, lengths=log.lengths, classes=classes
        )
    left_out = 0
    if isinstance(log, Opened):
        left_out = sum(problem.level == "error" for problem in log.problems)
    checked = check_log(log, inspection, left_out=left_out, compared=reference is not None)
    findings = checked.findings
    raising = [one for one in findings if fails.on(one)]
    if raising:
        raise GuardError(f"not fit for training: {_listed(raising)}", findings)
    told = [one for one in findings if one.severity]
    if told:
        warnings.warn(f"touch readings: {_listed(told)}", stacklevel=2)
    return findings


def _opened(dataset: Any, stated: dict[str, Any]) -> Opened | Recordings:
    if isinstance(dataset, Recordings):
        if stated:
            raise ValueError(f"{', '.join(stated)}: of recordings in memory nothing is read")
        return dataset
    return open_recordings(dataset, **stated)


def _listed(findings: list[Finding]) -> str:
    told = [f"{level_of(one)} {one.code} {one.reason}" for one in findings[:_SHOWN]]
    more = f"; and {len(findings) - _SHOWN} more" if len(findings) > _SHOWN else ""
    return "; ".join(told) + more
