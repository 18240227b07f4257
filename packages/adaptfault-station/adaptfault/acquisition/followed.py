"""What is known of a running sensor: from its bundle, and again after each maintenance run."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.bundle.journal import NAME as JOURNAL
from adaptfault.bundle.pointer import NAME as POINTER
from adaptfault.bundle.pointer import file_stamp
from adaptfault.bundle.reload import Reload
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.versions import Version
    from adaptfault.data.calibration import Calibration
    from adaptfault.imputation.restorer import Restorer

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BundleAt:
    """A bundle on disk, and how it is read.

    Attributes:
        path: its folder.
        keys: PEM files of public keys, one of which must have signed it; None: signatures are not
            checked.
        restores: whether frames will be restored.
    """

    path: str | Path
    keys: Sequence[str | os.PathLike[str]] | None = None
    restores: bool = True

    def sensor(self, before: Sensor | None = None) -> Sensor:
        """Return the sensor as the bundle states it now.

        Args:
            before: as it was read before; what did not change is not loaded again.

        Raises:
            ValueError: the bundle is damaged, not signed by a trusted key, or now of another array.
            OSError: it cannot be read.
        """
        from adaptfault.bundle.bundle import Bundle

        bundle = Bundle.open(self.path, keys=self.keys)
        if before is not None and bundle.layout.shape != before.layout.shape:
            raise ValueError(f"it is now for {bundle.layout}; start again")
        if before is None or bundle.about["parts"] != before.parts:
            return self._loaded(bundle)
        version = bundle.active()
        _ = version.readings  # raises Damaged
        known = bundle.known_faults().fault_set
        return replace(before, version=version, known=known, bundle=bundle)

    def _loaded(self, bundle: Bundle) -> Sensor:
        version = bundle.active()
        _ = version.readings  # raises Damaged
        return Sensor(
            bundle.diagnoser(),
            bundle.known_faults().fault_set,
            version,
            bundle.restorer() if self.restores else None,
            bundle.parts.calibration,
            bundle.about["parts"],
            bundle,
        )


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor, and how its frames become whole.

    Attributes:
        diagnoser: with the healthy reference of the bundle, or without one.
        known: cells that are faulty whatever a monitor finds.
        version: the active one of the bundle, which undoes exchanged wires and replaced pads; None
            without a bundle.
        restorer: fitted on the healthy windows of the bundle; None: no frame is restored.
        calibration: from received values to the layout's unit; None: they are in that unit.
        parts: hashes of the files of the bundle that no maintenance changes.
        bundle: as it was opened; None without one.
    """

    diagnoser: SelfDiagnosis
    known: FaultSet
    version: Version | None = None
    restorer: Restorer | None = None
    calibration: Calibration | None = None
    parts: dict[str, Any] | None = None
    bundle: Bundle | None = None

    @property
    def readings(self) -> dict[str, list[Any]]:
        """How received readings become those of the healthy reference; empty without a version."""
        return {} if self.version is None else self.version.readings

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.diagnoser.layout


class Follower:
    """Notices that a maintenance run changed the bundle, and loads what it states now in a thread.

    Args:
        load: returns the sensor; argument: the one before, None at first.
        path: of the bundle; None: there is none, and nothing changes.

    Attributes:
        sensor: as loaded last.

    Raises:
        ValueError, OSError: as ``load``.
    """

    def __init__(
        self, load: Callable[[Sensor | None], Sensor], path: str | os.PathLike[str] | None
    ) -> None:
        self._load = load
        self._files = () if path is None else tuple(Path(path, name) for name in (POINTER, JOURNAL))
        self.reload = Reload(self._load_again, self._look)
        self.sensor = load(None)

    def poll(self) -> Sensor | None:
        """Return the sensor as the bundle states it now, once after each change; never waits."""
        ready = self.reload.poll(self.sensor)
        if ready is not None:
            self.sensor = ready
        return ready

    def _look(self) -> tuple[object, ...] | None:
        """Return what changes where a version is deployed, or known faults are written."""
        return tuple(map(file_stamp, self._files)) or None

    def _load_again(self, before: Sensor) -> Sensor:
        try:
            return self._load(before)
        except Exception as error:  # whatever it is, what runs goes on with what it has
            what = "could not be read, all goes on as before"
            _log.warning("%s %s: %s", self._files[0].parent, what, error)
            raise
