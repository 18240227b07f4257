"""Changed readings: exchanged wires and replaced pads of a log, and the log with them undone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from adaptfault.bundle.versions import Version
    from diagnostics import Diagnosis
    from diagnostics.sensor.another_sensor import AnotherSensor
    from diagnostics.sensor.recalibration import Recalibration
    from diagnostics.sensor.rewiring import Rewiring
    from diagnostics.sensor.swapped_in_part import SwappedInPart

Frames = list[NDArray[np.float64]]


@dataclass(frozen=True)
class ChangedReadings:
    """What changed between cells and readings; at most one of the two.

    Attributes:
        rewiring: exchanged wires; None: none.
        recalibration: replaced pads; None: none.
        frames: recordings ``[T, D]`` with the change undone.
        diagnosis: of these.
        as_found: the recordings as they came and their diagnosis, where a pad was replaced; None
            otherwise.
        in_part: wires that were exchanged in some of the recordings: no version undoes that.
        another: recordings of another sensor; some of them are left out of ``frames``.
    """

    rewiring: Rewiring | None
    recalibration: Recalibration | None
    frames: Frames
    diagnosis: Diagnosis
    as_found: ChangedReadings | None = None
    in_part: SwappedInPart | None = None
    another: AnotherSensor | None = None

    @property
    def reason(self) -> str:
        """One sentence; empty: nothing changed."""
        found = self.rewiring or self.recalibration
        return "" if found is None else found.reason

    @property
    def told(self) -> dict[str, Any]:
        """What a report says of it."""
        return {
            "rewiring": () if self.rewiring is None else self.rewiring.steps,
            "replaced_pads": () if self.recalibration is None else self.recalibration.pads,
        }

    def readings(self, version: Version) -> dict[str, list[Any]]:
        """Return how a version undoes the change, on top of what ``version`` undoes; see
        ``Version.readings``."""
        if self.rewiring is not None:
            order = self.rewiring.source.tolist()
            return {name: [values[i] for i in order] for name, values in version.readings.items()}
        if self.recalibration is None:
            return version.readings
        gain = version.gain * self.recalibration.gain
        offset = version.offset + version.gain * self.recalibration.offset
        return {**version.readings, "gain": gain.tolist(), "offset": offset.tolist()}

    def changed(self, x: NDArray[np.float32], full_scale: float) -> NDArray[np.float32]:
        """Return scaled windows ``[N, T, D]`` of the unchanged sensor as the changed one reads
        them."""
        if self.rewiring is not None:
            return x[..., np.argsort(self.rewiring.source)]
        if self.recalibration is None:
            return x
        gain = self.recalibration.gain
        offset = self.recalibration.offset / full_scale
        return np.clip(gain * x + offset, 0.0, 1.0).astype(np.float32)

    def undone(self, x: NDArray[np.float32], full_scale: float) -> NDArray[np.float32]:
        """Return scaled windows ``[N, T, D]`` of the changed sensor with the change undone."""
        if self.rewiring is not None:
            return self.rewiring.undo(x)
        if self.recalibration is None:
            return x
        from diagnostics.sensor.recalibration import recalibrated  # slow to import

        return recalibrated(x, self.recalibration.gain, self.recalibration.offset / full_scale, 1.0)
