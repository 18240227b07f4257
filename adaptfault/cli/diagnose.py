"""adaptfault diagnose: recordings in; verdicts, root causes and untested cells out."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from adaptfault.cli.options import (
    Commands,
    add_recordings,
    add_trust,
    add_untested_code,
    command,
    emit,
    fit_diagnoser,
    fitting_bar,
    load_recordings,
    progress,
    report_inferred,
    stream_recordings,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.data.recordings import Recordings
    from adaptfault.data.recordings.blocks import Stream
    from adaptfault.robot.bundle import Bundle
    from adaptfault.robot.changed_readings import ChangedReadings
    from diagnostics import Diagnosis, SelfDiagnosis
    from diagnostics.evidence.sensor_change import SensorChange

_EXAMPLE = """  adaptfault diagnose today/ --reference healthy/ --out diagnosis.json --html diagnosis.html
      without --reference the first half of 32 or more recordings is the reference; with fewer, each cell is compared
      with the cells around it
  adaptfault diagnose today/ --reference robot.bundle
      the healthy model of the bundle
      exit code: 0 nothing to do; 1 watch: single cells, faults that the bundle's version excludes, nothing tested, an
      object that lies still, a frozen stream, another gain or offset of the whole sensor or of a pad;
      2 a person is needed: a wire, exchanged wires, or a tenth of the cells; 3 unusable input"""

Undo = Callable[["NDArray[Any]"], "NDArray[Any]"]  # returns readings as the running version takes them

_ROWS = 24  # of a map, which is followed by the summary if it has more: the first line has left the screen


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "diagnose", "find the faulty cells and wires in a log of recordings", _EXAMPLE)
    add_recordings(parser, labels=False)
    parser.add_argument(
        "--reference", nargs="+", metavar="FILE", help="fault-free recordings of the same array, or a bundle"
    )
    parser.add_argument("--out", metavar="FILE", help="write the diagnosis as JSON")
    parser.add_argument("--picture", metavar="FILE", help="write the verdict map as PNG")
    parser.add_argument("--html", metavar="FILE", help="write the technician's page")
    add_untested_code(parser)
    add_trust(parser)
    parser.set_defaults(run=run, writes=("out", "picture", "html"))


def run(args: argparse.Namespace) -> int:
    """Diagnose; the exit code says who has to act, as that of maintain."""
    import numpy as np

    from adaptfault.data.recordings import Recordings
    from adaptfault.data.recordings.blocks import is_large

    bundle = _bundle(args)
    healthy = load_recordings(args, args.reference) if args.reference and bundle is None else None
    diagnoser = None if bundle is None else bundle.diagnoser()
    known = diagnoser or healthy
    layout = None if known is None else known.layout
    log: Recordings | Stream
    if args.frames is None and is_large(args.recordings):
        log = stream_recordings(args, args.recordings, layout)
        report_inferred(args, log.inferred)
    else:
        log = load_recordings(args, args.recordings, layout=layout)
    if healthy is not None:  # fitted once the log is known to be of the same array
        diagnoser = fit_diagnoser(args, healthy)
    running: Undo = np.asarray if bundle is None else bundle.active().undo
    changed = change = None
    if diagnoser is None or not isinstance(log, Recordings):  # nothing to compare with, or too large to be searched
        diagnosis = _diagnosed(args, diagnoser, log, running)
    else:
        changed, change = _compared(log, diagnoser, running, _healthy(bundle, healthy))
        diagnosis = changed.diagnosis
    code, notes = _severity(diagnosis, bundle, args.untested_code)
    if change is not None:
        code, notes = max(code, 1), [*notes, change.reason]
    if changed is not None and changed.reason:
        code = max(code, 1 if changed.rewiring is None else 2)
        notes = [*notes, f"{changed.reason}; the verdicts are those with the readings put back"]
    _write(args, diagnosis, code, notes)
    found = {
        **diagnosis.to_dict(),
        "rewiring": [] if changed is None else list(changed.told["rewiring"]),
        "replaced_pads": [] if changed is None else list(changed.told["replaced_pads"]),
        "change": None if change is None else vars(change),
    }
    emit(args, found, "\n".join([text_of(diagnosis), *notes]))
    return code


def _write(args: argparse.Namespace, diagnosis: Diagnosis, code: int, notes: list[str]) -> None:
    """Write the files that the options ask for; the page says what the exit code and the notes say."""
    from adaptfault.data.atomic import atomic_write

    if args.out:
        atomic_write(args.out, json.dumps(diagnosis.to_dict(), allow_nan=False).encode())
    if args.picture:
        diagnosis.plot().savefig(args.picture, dpi=150)
    if args.html:
        from adaptfault.evaluation.html_diagnosis import write_diagnosis

        name, reference = ", ".join(args.recordings), bool(args.reference)
        write_diagnosis(args.html, diagnosis, name=name, reference=reference, code=code, notes=notes)


def _compared(
    log: Recordings, diagnoser: SelfDiagnosis, running: Undo, healthy: list[NDArray[Any]]
) -> tuple[ChangedReadings, SensorChange | None]:
    """Return the exchanged wires and replaced pads that no version undoes yet, and how the sensor changed besides."""
    import numpy as np

    from adaptfault.robot.changed_readings import find_changed_readings, find_sensor_change

    frames = [running(np.asarray(recording, dtype=np.float64)) for recording in log.frames]
    changed = find_changed_readings(diagnoser, frames, lambda: healthy)
    return changed, find_sensor_change(diagnoser, changed.diagnosis, changed.frames, healthy)


def _healthy(bundle: Bundle | None, recordings: Recordings | None) -> list[NDArray[Any]]:
    """Return the healthy recordings that were given, else those of the bundle, which then was."""
    from adaptfault.data.windows import recordings_of

    if recordings is not None:
        return list(recordings)
    assert bundle is not None
    return list(recordings_of(bundle.parts.adapter().train, bundle.layout))


def _bundle(args: argparse.Namespace) -> Bundle | None:
    """Return the bundle that is given as reference; None for recordings, and without a reference."""
    from adaptfault.cli.trained_model import open_bundle

    if len(args.reference or []) == 1:
        return open_bundle(args, args.reference[0])
    if args.trust:
        raise ValueError("--trust needs a bundle: --reference BUNDLE")
    return None


def _severity(diagnosis: Diagnosis, bundle: Bundle | None, untested_code: int) -> tuple[int, list[str]]:
    """Return the exit code, and a sentence where it is another one than that of the faults."""
    from adaptfault.robot.sensor_state import SensorState, unhandled_cells, untested

    code = diagnosis.exit_code
    reason = untested(diagnosis)
    if code == 0 and reason is not None:
        return untested_code, [reason]
    if code == 2 and bundle is not None:
        version = bundle.active()
        if not unhandled_cells(bundle, diagnosis.fault_set, version) and SensorState.of(bundle).exit_code < 2:
            return 1, [f"handled: version {version.number} of {bundle.path} runs without these cells"]
    return code, []


def text_of(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as text, with what would test the other cells."""
    lines = str(diagnosis).splitlines()
    lines += [f"to test more: {touch}" for touch in diagnosis.coverage.advice[:5]]
    if diagnosis.layout.rows > _ROWS:
        lines.append(lines[0])
    return "\n".join(lines)


def _cold(args: argparse.Namespace, log: Recordings | Stream, undo: Undo) -> SelfDiagnosis:
    """Return a diagnosis without reference; a log of enough recordings that is in memory is its own."""
    import numpy as np

    from adaptfault.data.recordings import Recordings
    from diagnostics import SelfDiagnosis

    cold = SelfDiagnosis(log.layout)
    if not isinstance(log, Recordings):
        return cold
    frames = [undo(np.asarray(recording, dtype=np.float64)) for recording in log.frames]
    with fitting_bar(args) as advance:
        return cold.for_log(frames, progress=advance)


def _diagnosed(
    args: argparse.Namespace, diagnoser: SelfDiagnosis | None, log: Recordings | Stream, undo: Undo
) -> Diagnosis:
    """Diagnose the log recording by recording, or in blocks in constant memory."""
    import numpy as np
    from tqdm import tqdm

    from adaptfault.data.recordings import Recordings
    from diagnostics.threads import one_thread

    fitted = diagnoser or _cold(args, log, undo)
    stream = fitted.stream()
    hide = None if (shown := progress(args)) is None else not shown
    total = len(log) if isinstance(log, Recordings) else None
    unit = "recording" if isinstance(log, Recordings) else "block"
    for frames in tqdm(log, total=total, unit=unit, desc="diagnosing", disable=hide, leave=False):
        with one_thread():
            stream.extend(undo(np.asarray(frames, dtype=np.float64)))
    if not isinstance(log, Recordings):
        for problem in log.problems:
            print(problem, file=sys.stderr)
    return fitted.evaluate(stream, n_recordings=len(log))
