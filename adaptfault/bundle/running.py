"""Which version of a bundle runs: starts and their confirmation, the return to an earlier version.
Needs no torch."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.journal import Entry, Journal, now
from adaptfault.bundle.lock import PATIENCE, locked
from adaptfault.bundle.pointer import NAME, STARTS, Pointer
from adaptfault.bundle.versions import Version, Versions

PROCESS = uuid4().hex  # identifies this process in the count of starts

# seconds that a confirmation, which runs in the robot's loop, waits for another process
_IN_LOOP = 0.1
_log = logging.getLogger(__name__)


class Running:
    """The versions of a bundle, and the one of them that runs.

    Attributes:
        path: of the bundle.
        versions: that it holds.
        journal: of what happened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.versions = Versions(path / "versions")
        self.journal = Journal(path)

    @property
    def pointer(self) -> Path:
        """The file that names the active version; replaced at every switch."""
        return self.path / NAME

    def active(self) -> Version:
        """Return the active version; where it is damaged, the last valid one before it.

        Raises:
            Damaged: no version can be read.
        """
        problems = []
        for number in self._candidates():
            try:
                return self.versions[number]
            except (FileNotFoundError, Damaged) as error:
                problems.append(str(error))
        raise Damaged(f"{self.path} holds no version that can be read: {problems[0]}")

    def _candidates(self) -> Iterator[int]:
        """Yield the number of the active version, then those that replace it, the best first."""
        pointer = Pointer.read(self.path)
        first = dict.fromkeys((pointer.active, *pointer.fallbacks))
        yield from first
        for number in reversed(self.versions.numbers):
            if number < pointer.active and number not in first:
                yield number

    def begin(self, starter: str = PROCESS) -> Version:
        """Return the version to run and count the start while that version is on probation.

        A version that was started twice without :meth:`confirm` is replaced by the one before it.

        Args:
            starter: identifies the caller. Consecutive starts by the same starter count once,
                because one process may serve several devices.
        """
        try:
            with self._state() as pointer:
                after = pointer.started(starter)
                if after.starts > STARTS and pointer.fallbacks:
                    self._fall_back(
                        pointer,
                        f"version {pointer.active} was started {STARTS} times and never confirmed",
                    )
                elif after != pointer:
                    after.write(self.path)
        # a full or read-only disk, or a stopped process, must not stop the prediction
        except OSError as error:
            _log.warning("%s cannot be written, so this start is not counted: %s", self.path, error)
        return self.active()

    def confirm(self) -> None:
        """End the probation of the active version.

        Raises:
            OSError: the bundle cannot be written, or another process holds it; the version stays on
                probation.
        """
        if not Pointer.read(self.path).probation:
            return
        with self._state(_IN_LOOP) as pointer:
            if pointer.probation:
                entry = Entry(now(), "confirmed", {"version": pointer.active})
                self._switch(pointer, pointer.confirmed(), entry, patience=_IN_LOOP)

    def rollback(self) -> Version:
        """Return to the previous version. The fault set of the rejected one is not deployed again.

        Raises:
            ValueError: there is no previous version.
            OSError: the bundle cannot be written, or another process holds it.
        """
        with self._state() as pointer:
            self._fall_back(pointer, f"version {pointer.active} was rolled back")
        return self.active()

    @contextmanager
    def _state(self, patience: float = PATIENCE) -> Iterator[Pointer]:
        """Hold the lock of the pointer and the journal, and yield the pointer."""
        with locked(self.path / "state.lock", patience=patience):
            yield Pointer.read(self.path)

    def _fall_back(self, pointer: Pointer, reason: str) -> None:
        try:
            rejected = self.versions[pointer.active].fault_set.cells
        except (FileNotFoundError, Damaged):
            rejected = ()
        after = pointer.fallen_back(rejected)
        document = {"from": pointer.active, "to": after.active, "reason": reason}
        self._switch(pointer, after, Entry(now(), "rollback", document))

    def _switch(
        self, before: Pointer, after: Pointer, entry: Entry, patience: float = PATIENCE
    ) -> None:
        """Replace the pointer and journal the entry: both, or neither. Needs the lock of the
        state."""
        self.journal.prepare(entry, before.entry)
        replace(after, entry=entry.key).write(self.path)
        self.journal.settle(entry.key, patience=patience)

    def _settle(self) -> None:
        """Move entries that wait into the journal, as after a crash."""
        if self.journal.waits:
            with self._state() as pointer:
                self.journal.settle(pointer.entry)
