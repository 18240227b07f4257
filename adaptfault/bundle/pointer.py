"""The active version: a small file that is replaced atomically, with a copy. Needs no torch."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from adaptfault.bundle.checksummed_json import decoding, read_with_copy, write_with_copy
from adaptfault.data.documents import members, rebuilt

SCHEMA = "adaptfault.current/1"
NAME = "current.json"

# of a version on probation; the next start without a confirmation returns to the version before
STARTS = 2


@dataclass(frozen=True)
class Pointer:
    """The active version and its fallbacks.

    Attributes:
        active: number of the active version.
        fallbacks: confirmed earlier versions, latest first.
        probation: the active version is not confirmed yet.
        starts: number of starts on probation.
        starter: identifies the last starter.
        rejected: fault sets of versions that failed or were rolled back; they are not deployed
            again.
        entry: key of the journal's entry about this switch, see
            :class:`~adaptfault.bundle.journal.Journal`.
    """

    active: int
    fallbacks: tuple[int, ...] = ()
    probation: bool = False
    starts: int = 0
    starter: str = ""
    rejected: tuple[tuple[int, ...], ...] = ()
    entry: str = ""

    @property
    def versions(self) -> set[int]:
        """Numbers of the versions that may run: the active one, its fallbacks and the
        fault-free."""
        return {1, self.active, *self.fallbacks}

    @classmethod
    def read(cls, bundle: Path) -> Pointer:
        """Read the pointer, or its copy where it is damaged; raises Damaged where both are."""
        document = read_with_copy(bundle / NAME, SCHEMA)
        with decoding(bundle / NAME):
            return rebuilt(document, cls, schema=SCHEMA)

    def write(self, bundle: Path) -> None:
        """Write the pointer; replacing the file switches the version."""
        write_with_copy(bundle / NAME, {"schema": SCHEMA, **members(self)})

    def deployed(self, number: int) -> Pointer:
        """Return the pointer to a new version, on probation. An unconfirmed version does not become
        a fallback."""
        kept = self.fallbacks if self.probation else (self.active, *self.fallbacks)
        # a return to an earlier version
        kept = tuple(fallback for fallback in kept if fallback != number)
        return replace(self, active=number, fallbacks=kept, probation=True, starts=0, starter="")

    def started(self, starter: str) -> Pointer:
        """Return the pointer after a start; consecutive starts by one starter count once."""
        new = self.probation and starter != self.starter
        return replace(self, starts=self.starts + 1, starter=starter) if new else self

    def confirmed(self) -> Pointer:
        """Return the pointer with the probation over."""
        return replace(self, probation=False, starts=0, starter="")

    def fallen_back(self, rejected: tuple[int, ...]) -> Pointer:
        """Return the pointer to the previous version; the fault set of the one that is left is
        rejected.

        Raises:
            ValueError: there is no previous version.
        """
        if not self.fallbacks:
            raise ValueError(
                f"version {self.active} is the first: there is no version to fall back to"
            )
        first, *rest = self.fallbacks
        return Pointer(first, tuple(rest), rejected=(*self.rejected, rejected))


def file_stamp(path: Path) -> tuple[int, int, int] | None:
    """Return values that change when a file is replaced; None while it does not exist."""
    try:
        stat = os.stat(path)
    except OSError:
        return None
    return stat.st_ino, stat.st_mtime_ns, stat.st_size
