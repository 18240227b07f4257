"""adaptfault maintain: diagnoses new recordings of a robot, adapts its model, deploys or keeps
it."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from adaptfault.cli.options import (
    Commands,
    add_count_from,
    add_metrics,
    add_sign,
    add_trust,
    add_untested_code,
    command,
    emit,
    report_problems,
    say,
    trust,
)
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.streams import one_line

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance_report import MaintenanceReport

_EXAMPLE = """  adaptfault maintain robot.bundle today/
      recordings seen before are skipped
      exit code: 0 nothing to do, 1 faults that are handled, or a warning,
      2 a person is needed, 3 unusable input
  adaptfault maintain robot.bundle today/ --dry-run --report report.html
  adaptfault maintain robot.bundle selftest/ --after routine.json"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "maintain",
        "diagnose new recordings and update the model that the robot runs",
        _EXAMPLE,
    )
    parser.add_argument(
        "bundle",
        type=Read,
        metavar="BUNDLE",
        help="folder written by adaptfault train --out X.bundle",
    )
    parser.add_argument(
        "recordings",
        type=Read,
        nargs="+",
        metavar="RECORDINGS",
        help="file or folder of recordings",
    )
    parser.add_argument("--dry-run", action="store_true", help="report only, change nothing")
    parser.add_argument(
        "--budget", type=float, metavar="S", help="seconds that an adaptation may take"
    )
    parser.add_argument(
        "--after",
        type=Read,
        metavar="ROUTINE",
        help="the recordings are a log of this self-test (selftest --out): say what it left"
        " untested, and the next best recording",
    )
    add_untested_code(parser)
    parser.add_argument(
        "--report", type=Written, metavar="FILE", help="write the technician's report (HTML)"
    )
    add_count_from(parser)
    add_metrics(parser)
    add_trust(parser)
    add_sign(parser, "the bundle after the run")
    parser.set_defaults(run=run, decides=True)


def run(args: argparse.Namespace) -> int:
    """Maintain; the exit code gives the state of the sensor."""
    try:
        return _maintain(args)
    except Exception:
        if args.metrics:
            _write_failure(args)
        raise


def _maintain(args: argparse.Namespace) -> int:
    import sys

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance import maintain
    from adaptfault.robot.new_recordings import load_new_recordings
    from adaptfault.robot.routine import Routine

    routine = None if args.after is None else Routine.read(args.after)
    bundle = Bundle.open(args.bundle, **trust(args))
    incoming = load_new_recordings(bundle, args.recordings)
    report_problems(args, incoming.problems)
    report = maintain(
        bundle,
        incoming.frames,
        names=incoming.names,
        dry_run=args.dry_run,
        budget=args.budget,
        untested_code=args.untested_code,
        routine=routine,
        sign=args.sign,
        say=lambda text: say(args, text),
    )
    if args.trust and not args.sign and report.decision == "deployed" and not args.dry_run:
        what = "runs only where no key is asked for; give maintain --sign KEY, or sign the bundle"
        print(f"warning: version {report.version} is not signed and {what}", file=sys.stderr)
    code = report.exit_code
    for write in (_write_report, _write_metrics, _print):
        try:
            write(args, bundle, report)
        except Exception as error:  # the run is done, and its code says what was decided
            print(f"adaptfault maintain: error: {one_line(error)}", file=sys.stderr)
            code = max(code, 1)
    return code


def _print(args: argparse.Namespace, bundle: Bundle, report: MaintenanceReport) -> None:
    from diagnostics.decision.numbering import Numbering

    numbering = Numbering.from_layout(bundle.layout, args.count_from)
    emit(args, report.to_dict(), report.text(numbering))


def _write_report(args: argparse.Namespace, bundle: Bundle, report: MaintenanceReport) -> None:
    if not args.report:
        return
    from adaptfault.robot.technician_report import write_report

    write_report(args.report, bundle, run=report, count_from=args.count_from)


def _write_metrics(args: argparse.Namespace, bundle: Bundle, report: MaintenanceReport) -> None:
    if not args.metrics:
        return
    from adaptfault.robot.metrics import RobotMetrics, write_metrics
    from adaptfault.robot.technician_report import robot_name

    name = robot_name(bundle.path)
    write_metrics(args.metrics, [RobotMetrics.of(name, time.time(), bundle, report)])


def _write_failure(args: argparse.Namespace) -> None:
    """Write that the state of the robot is unknown."""
    from pathlib import Path

    from adaptfault.inspection.severity import UNKNOWN
    from adaptfault.robot.metrics import RobotMetrics, write_metrics
    from adaptfault.robot.technician_report import robot_name

    name = robot_name(Path(args.bundle))
    write_metrics(args.metrics, [RobotMetrics(name, time.time(), UNKNOWN)])
