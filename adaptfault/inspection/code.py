"""One code of what ``check`` tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, get_args

from adaptfault.inspection.severity import Name, of_finding
from diagnostics.faults import FaultKind

Need = Literal["reference", "classes", "times"]
"""What is compared: healthy recordings, the classes of the recordings, the times of the frames."""

LEVELS = ("notice", "warning", "error", "error")
"""What linters call the severities 0 to 3."""

PREFIX = "TOUCH-"

_WIRES = 119  # the last number of cells and wires
_UNCHECKED = 190  # numbers from here on tell what was not checked


@dataclass(frozen=True)
class Code:
    """One code.

    Attributes:
        number: behind ``TOUCH-``.
        kind: of the fault, or name of the finding.
        what: was found.
        why: it matters to whoever trains.
        limits: when it is not to be trusted, or not looked for.
        missed: what is not found; empty where ``method`` says so.
        method: the module that finds it, whose docstring says how.
        needs: what has to be given so that it is looked for.
    """

    number: int
    kind: FaultKind | Name
    what: str
    why: str
    limits: str
    missed: str = ""
    method: str = ""
    needs: Need | None = None

    def __str__(self) -> str:
        return f"{PREFIX}{self.number}"

    @property
    def name(self) -> str:
        """What a program asks for: a kind of fault, or the name of a finding."""
        return str(self.kind)

    @property
    def is_unchecked(self) -> bool:
        """Whether it tells what was not checked."""
        return self.number >= _UNCHECKED

    @property
    def not_found(self) -> str:
        """What is not found, in one paragraph."""
        return self.missed or _not_detected(self.method)

    @property
    def severity(self) -> str:
        """How bad it is, in words."""
        if self.number <= _WIRES:
            return f"{LEVELS[1]}; {LEVELS[2]} where a wire or a tenth of the cells is faulty"
        return LEVELS[of_finding(_NAME_OF[self.name])]

    def text(self) -> str:
        """Return everything that is to say of the code, for a terminal."""
        rows = {
            "what": self.what,
            "why": self.why,
            "level": self.severity,
            "limits": self.limits,
            "not found": self.not_found,
            "needs": "" if self.needs is None else NEEDS[self.needs],
            "method": self.method,
        }
        told = [f"{name:10s}{text}" for name, text in rows.items() if text]
        return "\n".join([f"{self} {self.name}", *told])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "code": str(self),
            "name": self.name,
            "what": self.what,
            "why": self.why,
            "level": self.severity,
            "limits": self.limits,
            "not_found": self.not_found,
            "needs": self.needs,
            "method": self.method or None,
        }


_NAME_OF: Mapping[str, Name] = {name: name for name in get_args(Name)}

NEEDS: Mapping[Need, str] = {
    "reference": "healthy recordings: --reference FILE, or --healthy FIRST:LAST",
    "classes": "recordings with classes or groups: tasks, --labels, --label-column, --groups",
    "times": "times of the frames: --time-column",
}
"""The options that give it."""


def _not_detected(module: str) -> str:
    """Return what the docstring of a module says that it does not detect."""
    for paragraph in (import_module(module).__doc__ or "").split("\n\n"):
        _, _, said = " ".join(paragraph.split()).partition("Not detected: ")
        if said:
            return said[0].upper() + said[1:]
    return ""
