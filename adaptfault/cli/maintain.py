"""adaptfault maintain: diagnoses new recordings of a robot, adapts its model, deploys or keeps
it."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from adaptfault.cli.command import argument, option
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.shared_options import (
    Signing,
    bundle_argument,
    count_from_option,
    lines_held_option,
    metrics_option,
    untested_code_option,
)
from adaptfault.cli.streams import one_line

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance_report import MaintenanceReport


class Maintain(Signing):
    """Diagnose new recordings and update the model that the robot runs."""

    example = """  adaptfault maintain robot.bundle today/
      recordings seen before are skipped
      exit code: 0 nothing to do, 1 faults that are handled, or a warning,
      2 a person is needed, 3 unusable input
  adaptfault maintain robot.bundle today/ --dry-run --report report.html
  adaptfault maintain robot.bundle selftest/ --after routine.json"""
    decides = True

    bundle: Read = bundle_argument()
    recordings: list[Read] = argument("file or folder of recordings", "RECORDINGS")
    dry_run: bool = option("report only, change nothing")
    budget: float | None = option("seconds that an adaptation may take", "S")
    after: Read | None = option(
        "the recordings are a log of this self-test (selftest --out): say what it left"
        " untested, and the next best recording",
        "ROUTINE",
    )
    untested_code: int = untested_code_option()
    report: Written | None = option("write the technician's report (HTML)", "FILE")
    count_from: int = count_from_option()
    lines_held: bool = lines_held_option()
    metrics: Written | None = metrics_option()

    def run(self) -> int:
        """Maintain; the exit code gives the state of the sensor."""
        try:
            return _maintain(self)
        except Exception:
            if self.metrics:
                _write_failure(self.bundle, self.metrics)
            raise


add = Maintain.add


def _maintain(args: Maintain) -> int:
    import sys

    from adaptfault.robot.maintenance import maintain
    from adaptfault.robot.new_recordings import load_new_recordings
    from adaptfault.robot.routine import Routine

    routine = None if args.after is None else Routine.read(args.after)
    bundle = args.opened(args.bundle)
    incoming = load_new_recordings(bundle, args.recordings)
    args.tell_problems(incoming.problems)
    scan = incoming.scan
    if scan is not None:
        scan = replace(scan, holds_lines=args.lines_held or None)
    report = maintain(
        bundle,
        incoming.frames,
        names=incoming.names,
        dry_run=args.dry_run,
        budget=args.budget,
        untested_code=args.untested_code,
        routine=routine,
        scan=scan,
        sign=args.sign,
        say=args.say,
    )
    if args.trust and not args.sign and report.decision == "deployed" and not args.dry_run:
        what = "runs only where no key is asked for; give maintain --sign KEY, or sign the bundle"
        print(f"warning: version {report.version} is not signed and {what}", file=sys.stderr)
    code = report.exit_code
    for write in (_write_report, _write_metrics, _print):
        try:
            write(args, bundle, report)
        except Exception as error:  # the run is done, and its code says what was decided
            args.complain(f"error: {one_line(error)}")
            code = max(code, 1)
    return code


def _print(args: Maintain, bundle: Bundle, report: MaintenanceReport) -> None:
    from diagnostics.decision.numbering import Numbering

    numbering = Numbering.from_layout(bundle.layout, args.count_from)
    args.emit(report.to_dict(), report.text(numbering))


def _write_report(args: Maintain, bundle: Bundle, report: MaintenanceReport) -> None:
    if not args.report:
        return
    from adaptfault.robot.technician_report import write_report

    write_report(args.report, bundle, run=report, count_from=args.count_from)


def _write_metrics(args: Maintain, bundle: Bundle, report: MaintenanceReport) -> None:
    if not args.metrics:
        return
    from adaptfault.robot.metrics import RobotMetrics, write_metrics
    from adaptfault.robot.technician_report import robot_name

    name = robot_name(bundle.path)
    write_metrics(args.metrics, [RobotMetrics.of(name, time.time(), bundle, report)])


def _write_failure(bundle: str, metrics: str) -> None:
    """Write that the state of the robot is unknown."""
    from pathlib import Path

    from adaptfault.inspection.severity import UNKNOWN
    from adaptfault.robot.metrics import RobotMetrics, write_metrics
    from adaptfault.robot.technician_report import robot_name

    name = robot_name(Path(bundle))
    write_metrics(metrics, [RobotMetrics(name, time.time(), UNKNOWN)])
