"""adaptfault check: the health of a data set, before anybody trains on it."""

from __future__ import annotations

import json
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import option
from adaptfault.cli.inspecting import Inspecting, inspect_log, text_of, write_page
from adaptfault.cli.paths import Read, Written, WrittenRecordings
from adaptfault.cli.reading import report_range, summary_of
from adaptfault.cli.shared_options import (
    cache_option,
    count_from_option,
    reference_option,
    untested_code_option,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.data_set import DataSetCheck
    from adaptfault.inspection.inspection import Inspection


class Check(Inspecting):
    """Check the health of a data set before anybody trains on it."""

    example = """\
  adaptfault check my_lerobot_data/ --html health.html --badge health.svg
  adaptfault check grasps.zarr --healthy 0:20 --write-valid valid.zarr
      the first 20 recordings are known to be healthy: the others are compared with them
      exit code: 0 fine; 1 single cells, or something to know before training; 2 a wire, or
      a tenth of the cells; 3 unusable input"""
    one_of = ("reference", "healthy")

    reference: list[Read] | None = reference_option()
    healthy: str | None = option(
        "recordings of the data set that are known to be healthy, as 0:20 for the first 20",
        "FIRST:LAST",
    )
    out: Written | None = option("write the result as JSON", "FILE")
    html: Written | None = option("write a page", "FILE")
    badge: Written | None = option("write a badge as SVG", "FILE")
    write_valid: WrittenRecordings | None = option(
        "write which readings are valid: .npz, .parquet, .zarr or .h5", "FILE"
    )
    count_from: int = count_from_option()
    no_cache: bool = cache_option()
    untested_code: int = untested_code_option()

    def run(self) -> int:
        """Check a data set; the exit code says how bad it is."""
        from adaptfault.inspection.severity import worst
        from diagnostics.decision.numbering import Numbering

        if self.write_valid:
            from adaptfault.data.recordings.valid import refuse_foreign

            refuse_foreign(self.write_valid)
        part = None if self.healthy is None else partial(_part, self.healthy)
        inspected = inspect_log(self, part)
        log = inspected.log
        report_range(log)
        inspection = inspected.inspection
        checked = _checked(self, log, inspection)
        reasons = inspected.reasons(self.untested_code)
        code = max(worst(reasons), 1 if checked.harms else 0)
        notes = [reason.text for reason in reasons if reason.text] + list(checked.remarks)
        _write(self, log, checked, code, notes)
        numbering = Numbering.from_layout(log.layout, self.count_from)
        summary = numbering.text(str(checked.summary))
        text = text_of(inspection.diagnosis, notes, self.count_from)
        self.emit(checked.to_dict(), f"{summary}\n\n{text}")
        return code


add = Check.add


def _part(text: str, log: Opened) -> Recordings:
    """Return the recordings that are known to be healthy."""
    from adaptfault.data.recordings import Recordings

    first, divided, last = text.partition(":")
    if not divided or not (first or "0").isdigit() or not (last or "0").isdigit():
        raise ValueError(f"--healthy {text}: expected FIRST:LAST, as 0:20 for the first 20")
    begin = int(first or 0)
    end = int(last) if last else len(log)
    if not begin < end <= len(log):
        raise ValueError(
            f"--healthy {text}: the data set has {len(log)} recordings, numbered from 0"
        )
    frames = tuple(islice(iter(log), begin, end))
    return Recordings(frames, log.layout, names=log.names[begin:end])


def _checked(args: Check, log: Opened, inspection: Inspection) -> DataSetCheck:
    from adaptfault.inspection.data_set import DataSetCheck, starts_and_tares
    from diagnostics.preprocessing.readings import RecordingBlocks
    from diagnostics.sensor.shared import measured

    summary = summary_of(log)

    def recordings() -> Iterator[NDArray[Any]]:
        for frames in log:
            yield from measured(RecordingBlocks([frames]), log.layout)

    begun, tared = starts_and_tares(recordings, log.names, log.layout)
    return DataSetCheck(inspection, summary, log.clock, getattr(args, "left_out", 0), begun, tared)


def _write(args: Check, log: Opened, checked: DataSetCheck, code: int, notes: list[str]) -> None:
    from adaptfault.data.atomic import atomic_write

    diagnosis = checked.inspection.diagnosis
    if args.out:
        atomic_write(args.out, json.dumps(checked.to_dict(), allow_nan=False).encode())
    if args.badge:
        atomic_write(args.badge, checked.badge().encode())
    compared = bool(args.reference or args.healthy)
    write_page(args, diagnosis, code, notes, compared=compared)
    if args.write_valid:
        from adaptfault.data.recordings.valid import valid_masks, write_valid

        masks = valid_masks(iter(log), diagnosis.faults, log.layout)
        write_valid(args.write_valid, masks, log.names, log.layout, log.origins)
