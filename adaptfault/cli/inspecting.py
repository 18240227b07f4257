"""What the commands that inspect a log share: the reference, the inspection, the reasons."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from adaptfault.cli.fitting import fit_diagnoser, fitting_bar
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import (
    Trusting,
    cache_option,
    lines_held_option,
    reference_option,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.data.recordings import Opened, Recordings
    from adaptfault.inspection.result import Finding, Inspection
    from adaptfault.inspection.severity import Reason
    from diagnostics import Diagnosis, SelfDiagnosis

# of a map, which is followed by the summary if it has more: the first line has left the screen
_ROWS = 24


@dataclass(frozen=True, eq=False)
class InspectedLog:
    """A log, what was found in it, and the bundle that it was inspected with."""

    log: Opened
    inspection: Inspection
    bundle: Bundle | None

    def reasons(self, untested_code: int) -> list[Reason]:
        """Return why somebody has to act; ``untested_code``: severity of a log that tests
        nothing."""
        return _reasons(self.inspection.diagnosis, self.judged(untested_code), self.bundle)

    def judged(self, untested_code: int) -> tuple[Finding, ...]:
        """Return the findings, each as bad as the bundle and ``untested_code`` leave it."""
        of_faults, _ = _faults(self.inspection.diagnosis, self.bundle)
        severities = {"fault": of_faults, "wire": of_faults, "untested": untested_code}
        return tuple(
            replace(one, severity=severities.get(one.name, one.severity))
            for one in self.inspection.findings
        )


class Inspecting(Trusting, Reading):
    """What a command has that inspects a log."""

    reference: list[Read] | None = reference_option()
    no_cache: bool = cache_option()
    lines_held: bool = lines_held_option()


class Paged(Protocol):
    """What it has where it writes a page."""

    recordings: list[Read]
    html: Written | None
    count_from: int


def inspect_log(
    args: Inspecting, part: Callable[[Opened], Recordings] | None = None
) -> InspectedLog:
    """Open a log and inspect it, with the reference that the options state.

    Args:
        args: the command.
        part: returns the recordings of the log that are healthy, in place of a reference.
    """
    bundle = _bundle(args)
    healthy = args.load(args.reference) if args.reference and bundle is None else None
    diagnoser = None if bundle is None else bundle.diagnoser()
    known = diagnoser or healthy
    log = args.open(args.recordings, None if known is None else known.layout)
    args.say_inferred(log.inferred)
    if part is not None:
        healthy = part(log)
    if healthy is not None:  # fitted once the log is known to be of the same array
        beside = None if args.no_cache or not args.reference else args.reference[0]
        diagnoser = fit_diagnoser(args, healthy, beside=beside)
    inspection = _inspected(args, log, diagnoser, bundle, _healthy(bundle, healthy))
    if log.scan is not None:
        from adaptfault.inspection.scanned import inspection_with_scan

        scan = replace(log.scan, holds_lines=args.lines_held or None)
        inspection, found = inspection_with_scan(inspection, scan)
        args.say(f"scan: {found.summary}")
    return InspectedLog(log, inspection, bundle)


def write_page(
    args: Paged,
    diagnosis: Diagnosis,
    code: int,
    notes: list[str],
    *,
    compared: bool,
    of_a_data_set: bool = False,
) -> None:
    """Write the page that ``--html`` asks for; it says what the exit code and the notes say."""
    if not args.html:
        return
    from adaptfault.pages.html_diagnosis import HEADLINES, OF_A_DATA_SET, write_diagnosis

    name = ", ".join(args.recordings)
    write_diagnosis(
        args.html,
        diagnosis,
        name=name,
        reference=compared,
        code=code,
        notes=notes,
        count_from=args.count_from,
        headlines=OF_A_DATA_SET if of_a_data_set else HEADLINES,
    )


def _inspected(
    args: Inspecting,
    log: Opened,
    diagnoser: SelfDiagnosis | None,
    bundle: Bundle | None,
    healthy: list[NDArray[Any]] | None,
) -> Inspection:
    """Inspect a log, as the version of the bundle that runs reads it."""
    from adaptfault.data.recordings.check import check_scale
    from adaptfault.data.recordings.doubts import copies
    from adaptfault.inspection.long_log import inspect_parts
    from adaptfault.inspection.naming import classes_of
    from diagnostics import SelfDiagnosis

    is_known = diagnoser is not None
    cold = diagnoser or SelfDiagnosis(log.layout)
    version = None if bundle is None else bundle.active()

    def parts() -> Iterator[list[NDArray[Any]]]:
        for i, part in enumerate(log.parts()):
            if i == 0:  # of a longer log, those of the first part
                args.tell_problems(copies(part, log.names))
            if is_known and i == 0:
                args.tell_problems(check_scale(args.recordings[0], part, log.layout))
            yield part if version is None else [version.undo(frames) for frames in part]

    args.say(f"diagnosing {len(log)} recording{'s' * (len(log) != 1)}")
    with fitting_bar(args) as advance:
        return inspect_parts(
            parts(),
            cold,
            reference=healthy,
            lengths=log.lengths,
            classes=classes_of(log),
            progress=advance,
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


def _bundle(args: Inspecting) -> Bundle | None:
    """Return the bundle that is given as reference; None for recordings, and without a
    reference."""
    from adaptfault.cli.trained_model import open_bundle

    if args.reference and len(args.reference) == 1:
        return open_bundle(args, args.reference[0])
    if args.trust:
        raise ValueError("--trust needs a bundle: --reference BUNDLE")
    return None


def _reasons(
    diagnosis: Diagnosis, findings: Sequence[Finding], bundle: Bundle | None
) -> list[Reason]:
    """Return why somebody has to act, in the order of the findings; without text what the diagnosis
    tells itself."""
    from adaptfault.inspection.severity import Reason

    told = {load.reason for load in diagnosis.static_loads}
    told |= {one.reason for one in diagnosis.transport}
    reasons = [Reason(*_faults(diagnosis, bundle))]
    for finding in findings:
        if finding.name in ("fault", "wire"):
            continue
        text = "" if finding.reason in told else finding.reason
        if finding.name in ("rewired", "replaced_pad"):
            text += "; the verdicts are those with the readings put back"
        reasons.append(Reason(finding.severity, text))
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


def text_of(
    diagnosis: Diagnosis,
    notes: Sequence[str],
    count_from: int,
    say: Callable[[str], str] = str,
) -> str:
    """Return the diagnosis as text, with what would test the other cells, and the notes below.

    ``say`` calls the pads of a sentence by their names.
    """
    from diagnostics.decision.numbering import Numbering

    numbering = Numbering.from_layout(diagnosis.layout, count_from)
    lines = diagnosis.text(count_from).splitlines()
    advice = diagnosis.coverage.advice[:5]
    lines += [f"to test more: {numbering.text(say(touch))}" for touch in advice]
    if diagnosis.layout.rows > _ROWS:
        lines.append(lines[0])
    return "\n".join([*lines, *map(numbering.text, notes)])
