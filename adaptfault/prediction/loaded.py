"""Loads the version of a bundle that is to run."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adaptfault.bundle.checksummed_json import decoding
from adaptfault.bundle.running import PROCESS
from adaptfault.prediction.inference import Inference
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.versions import Version

_STARTS = 3  # attempts to load a version; the bundle falls back to an earlier one after two

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Loaded:
    """A loaded version, and the bundle that was opened for it."""

    version: Version
    model: Inference
    bundle: Bundle


class Loader:
    """Loads the active version of a bundle where it is another one than the running one.

    Args:
        open_bundle: opens the bundle as it is now on disk.

    Attributes:
        told: problems that were logged.
    """

    def __init__(self, open_bundle: Callable[[], Bundle]) -> None:
        self._open = open_bundle
        self._failed: int | None = None  # number of the version that could not be loaded
        self.told: set[str] = set()

    def __call__(self, running: Loaded) -> Loaded | None:
        """Return the active version; None where it runs already, or is damaged, which is logged.

        Raises:
            Exception: the bundle cannot be read now, or the system has too little of something, as
                of open files.
        """
        number = None
        try:
            bundle = self._open()
            if bundle.active().number in (running.version.number, self._failed):
                return None
            version = bundle.begin()
            number = version.number
            if number != running.version.number:
                return _start(bundle, version, running.model.layout)
        except Exception as error:  # a failed load must not stop the robot's loop
            what = "the bundle could not be read"
            if number is not None:
                what = f"version {number} could not be loaded"
            self.tell(f"{what}, version {running.version.number} goes on: {error}")
            if number is None or _passes(error):
                raise
            self._failed = number
        return None

    def tell(self, text: str) -> None:
        """Log a problem once, however often it comes again."""
        if text not in self.told:
            _log.warning("%s", text)
        self.told.add(text)


def _start(bundle: Bundle, version: Version, layout: SensorLayout) -> Loaded:
    """Load a version and run it once, so that errors and the first run's set-up time come before
    the first frame.

    Raises:
        FileNotFoundError, ImportError, ValueError: the version cannot be loaded.
    """
    with decoding(version.folder):
        model = Inference.load(version.files)
    if model.layout != layout:
        raise ValueError(f"the version is for {model.layout}, the bundle for {layout}")
    model.predict(np.zeros((1, model.length, layout.n_cells), np.float32))
    _ = version.readings  # raises Damaged
    return Loaded(version, model, bundle)


def start_any(bundle: Bundle) -> Loaded:
    """Start the active version; repeat on failure, until the bundle falls back to an earlier
    version.

    An attempt that fails by an error of the system, as too many open files, does not count against
    the version.
    """
    failures = 0
    for left in reversed(range(_STARTS)):
        version = bundle.begin(f"{PROCESS}, {failures} failures")
        try:
            return _start(bundle, version, bundle.layout)
        except (OSError, MemoryError, ImportError, ValueError) as error:
            if not left:
                raise
            failures += not _passes(error)
            _log.warning("version %d could not be loaded: %s", version.number, error)
    raise AssertionError("unreachable")


def _passes(error: Exception) -> bool:
    """Return whether the same call may succeed later: the system had too little of something, the
    files are whole."""
    return isinstance(error, OSError | MemoryError) and not isinstance(error, FileNotFoundError)
