"""What the node knows of its sensor: from the bundle, and again after each maintenance run. Needs
no ROS."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from adaptfault.bundle.pointer import file_stamp
from adaptfault.data.recordings import parse_shape, read_layout
from adaptfault.data.recordings.facts.layout_file import looks_like_shape
from adaptfault.ros2.parameters import Parameters
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.versions import Version
    from adaptfault.data.calibration import Calibration
    from adaptfault.imputation.restorer import Restorer

_RETRY = 60.0  # seconds until the next attempt after the bundle could not be read
_STATED = ("full_scale", "unit", "rate")

_log = logging.getLogger(__name__)


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
    """

    diagnoser: SelfDiagnosis
    known: FaultSet
    version: Version | None = None
    restorer: Restorer | None = None
    calibration: Calibration | None = None
    parts: dict[str, Any] | None = None

    @property
    def readings(self) -> dict[str, list[Any]]:
        """How received readings become those of the healthy reference; empty without a version."""
        return {} if self.version is None else self.version.readings

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.diagnoser.layout

    @classmethod
    def from_parameters(cls, parameters: Parameters) -> Sensor:
        """Return the sensor of the bundle, or of the layout.

        Raises:
            ValueError: neither bundle nor layout, or both; a bundle that is damaged or not signed
                by the trusted key.
            OSError: bundle or layout cannot be read.
        """
        if bool(parameters.bundle) == bool(parameters.layout):
            raise ValueError(
                "give the parameter bundle, or the parameter layout (a layout file or a shape as"
                " 2x11x10)"
            )
        stated = {name: getattr(parameters, name) for name in _STATED if getattr(parameters, name)}
        if parameters.bundle:
            if stated:
                raise ValueError(
                    f"the bundle states {' and '.join(stated)}; leave the parameter out"
                )
            return cls._from_bundle(_open(parameters), restores=bool(parameters.restored))
        text = parameters.layout
        layout = SensorLayout(*parse_shape(text)) if looks_like_shape(text) else read_layout(text)
        layout = replace(layout, **stated)
        return cls(SelfDiagnosis(layout), FaultSet((), layout.n_cells))

    @classmethod
    def _from_bundle(cls, bundle: Bundle, *, restores: bool) -> Sensor:
        version = bundle.active()
        _ = version.readings  # raises Damaged
        return cls(
            bundle.diagnoser(),
            bundle.known_faults().fault_set,
            version,
            bundle.restorer() if restores else None,
            bundle.parts.calibration,
            bundle.about["parts"],
        )

    def reopened(self, parameters: Parameters) -> Sensor:
        """Return the sensor as the bundle states it now; what did not change is not loaded again.

        Raises:
            ValueError, OSError: as :meth:`from_parameters`; or the bundle is now of another array.
        """
        bundle = _open(parameters)
        if bundle.layout.shape != self.layout.shape:
            raise ValueError(f"it is now for {bundle.layout}; start the node again")
        if bundle.about["parts"] != self.parts:
            return self._from_bundle(bundle, restores=bool(parameters.restored))
        version = bundle.active()
        _ = version.readings  # raises Damaged
        return replace(self, version=version, known=bundle.known_faults().fault_set)


class Follower:
    """Notices that a maintenance run changed the bundle, and loads what it states now in a thread.

    Args:
        parameters: of the node.
        clock: seconds.

    Attributes:
        sensor: as loaded last.

    Raises:
        ValueError, OSError: as :meth:`Sensor.from_parameters`.
    """

    def __init__(self, parameters: Parameters, clock: Callable[[], float] = monotonic) -> None:
        self.parameters = parameters
        self.clock = clock
        self._stamp = self._look()
        self.sensor = Sensor.from_parameters(parameters)
        self._next_look = clock()
        self._loading: threading.Thread | None = None
        self._ready: Sensor | None = None

    def poll(self) -> Sensor | None:
        """Return the sensor as the bundle states it now, once after each change; never waits."""
        if not self.parameters.bundle:
            return None
        if self._loading is not None:
            if self._loading.is_alive():
                return None
            self._loading = None
            ready = self._ready
            self._ready = None
            if ready is not None:
                self.sensor = ready
                return ready
        if self.clock() < self._next_look:
            return None
        stamp = self._look()
        if stamp != self._stamp:
            self._stamp = stamp
            self._loading = threading.Thread(target=self._load, name="adaptfault-load", daemon=True)
            self._loading.start()
        return None

    def _look(self) -> tuple[object, ...]:
        """Return what changes where a version is deployed, or known faults are written."""
        from adaptfault.bundle.journal import NAME as JOURNAL
        from adaptfault.bundle.pointer import NAME as POINTER

        home = Path(self.parameters.bundle)
        return tuple(file_stamp(home / name) for name in (POINTER, JOURNAL))

    def _load(self) -> None:
        try:
            self._ready = self.sensor.reopened(self.parameters)
        except Exception as error:  # whatever it is, the node goes on with what it has
            self._stamp = ()
            self._next_look = self.clock() + _RETRY
            _log.warning(
                "%s could not be read, the node goes on as before: %s",
                self.parameters.bundle,
                error,
            )


def _open(parameters: Parameters) -> Bundle:
    from adaptfault.bundle.bundle import Bundle

    return Bundle.open(parameters.bundle, keys=[parameters.trust] if parameters.trust else None)
