"""Which version runs: a small file that is replaced in one step, with a copy in case it is damaged. Needs no torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

from adaptfault.robot.checksummed_json import read_either, write_twice

SCHEMA = "adaptfault.current/1"
NAME = "current.json"

STARTS = 2  # of a version on probation; at the next one, if nothing confirmed its health, the old one is back


@dataclass(frozen=True)
class Pointer:
    """Which version runs, and which ones to fall back to.

    Attributes:
        active: the version's number.
        fallbacks: confirmed versions before it, the latest first.
        probation: its health was not yet confirmed.
        starts: how often it was started while on probation.
        starter: who started it last.
        rejected: the fault sets of versions that failed or were rolled back: not to be deployed for again.
    """

    active: int
    fallbacks: tuple[int, ...] = ()
    probation: bool = False
    starts: int = 0
    starter: str = ""
    rejected: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def read(cls, bundle: Path) -> Pointer:
        """Read it, or its copy where it is damaged; raises Damaged where both are."""
        d = read_either(bundle / NAME, SCHEMA)
        rejected = tuple(tuple(cells) for cells in d["rejected"])
        return cls(d["active"], tuple(d["fallbacks"]), d["probation"], d["starts"], d["starter"], rejected)

    def write(self, bundle: Path) -> None:
        """Write it: the moment the file is replaced is the moment the version is switched."""
        write_twice(bundle / NAME, {"schema": SCHEMA, **asdict(self)})

    def deployed(self, number: int) -> Pointer:
        """Return the pointer to a new version, on probation. One that was never confirmed is no fallback."""
        kept = self.fallbacks if self.probation else (self.active, *self.fallbacks)
        return replace(self, active=number, fallbacks=kept, probation=True, starts=0, starter="")

    def started(self, starter: str) -> Pointer:
        """Return the pointer after one more start, by somebody who was not the last to start it."""
        new = self.probation and starter != self.starter
        return replace(self, starts=self.starts + 1, starter=starter) if new else self

    def confirmed(self) -> Pointer:
        """Return the pointer with the probation over."""
        return replace(self, probation=False, starts=0, starter="")

    def fallen_back(self, rejected: tuple[int, ...]) -> Pointer:
        """Return the pointer to the version before; the fault set of the one that is left is not tried again.

        Raises:
            ValueError: there is none before.
        """
        if not self.fallbacks:
            raise ValueError(f"version {self.active} is the first: there is none to fall back to")
        first, *rest = self.fallbacks
        return Pointer(first, tuple(rest), rejected=(*self.rejected, rejected))
