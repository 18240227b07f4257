"""adaptfault diagnose: recordings in; verdicts, root causes and untested cells out."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from adaptfault.cli.options import (
    Commands,
    add_recordings,
    add_trust,
    add_untested_code,
    check_scale,
    command,
    emit,
    fit_diagnoser,
    fitting_bar,
    load_recordings,
    open_reported,
    report_inferred,
    report_range,
    say,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.inspection import Finding, Inspection
    from adaptfault.inspection.severity import Reason
    from diagnostics import Diagnosis, SelfDiagnosis

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

_TOLD_BY_THE_DIAGNOSIS = ("static_load", "frozen", "lost_frames")
# of a map, which is followed by the summary if it has more: the first line has left the screen
_ROWS = 24


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "diagnose", "find the faulty cells and wires in a log of recordings", _EXAMPLE
    )
    add_recordings(parser, labels=False)
    parser.add_argument(
        "--reference",
        nargs="+",
        metavar="FILE",
        help="fault-free recordings of the same array, or a bundle",
    )
    parser.add_argument("--out", metavar="FILE", help="write the diagnosis as JSON")
    parser.add_argument("--picture", metavar="FILE", help="write the verdict map as PNG")
    parser.add_argument("--html", metavar="FILE", help="write the technician's page")
    add_untested_code(parser)
    add_trust(parser)
    parser.set_defaults(run=run, writes=("out", "picture", "html"))


def run(args: argparse.Namespace) -> int:
    """Diagnose; the exit code says who has to act, as that of maintain."""
    from dataclasses import asdict

    from adaptfault.inspection.severity import worst

    bundle = _bundle(args)
    healthy = load_recordings(args, args.reference) if args.reference and bundle is None else None
    diagnoser = None if bundle is None else bundle.diagnoser()
    known = diagnoser or healthy
    log = open_reported(args, args.recordings, None if known is None else known.layout)
    report_inferred(args, log.inferred)
    if healthy is not None:  # fitted once the log is known to be of the same array
        diagnoser = fit_diagnoser(args, healthy)
    inspection = _inspected(args, log, diagnoser, bundle, _healthy(bundle, healthy))
    report_range(log)
    diagnosis = inspection.diagnosis
    findings = inspection.findings
    reasons = _reasons(diagnosis, findings, bundle, args.untested_code)
    code = worst(reasons)
    notes = [reason.text for reason in reasons if reason.text]
    _write(args, diagnosis, code, notes)
    found = {
        **diagnosis.to_dict(),
        **inspection.told,
        "findings": [asdict(finding) for finding in findings],
    }
    emit(args, found, "\n".join([text_of(diagnosis), *notes]))
    return code


def _write(args: argparse.Namespace, diagnosis: Diagnosis, code: int, notes: list[str]) -> None:
    """Write the files that the options ask for; the page says what the exit code and the notes
    say."""
    from adaptfault.data.atomic import atomic_write

    if args.out:
        atomic_write(args.out, json.dumps(diagnosis.to_dict(), allow_nan=False).encode())
    if args.picture:
        diagnosis.plot().savefig(args.picture, dpi=150)
    if args.html:
        from adaptfault.evaluation.html_diagnosis import write_diagnosis

        name = ", ".join(args.recordings)
        reference = bool(args.reference)
        write_diagnosis(
            args.html, diagnosis, name=name, reference=reference, code=code, notes=notes
        )


def _inspected(
    args: argparse.Namespace,
    log: Opened,
    diagnoser: SelfDiagnosis | None,
    bundle: Bundle | None,
    healthy: list[NDArray[Any]] | None,
) -> Inspection:
    """Inspect a log, as the version of the bundle that runs reads it."""
    from adaptfault.inspection.long_log import inspect_parts
    from diagnostics import SelfDiagnosis

    is_known = diagnoser is not None
    cold = diagnoser or SelfDiagnosis(log.layout)
    version = None if bundle is None else bundle.active()

    def parts() -> Iterator[list[NDArray[Any]]]:
        for i, part in enumerate(log.parts()):
            if is_known and i == 0:
                check_scale(args.recordings[0], part, log.layout)
            yield part if version is None else [version.undo(frames) for frames in part]

    say(args, f"diagnosing {len(log)} recording{'s' * (len(log) != 1)}")
    with fitting_bar(args) as advance:
        return inspect_parts(
            parts(), cold, reference=healthy, n_recordings=len(log), progress=advance
        )


def _healthy(bundle: Bundle | None, recordings: Recordings | None) -> list[NDArray[Any]] | None:
    """Return the healthy recordings that were given, else those of a bundle; None without
    either."""
    from adaptfault.data.windows import recordings_of

    if recordings is not None:
        return list(recordings)
    return (
        None if bundle is None else list(recordings_of(bundle.parts.adapter().train, bundle.layout))
    )


def _bundle(args: argparse.Namespace) -> Bundle | None:
    """Return the bundle that is given as reference; None for recordings, and without a
    reference."""
    from adaptfault.cli.trained_model import open_bundle

    if len(args.reference or []) == 1:
        return open_bundle(args, args.reference[0])
    if args.trust:
        raise ValueError("--trust needs a bundle: --reference BUNDLE")
    return None


def _reasons(
    diagnosis: Diagnosis, findings: Sequence[Finding], bundle: Bundle | None, untested_code: int
) -> list[Reason]:
    """Return why somebody has to act, in the order of the findings; without text what the diagnosis
    tells itself."""
    from adaptfault.inspection.severity import Reason

    reasons = [Reason(*_faults(diagnosis, bundle))]
    for finding in findings:
        if finding.name in ("fault", "wire"):
            continue
        severity = untested_code if finding.name == "untested" else finding.severity
        text = "" if finding.name in _TOLD_BY_THE_DIAGNOSIS else finding.reason
        if finding.name in ("rewired", "replaced_pad"):
            text += "; the verdicts are those with the readings put back"
        reasons.append(Reason(severity, text))
    return reasons


def _faults(diagnosis: Diagnosis, bundle: Bundle | None) -> tuple[int, str]:
    """Return the severity of the faults, and a sentence where the bundle's version does without
    their cells."""
    from adaptfault.inspection.severity import of_faults
    from adaptfault.robot.sensor_state import SensorState, unhandled_cells

    severity = of_faults(diagnosis)
    if severity < 2 or bundle is None:
        return severity, ""
    version = bundle.active()
    if (
        unhandled_cells(bundle, diagnosis.fault_set, version)
        or SensorState.of(bundle).exit_code >= 2
    ):
        return severity, ""
    return 1, f"handled: version {version.number} of {bundle.path} runs without these cells"


def text_of(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as text, with what would test the other cells."""
    lines = str(diagnosis).splitlines()
    lines += [f"to test more: {touch}" for touch in diagnosis.coverage.advice[:5]]
    if diagnosis.layout.rows > _ROWS:
        lines.append(lines[0])
    return "\n".join(lines)
