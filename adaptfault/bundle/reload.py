"""Loads something again, in a thread, once its files change."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from time import monotonic
from typing import Generic, TypeVar

T = TypeVar("T")

_RETRY = 60.0  # seconds until the next attempt after the files could not be read


class Reload(Generic[T]):
    """Loads something again in a thread each time that its files change.

    Args:
        load: returns what the files hold, from what they held before; None: nothing that is new.
            Where it raises, it has told why, and is called again after a minute.
        look: returns what changes with the files; None: there is nothing to load.
        every: seconds between two looks.
    """

    def __init__(
        self, load: Callable[[T], T | None], look: Callable[[], object], every: float = 0.0
    ) -> None:
        self._load = load
        self._look = look
        self._every = every
        self._stamp = look()
        self._next_look = monotonic() + every
        self._ready: T | None = None
        self.thread: threading.Thread | None = None

    def sibling(self, load: Callable[[T], T | None]) -> Reload[T]:
        """Return another one for the same files, which looks by itself for what is being loaded."""
        other = copy.copy(self)
        other._load = load
        if self.thread is not None:
            other._stamp = None
        other._ready = other.thread = None
        return other

    def poll(self, before: T) -> T | None:
        """Return what the files hold, once after each change; never waits."""
        if self.thread is not None:
            if self.thread.is_alive():
                return None
            self.thread = None
            ready = self._ready
            self._ready = None
            if ready is not None:
                return ready
        now = monotonic()
        if now < self._next_look:
            return None
        self._next_look = now + self._every
        stamp = self._look()
        if stamp is not None and stamp != self._stamp:
            self._stamp = stamp
            self.thread = threading.Thread(
                target=self._run, args=(before,), name="adaptfault-load", daemon=True
            )
            self.thread.start()
        return None

    def _run(self, before: T) -> None:
        try:
            self._ready = self._load(before)
        except Exception:
            self._stamp = None
            self._next_look = monotonic() + _RETRY
