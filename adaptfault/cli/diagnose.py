"""adaptfault diagnose: recordings in; verdicts, root causes and untested cells out."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from adaptfault.cli.inspecting import add_reference, inspect_log, text_of, write_page
from adaptfault.cli.options import (
    Commands,
    add_cache,
    add_count_from,
    add_recordings,
    add_trust,
    add_untested_code,
    command,
    emit,
    report_range,
)
from adaptfault.cli.paths import Written

if TYPE_CHECKING:
    from diagnostics import Diagnosis

_EXAMPLE = """\
  adaptfault diagnose today/ --reference healthy/ --out diagnosis.json --html diagnosis.html
      without --reference the first half of 32 or more recordings is the reference; with fewer,
      each cell is compared with the cells around it
  adaptfault diagnose today/ --reference robot.bundle
      the healthy model of the bundle
      exit code: 0 nothing to do; 1 watch: single cells, faults that the bundle's version
      excludes, nothing tested, an object that lies still, a frozen stream, another gain or
      offset of the whole sensor or of a pad; 2 a person is needed: a wire, exchanged
      wires, or a tenth of the cells; 3 unusable input"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "diagnose", "find the faulty cells and wires in a log of recordings", _EXAMPLE
    )
    add_recordings(parser, labels=False)
    add_reference(parser)
    parser.add_argument("--out", type=Written, metavar="FILE", help="write the diagnosis as JSON")
    parser.add_argument(
        "--picture", type=Written, metavar="FILE", help="write the verdict map as PNG"
    )
    parser.add_argument("--html", type=Written, metavar="FILE", help="write the technician's page")
    add_count_from(parser)
    add_cache(parser)
    add_untested_code(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Diagnose; the exit code says who has to act, as that of maintain."""
    from dataclasses import asdict

    from adaptfault.inspection.severity import worst

    inspected = inspect_log(args)
    report_range(inspected.log)
    inspection = inspected.inspection
    diagnosis = inspection.diagnosis
    reasons = inspected.reasons(args.untested_code)
    code = worst(reasons)
    notes = [reason.text for reason in reasons if reason.text]
    _write(args, diagnosis, code, notes)
    found = {
        **diagnosis.to_dict(),
        **inspection.told,
        "findings": [asdict(finding) for finding in inspection.findings],
    }
    emit(args, found, text_of(diagnosis, notes, args.count_from))
    return code


def _write(args: argparse.Namespace, diagnosis: Diagnosis, code: int, notes: list[str]) -> None:
    """Write the files that the options ask for; the page says what the exit code and the notes
    say."""
    from adaptfault.data.atomic import atomic_figure, atomic_write

    if args.out:
        atomic_write(args.out, json.dumps(diagnosis.to_dict(), allow_nan=False).encode())
    if args.picture:
        atomic_figure(args.picture, diagnosis.plot(count_from=args.count_from), dpi=150)
    if args.html:
        write_page(args, diagnosis, code, notes, compared=bool(args.reference))
