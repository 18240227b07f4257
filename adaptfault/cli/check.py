"""adaptfault check: the health of a data set, before anybody trains on it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Literal

from adaptfault.cli.command import option
from adaptfault.cli.inspecting import Inspecting, inspect_log, text_of, write_page
from adaptfault.cli.paths import Read, Written, WrittenRecordings
from adaptfault.cli.reading import report_range
from adaptfault.cli.shared_options import (
    cache_option,
    count_from_option,
    reference_option,
    untested_code_option,
)

if TYPE_CHECKING:
    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.data_set import DataSetCheck
    from adaptfault.inspection.findings import FailOn


class Check(Inspecting):
    """Check the health of a data set before anybody trains on it."""

    example = """\
  adaptfault check my_lerobot_data/ --html health.html --badge health.svg
  adaptfault check grasps.zarr --healthy 0:20 --write-valid valid.zarr
      the first 20 recordings are known to be healthy: the others are compared with them
  adaptfault check my_lerobot_data/ --format github --fail-on error
      in CI; adaptfault explain CODE says what a code means
      exit code: 0 fine; 1 single cells, or something to know before training; 2 a wire, or
      a tenth of the cells; 3 unusable input"""
    one_of = ("reference", "healthy")

    reference: list[Read] | None = reference_option()
    healthy: str | None = option(
        "recordings of the data set that are known to be healthy, as 0:20 for the first 20",
        "FIRST:LAST",
    )
    quick: bool = option(
        "one pass over the readings, without a model of the cells: finds what holds a value in some"
        " recordings; no cell is tested"
    )
    groups: Read | None = option(
        "what else divides the recordings, with which a fault may coincide: CSV table with the"
        " columns recording (its name) and one for each, as robot, session, day",
        "TABLE",
    )
    out: Written | None = option("write the result as JSON", "FILE")
    html: Written | None = option("write a page", "FILE")
    badge: Written | None = option("write a badge as SVG", "FILE")
    write_valid: WrittenRecordings | None = option(
        "write which readings are valid: .npz, .parquet, .zarr or .h5", "FILE"
    )
    write_copy: WrittenRecordings | None = option(
        "write a copy of a LeRobot data set, a Parquet or HDF5 file or a Zarr store, with which of"
        " its readings are valid; the statistics of LeRobot are then those of valid readings",
        "PATH",
    )
    count_from: int = count_from_option()
    no_cache: bool = cache_option()
    untested_code: int = untested_code_option()
    format: Literal["text", "github", "markdown", "json"] = option(
        "how the result is printed: github as annotations of GitHub Actions, markdown as a section"
        " for a data-set card (default text)",
        default="text",
    )
    fail_on: str | None = option(
        "exit code 0 unless one of these is found: notice, warning, error, never, or codes as"
        " TOUCH-103 and TOUCH-12 (all that begin so), divided by commas; what was not tested or"
        " read fails in any case",
        "WHAT",
    )

    def run(self) -> int:
        """Check a data set; the exit code says how bad it is."""
        from adaptfault.inspection.check_log import check_log
        from adaptfault.inspection.findings import FailOn
        from adaptfault.inspection.groupings import coincide, data_sets_of, read_groupings
        from adaptfault.inspection.naming import Naming

        fails = None if self.fail_on is None else FailOn.parse(self.fail_on)
        if self.quick:
            return self._quick(fails)
        if self.write_valid:
            from adaptfault.data.recordings.valid import refuse_foreign

            refuse_foreign(self.write_valid)
        if self.write_copy:
            from adaptfault.data.recordings.valid_copy import writer_of

            if len(self.recordings) > 1:
                given = len(self.recordings)
                raise ValueError(f"--write-copy takes one data set, got {given}: check each alone")
            writer_of(self.write_copy, self.recordings[0])
        part = None if self.healthy is None else partial(_part, self.healthy)
        inspected = inspect_log(self, part)
        log = inspected.log
        report_range(log)
        groupings = dict(data_sets_of(log, self.recordings))
        if self.groups is not None:
            groupings |= read_groupings(self.groups, log.names)
        found = inspected.inspection
        also = coincide(found.diagnosis, groupings)
        found = replace(found, findings=(*found.findings, *also))
        named = Naming.of(log).of_inspection(found)
        inspected = replace(inspected, inspection=named)
        judged = replace(named, findings=inspected.judged(self.untested_code))
        checked = check_log(
            log,
            judged,
            left_out=self.left_out,
            compared=bool(self.reference or self.healthy),
            grouped=bool(groupings),
            source=", ".join(self.recordings),
        )
        code = checked.severity if fails is None else checked.findings.failed(fails)
        notes = [one.text for one in inspected.reasons(self.untested_code) if one.text]
        notes += [*checked.remarks, *checked.advice]
        _write(self, log, checked, code, notes)
        self._tell(checked, notes)
        return code

    def _quick(self, fails: FailOn | None) -> int:
        """Check a data set in one pass."""
        from adaptfault.inspection.check_log import check_log, classes_of
        from adaptfault.inspection.groupings import coincide, data_sets_of, read_groupings
        from adaptfault.inspection.naming import Naming
        from adaptfault.inspection.quick import quick

        self._refuse_beside_quick()
        log = self.open(self.recordings)
        self.say_inferred(log.inferred)
        report_range(log)
        groupings = dict(data_sets_of(log, self.recordings))
        if self.groups is not None:
            groupings |= read_groupings(self.groups, log.names)
        classes = classes_of(log)
        found = quick(log, classes)
        if classes is not None:
            groupings["class"] = classes
        also = coincide(found.inspection.diagnosis, groupings)
        findings = [
            replace(one, severity=self.untested_code) if one.name == "untested" else one
            for one in (*found.inspection.findings, *also)
        ]
        found = replace(found, inspection=replace(found.inspection, findings=tuple(findings)))
        checked = check_log(
            log,
            found.named(Naming.of(log)),
            left_out=self.left_out,
            grouped=bool(groupings),
            source=", ".join(self.recordings),
        )
        code = checked.severity if fails is None else checked.findings.failed(fails)
        _write(self, log, checked, code, [])
        self._tell(checked, [])
        return code

    def _refuse_beside_quick(self) -> None:
        """Raise ValueError where an option needs tested cells."""
        for name in ("reference", "healthy", "html", "write_valid", "write_copy"):
            if getattr(self, name):
                typed = "--" + name.replace("_", "-")
                raise ValueError(f"{typed} needs tested cells: leave out --quick")

    def _tell(self, checked: DataSetCheck, notes: list[str]) -> None:
        """Print the result in the form that was asked for."""
        from adaptfault.inspection.findings import with_codes
        from diagnostics.decision.numbering import Numbering

        findings = checked.findings
        numbering = Numbering.from_layout(checked.layout, self.count_from)
        if self.format == "github":
            text = findings.github(numbering, checked.advice)
        elif self.format == "markdown":
            text = findings.markdown(numbering, checked.advice)
        elif self.quick:
            told = numbering.text("\n".join([*map(str, checked.advice), str(findings)]))
            text = f"{numbering.text(checked.naming.text(str(checked.summary)))}\n\n{told}"
        else:
            say = checked.naming.text
            told = text_of(checked.inspection.diagnosis, notes, self.count_from, say)
            told = with_codes(told, findings, numbering.text)
            left = [f"not checked: {numbering.text(one.what)}" for one in findings.unchecked]
            summary = numbering.text(say(str(checked.summary)))
            if checked.naming.pads:
                pads = enumerate(checked.naming.pads, self.count_from)
                told_pads = ", ".join(f"{number} {name}" for number, name in pads)
                summary += f"\n{'pads':12s} {told_pads}"
            text = "\n".join([f"{summary}\n\n{told}", *left, findings.summary()])
        self.json |= self.format == "json"
        if self.json:
            self.emit(checked.to_dict(), text)
        else:
            self.emit({}, text)


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


def _write(args: Check, log: Opened, checked: DataSetCheck, code: int, notes: list[str]) -> None:
    from adaptfault.data.atomic import atomic_write

    diagnosis = checked.inspection.diagnosis
    if args.out:
        atomic_write(args.out, json.dumps(checked.to_dict(), allow_nan=False).encode())
    if args.badge:
        atomic_write(args.badge, checked.badge().encode())
    compared = bool(args.reference or args.healthy)
    write_page(args, diagnosis, code, notes, compared=compared, of_a_data_set=True)
    if args.write_valid:
        from adaptfault.data.recordings.valid import valid_masks, write_valid

        masks = valid_masks(iter(log), diagnosis.faults, log.layout)
        write_valid(args.write_valid, masks, log.names, log.layout, log.origins)
    if args.write_copy:
        from adaptfault.data.recordings.valid import valid_masks
        from adaptfault.data.recordings.valid_copy import write_copy

        masks = valid_masks(iter(log), diagnosis.faults, log.layout)
        write_copy(args.write_copy, args.recordings[0], masks, log.layout, log.origins)
