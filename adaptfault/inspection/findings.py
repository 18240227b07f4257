"""What a check of a data set tells, as linters tell it: codes, levels, what was not checked, and
when it fails.

What was not checked is no pass: it is listed, and a finding that says so fails whatever else was
chosen to fail.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

from adaptfault.inspection.code import LEVELS, NEEDS, PREFIX, Code, Need
from adaptfault.inspection.code_list import CODES
from adaptfault.inspection.codes import code_of
from adaptfault.inspection.naming import Naming
from adaptfault.inspection.result import Finding
from adaptfault.inspection.severity import worst
from diagnostics import SensorLayout
from diagnostics.decision.numbering import Numbering
from diagnostics.shown import shown

_NEVER = "never"
_FROM = {level: LEVELS.index(level) for level in LEVELS}  # the least severity of each level


@dataclass(frozen=True)
class Unchecked:
    """Something that was not checked.

    Attributes:
        what: one sentence, with what would check it.
        codes: that could not be found.
    """

    what: str
    codes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {"what": self.what, "codes": list(self.codes)}


@shown
@dataclass(frozen=True)
class Findings(Sequence[Finding]):
    """What a check tells, in the order in which it is told.

    Attributes:
        found: the findings.
        unchecked: what was not checked.
        layout: the array.
        source: what was checked, as it was named.
        naming: of its pads and recordings.
    """

    found: tuple[Finding, ...]
    unchecked: tuple[Unchecked, ...]
    layout: SensorLayout
    source: str = ""
    naming: Naming = field(default_factory=Naming, repr=False)

    @overload
    def __getitem__(self, place: int) -> Finding: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[Finding]: ...

    def __getitem__(self, place: int | slice) -> Finding | Sequence[Finding]:
        return self.found[place]

    def __len__(self) -> int:
        return len(self.found)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.found)

    @property
    def severity(self) -> int:
        """The worst of all; 0 without any."""
        return worst(self.found)

    @property
    def codes(self) -> tuple[str, ...]:
        """The codes that were found, each once, in ascending order."""
        return tuple(sorted({str(finding.code) for finding in self.found}))

    def __str__(self) -> str:
        lines = [f"{level_of(one)}: {one.code} {one.reason}" for one in self.found]
        lines += [f"not checked: {one.what}" for one in self.unchecked]
        return "\n".join([*lines, self.summary()])

    def summary(self) -> str:
        """Return how many findings there are of each level, in one line."""
        counts = dict.fromkeys(reversed(LEVELS), 0)
        for finding in self.found:
            counts[level_of(finding)] += 1
        told = [f"{n} {level}{'s' * (n != 1)}" for level, n in counts.items() if n]
        told += [f"{len(self.unchecked)} not checked"] * bool(self.unchecked)
        return ", ".join(told) or "no finding"

    def failed(self, fails: FailOn) -> int:
        """Return the exit code where only some findings fail: the worst severity of these, 1 at
        least; 0 where none of them was found."""
        return max((max(one.severity, 1) for one in self.found if fails.on(one)), default=0)

    def to_dicts(self) -> list[dict[str, Any]]:
        """Return the findings, JSON-safe."""
        return [self._as_dict(finding) for finding in self.found]

    def _as_dict(self, finding: Finding) -> dict[str, Any]:
        fault = finding.fault
        about = {**finding.to_dict(), "level": level_of(finding)}
        if fault is None:
            return {
                **about,
                "kind": None,
                "cells": [],
                "pads": [],
                "recordings": None,
                "begin": None,
            }
        names = self.naming.recordings
        recordings = None
        if fault.recordings is not None:
            recordings = [names[i] if names else str(i) for i in fault.recordings]
        begin = self.naming.place(fault.onset or 0)
        return {
            **about,
            "kind": str(fault.kind),
            "cells": list(fault.cells),
            "pads": self.naming.pads_of(fault.cells, self.layout),
            "recordings": recordings,
            "begin": None if begin is None else {"recording": begin[0], "frame": begin[1]},
        }

    def github(self, numbering: Numbering, advice: Sequence[str] = ()) -> str:
        """Return annotations, as workflow commands of GitHub Actions; ``advice``: what to leave
        out."""
        lines = []
        for one in self.found:
            about = {"title": f"{one.code} {one.code.name}", "file": self.source}
            lines.append(_command(level_of(one), about, numbering.text(one.reason)))
        beside = [("leave out", text) for text in advice]
        beside += [("not checked", one.what) for one in self.unchecked]
        for title, text in beside:
            lines.append(_command("notice", {"title": title}, numbering.text(text)))
        return "\n".join(lines)

    def markdown(self, numbering: Numbering, advice: Sequence[str] = ()) -> str:
        """Return a section for a data-set card; ``advice``: what to leave out."""
        lines = ["## Touch health", "", f"{self.layout}; {self.summary()}.", ""]
        if self.found:
            lines += ["| code | level | finding |", "|---|---|---|"]
            lines += [
                f"| {one.code} | {level_of(one)} | {_cell_of(numbering.text(one.reason))} |"
                for one in self.found
            ]
            lines.append("")
        lists = {"To leave out": advice, "Not checked": [one.what for one in self.unchecked]}
        for title, texts in lists.items():
            if texts:
                lines += [f"{title}:", "", *(f"- {numbering.text(text)}" for text in texts), ""]
        lines.append("`adaptfault explain CODE` says what a code means.")
        return "\n".join(lines)


@dataclass(frozen=True)
class FailOn:
    """Which findings fail a check.

    Attributes:
        least: severity from which on each finding fails; None: by its code alone.
        codes: that fail whatever their severity.
    """

    least: int | None = None
    codes: frozenset[Code] = frozenset()

    @classmethod
    def parse(cls, text: str) -> FailOn:
        """Return what a text names: levels (``notice``, ``warning``, ``error``), ``never``, codes
        and begins of codes (``TOUCH-12``), divided by commas.

        Raises:
            ValueError: it names something else.
        """
        least: list[int] = []
        codes: set[Code] = set()
        for part in (part.strip() for part in text.split(",")):
            if part in _FROM:
                least.append(_FROM[part])
            elif part != _NEVER:
                codes |= _beginning(part) or {code_of(part)}
        return cls(min(least, default=None), frozenset(codes))

    def on(self, finding: Finding) -> bool:
        """Return whether a finding fails; what was not checked always does, unless that was
        declared harmless."""
        if finding.code.is_unchecked and finding.severity:
            return True
        by_level = self.least is not None and finding.severity >= self.least
        return by_level or finding.code in self.codes


def unchecked_for_want(left: Mapping[Need, Iterable[Code]]) -> list[Unchecked]:
    """Return what was not checked because something was not given."""
    found = []
    for need, codes in left.items():
        names = ", ".join(code.name.replace("_", " ") for code in codes)
        what = f"{names}: none was looked for without {NEEDS[need]}"
        if need == "reference":
            what += "; the data set is its own reference"
        found.append(Unchecked(what, tuple(map(str, codes))))
    return found


def level_of(finding: Finding) -> str:
    """Return what linters call the severity of a finding."""
    return LEVELS[finding.severity]


def with_codes(text: str, found: Iterable[Finding], say: Callable[[str], str]) -> str:
    """Return a text whose lines that tell a finding begin with its code.

    Args:
        text: of a diagnosis and what is told beside it.
        found: the findings.
        say: turns the reason of a finding into its line.
    """
    told = {say(finding.reason): str(finding.code) for finding in found}
    lines = []
    for line in text.splitlines():
        code = next((code for reason, code in told.items() if line.startswith(reason)), None)
        lines.append(line if code is None else f"{code} {line}")
    return "\n".join(lines)


def _beginning(text: str) -> set[Code]:
    """Return the codes that begin with a text as ``TOUCH-12``."""
    begin = text.upper()
    if not begin.startswith(PREFIX):
        return set()
    return {code for code in CODES if str(code).startswith(begin)}


def _command(level: str, about: Mapping[str, str], message: str) -> str:
    """Return a workflow command; what its syntax uses itself is escaped."""
    escaped = message.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
    told = []
    for name, value in about.items():
        plain = value.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
        if value:
            told.append(f"{name}={plain.replace(':', '%3A').replace(',', '%2C')}")
    return f"::{level} {','.join(told)}::{escaped}"


def _cell_of(text: str) -> str:
    """Return a text as a cell of a table holds it."""
    return " ".join(text.split()).replace("|", "\\|")
