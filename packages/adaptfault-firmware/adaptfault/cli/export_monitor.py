"""adaptfault export-monitor: a monitor in C for the microcontroller that reads the array."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.shared_options import Trusting, bundle_argument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from adaptfault.bundle.bundle import Bundle


class ExportMonitor(Trusting):
    """Write a monitor in C for the microcontroller that reads the array."""

    called = "export-monitor"
    example = """\
  adaptfault export-monitor robot.bundle --out monitor.c
  adaptfault export-monitor robot.bundle --reference grasps/ --out monitor.c
      one file of C99: 12 bytes a cell, no allocation; stuck, silent and outside, frozen"""

    bundle: Read = bundle_argument()
    reference: list[Read] | None = option(
        "fault-free recordings (default: the windows of the bundle)", "RECORDINGS"
    )
    out: Written = option("file of C", "FILE", required=True)

    def run(self) -> int:
        """Learn the limits, and write the file."""
        from adaptfault.bundle.bundle import Bundle
        from adaptfault.data.atomic import atomic_write
        from adaptfault.firmware import learn_limits, monitor_source

        bundle = Bundle.open(self.bundle, **self.trusted())
        limits = learn_limits(bundle.diagnoser(), _healthy(bundle, self.reference))
        source = monitor_source(limits, bundle.layout)
        atomic_write(Path(self.out), source.encode("ascii"))
        cells = int(bundle.layout.present.sum())
        judged = int((limits.stuck_after > 0).sum())
        about: dict[str, Any] = {
            "schema": "adaptfault.export_monitor/1",
            "out": str(self.out),
            "cells": cells,
            "judged": judged,
            "bytes": 12 * bundle.layout.n_cells + 2,
            "counts_per_unit": limits.per_unit,
        }
        unit = bundle.layout.unit
        what = f"{judged} of {cells} cells can be told stuck; {about['bytes']} bytes of memory"
        self.emit(about, f"{self.out}: {what}; 1 {unit} is {limits.per_unit:.6g} counts")
        return 0


add = ExportMonitor.add


def _healthy(bundle: Bundle, paths: Sequence[str] | None) -> list[NDArray[Any]]:
    """Return fault-free recordings ``[T, D]``: those of files, or what the bundle keeps.

    Raises:
        ValueError: recordings of another array, or the bundle keeps some of its windows only.
    """
    if paths is None:
        return bundle.parts.recordings(bundle.layout.full_scale)
    from adaptfault.data.recordings import load

    found = []
    for path in paths:
        recordings = load(path).recordings
        if recordings.layout.shape != bundle.layout.shape:
            raise ValueError(
                f"{path}: {recordings.layout}, but the bundle is of {bundle.layout}; give"
                " fault-free recordings of this array"
            )
        found += list(recordings.frames)
    return found
