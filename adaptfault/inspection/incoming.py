"""Recordings given to maintenance, and what of them cannot be used."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.printable import printable
from adaptfault.inspection.converter_range import within_range
from adaptfault.inspection.plausibility import implausible
from diagnostics import SensorLayout


@dataclass(frozen=True)
class IncomingRecording:
    """A recording given to maintenance.

    Attributes:
        name: printable.
        frames: as they came, ``[T, D]``; None: they do not fit the array.
        digest: SHA-256 of the content.
        problem: why it cannot be used; None: it can.
        outside: readings out of the converter's range, which count as missing.
    """

    name: str
    frames: NDArray[np.float64] | None
    digest: str
    problem: str | None
    outside: int = 0

    def left_out(self, layout: SensorLayout) -> str:
        """Return what is not used of it and why, in one sentence; empty: all is used."""
        if self.problem is not None:
            return f"{self.name}: {self.problem}"
        if not self.outside:
            return ""
        return (
            f"{self.name}: {self.outside} readings outside 0 to {layout.full_scale:g} {layout.unit}"
            " are missing"
        )


def incoming_recordings(
    recordings: ArrayLike | Sequence[ArrayLike], names: Sequence[str], layout: SensorLayout
) -> list[IncomingRecording]:
    """Return each recording with its digest and what is wrong with it.

    Args:
        recordings: ``[T, D]`` or a list of them, in the layout's unit.
        names: of the recordings; further ones are numbered.
        layout: the array.
    """
    incoming = []
    for i, recording in enumerate(layout.recordings(recordings)):
        name = printable(names[i]) if i < len(names) else f"recording {i}"
        incoming.append(_incoming(np.ascontiguousarray(recording, dtype=np.float64), name, layout))
    return incoming


def _incoming(raw: NDArray[np.float64], name: str, layout: SensorLayout) -> IncomingRecording:
    digest = hashlib.sha256(repr(raw.shape).encode() + raw.tobytes()).hexdigest()
    try:
        frames = layout.check_recording(raw, name)
    except ValueError as error:
        return IncomingRecording(name, None, digest, str(error))
    problem = implausible(frames, layout) if len(frames) else "it holds no frame"
    outside = within_range(frames, layout)[1] if problem is None else 0
    return IncomingRecording(name, frames, digest, problem, outside)
