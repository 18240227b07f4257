"""adaptfault check: the health of a data set, before anybody trains on it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Literal

from adaptfault.cli.command import option
from adaptfault.cli.inspecting import Inspecting, inspect_log, text_of, write_page
from adaptfault.cli.paths import Read, Written, WrittenFolder, WrittenRecordings
from adaptfault.cli.reading import report_range
from adaptfault.cli.shared_options import (
    cache_option,
    count_from_option,
    reference_option,
    untested_code_option,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.data_set import DataSetCheck
    from adaptfault.inspection.findings import FailOn
    from adaptfault.inspection.quick_statistics import Statistics


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
    shard: str | None = option(
        "I/N: keep what one pass tells of the I-th of N parts of the recordings in the file of"
        " --out, for --merge; N: make all N parts, keep each in the folder of --keep, and check"
        " the whole: a run that was killed goes on",
        "I/N",
    )
    keep: WrittenFolder | None = option("of the parts of --shard N", "FOLDER")
    jobs: int | None = option("with --shard N: processes that read side by side (default 1)", "N")
    dask: str | None = option(
        "with --shard N: a Dask scheduler whose workers read, as tcp://host:8786", "ADDRESS"
    )
    merge: bool = option("the paths are parts that --shard wrote: check them as one data set")
    sample: int | None = option(
        "check so many recordings, drawn at random, and say how many of all hold a fault at most",
        "N",
    )
    groups: Read | None = option(
        "what else divides the recordings, with which a fault may coincide: CSV table with the"
        " columns recording (its name) and one for each, as robot, session, day",
        "TABLE",
    )
    out: Written | None = option("write the result as JSON", "FILE")
    html: Written | None = option("write a page", "FILE")
    badge: Written | None = option("write a badge as SVG", "FILE")
    table: Written | None = option(
        "write the verdict of each cell in each recording as Parquet", "FILE"
    )
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
        from adaptfault.inspection.findings import FailOn

        fails = None if self.fail_on is None else FailOn.parse(self.fail_on)
        in_parts = self.shard or self.merge or self.keep or self.jobs or self.dask
        if self.quick or in_parts or self.sample is not None:
            self.quick = True
            return self._quick(fails)
        return self._full(fails)

    def _full(self, fails: FailOn | None) -> int:
        """Check a data set with a model of its cells."""
        from adaptfault.inspection.check_log import check_log
        from adaptfault.inspection.groupings import (
            coincide,
            dividing,
            groupings_of,
            read_groupings,
        )
        from adaptfault.inspection.naming import Naming

        if self.write_valid:
            from adaptfault.data.recordings.valid import refuse_foreign

            refuse_foreign(self.write_valid)
        if self.write_copy:
            from adaptfault.data.addresses import is_address
            from adaptfault.data.recordings.valid_copy import writer_of

            if len(self.recordings) > 1:
                given = len(self.recordings)
                raise ValueError(f"--write-copy takes one data set, got {given}: check each alone")
            if is_address(self.recordings[0]):
                raise ValueError("--write-copy takes a data set on this machine: copy it first")
            writer_of(self.write_copy, self.recordings[0])
        part = None if self.healthy is None else partial(_part, self.healthy)
        inspected = inspect_log(self, part)
        log = inspected.log
        if log.scan is not None and (self.write_valid or self.write_copy):
            raise ValueError(
                "--write-valid, --write-copy: got recordings with a scan of the read-out, expected"
                " readings alone; leave the scan out"
            )
        report_range(log)
        groupings = dict(dividing(groupings_of(log, self.recordings)))
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
        """Check a data set in one pass, a part of it, or merged parts."""
        from adaptfault.inspection.groupings import (
            coincide,
            dividing,
            groupings_of,
            read_groupings,
        )
        from adaptfault.inspection.quick import quick, quick_check
        from adaptfault.inspection.quick_statistics import Statistics

        self._refuse_beside_quick()
        log: Opened | None = None
        n_recordings = 0
        if self.keep:
            statistics = self._in_parts()
        elif self.merge:
            statistics = self._merged()
        else:
            is_part = bool(self.shard) or self.sample is not None
            log = self.open(self.recordings, select=self._selected if is_part else None)
            self.say_inferred(log.inferred)
            n_recordings = log.n_found
            divided = groupings_of(log, self.recordings)
            statistics = Statistics.of(log, divided)
            report_range(log)
        if self.shard and not self.keep:
            assert self.out is not None
            statistics.save(self.out)
            self.say(f"{len(statistics.naming.lengths)} recordings in {self.out}")
            return 0
        groupings = dict(dividing(statistics.groupings))
        if self.groups is not None:
            groupings |= read_groupings(self.groups, statistics.naming.recordings)
        found = quick(statistics)
        if statistics.classes is not None:
            groupings["class"] = statistics.classes
        also = coincide(found.inspection.diagnosis, groupings)
        findings = [
            replace(one, severity=self.untested_code) if one.name == "untested" else one
            for one in (*found.inspection.findings, *also)
        ]
        found = replace(found, inspection=replace(found.inspection, findings=tuple(findings)))
        source = ", ".join(self.recordings)
        clock = None if log is None else log.clock
        checked = quick_check(statistics, found, clock, grouped=bool(groupings), source=source)
        code = checked.severity if fails is None else checked.findings.failed(fails)
        notes = []
        if self.sample is not None and log is not None:
            from adaptfault.inspection.sample_bound import SampleBound

            bound = SampleBound.from_diagnosis(found.inspection.diagnosis, n_recordings)
            checked = replace(checked, sample=bound)
            notes.append(str(bound))
        _write_result(self, checked, statistics.classes)
        self._tell(checked, notes)
        return code

    def _merged(self) -> Statistics:
        """Return what parts tell together; one that is damaged is told, and the rest goes on."""
        from adaptfault.data.recordings import InputError
        from adaptfault.inspection.quick_statistics import Statistics

        parts = []
        problems = []
        for path in self.recordings:
            try:
                parts.append(Statistics.load(path))
            except InputError as error:
                problems.append(error)
        if not parts:
            raise problems[0]
        statistics = Statistics.joined(parts)
        self._tell_unread([str(problem) for problem in problems])
        return replace(statistics, unread=(*statistics.unread, *map(str, problems)))

    def _tell_unread(self, reasons: Sequence[str]) -> None:
        """Print why something could not be read; it makes the exit code 1 at least."""
        from adaptfault.data.recordings import Problem

        self.tell_problems([Problem("error", reason) for reason in reasons])

    def _in_parts(self) -> Statistics:
        """Return the statistics of a data set that is read in parts, which are kept."""
        from pathlib import Path

        from adaptfault.inspection.parts import Work, in_parts

        assert self.shard is not None
        assert self.keep is not None
        work = Work(tuple(self.recordings), self.how_to_open(), int(self.shard))
        statistics, there = in_parts(work, Path(self.keep), jobs=self.jobs or 1, dask=self.dask)
        self.say(f"{there} of {work.parts} parts were in {self.keep} already")
        self._tell_unread(statistics.unread)
        return statistics

    def _selected(self, n: int) -> Sequence[int]:
        """Return the numbers of the recordings of a shard, or of a sample, of ``n``."""
        if self.shard:
            number, of = _shard(self.shard)
            part = range(n * (number - 1) // of, n * number // of)
            if not part:
                raise ValueError(f"--shard {self.shard}: the data set has {n} recordings")
            return part
        assert self.sample is not None
        import random

        return random.Random(0).sample(range(n), min(n, self.sample))

    def _refuse_beside_quick(self) -> None:
        """Raise ValueError where options cannot be meant together."""
        for name in ("reference", "healthy", "html", "write_valid", "write_copy"):
            if getattr(self, name):
                typed = "--" + name.replace("_", "-")
                raise ValueError(f"{typed} needs tested cells: leave out --quick")
        if self.shard and self.shard.isdigit():
            if not self.keep or not int(self.shard):
                raise ValueError(f"--shard {self.shard} needs --keep FOLDER, and 1 part or more")
        elif self.keep or self.jobs or self.dask:
            raise ValueError("--keep, --jobs and --dask need --shard N, the number of all parts")
        elif self.shard and not self.out:
            raise ValueError("--shard I/N needs --out PART, the file for --merge")
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"--jobs {self.jobs}: expected 1 or more")
        if self.sample is not None and self.sample < 1:
            raise ValueError(f"--sample {self.sample}: expected 1 recording or more")
        if sum(map(bool, (self.shard, self.merge, self.sample))) > 1:
            raise ValueError("--shard, --merge and --sample: give one of them")

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
            told = numbering.text("\n".join([*notes, *checked.advice, str(findings)]))
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


def _shard(text: str) -> tuple[int, int]:
    """Return the number of a part, from 1, and how many there are."""
    number, _, of = text.partition("/")
    if not (number.isdigit() and of.isdigit() and 0 < int(number) <= int(of)):
        raise ValueError(f"--shard {text}: expected I/N, as 1/8 for the first of eight parts")
    return int(number), int(of)


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


def _write_result(args: Check, checked: DataSetCheck, classes: Sequence[str] | None) -> None:
    """Write the result, the badge and the table; ``classes``: of each recording."""
    from adaptfault.data.atomic import atomic_write

    if args.table:
        from adaptfault.inspection.verdict_table import write_table

        diagnosis = checked.inspection.diagnosis
        write_table(args.table, diagnosis, checked.naming.pads, classes)
    if args.out:
        atomic_write(args.out, json.dumps(checked.to_dict(), allow_nan=False).encode())
    if args.badge:
        atomic_write(args.badge, checked.badge().encode())


def _write(args: Check, log: Opened, checked: DataSetCheck, code: int, notes: list[str]) -> None:
    from adaptfault.inspection.naming import classes_of

    diagnosis = checked.inspection.diagnosis
    _write_result(args, checked, classes_of(log))
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
