"""adaptfault view: recordings and their diagnosis as a file for Foxglove or Rerun."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.cli.inspecting import add_reference, inspect_log
from adaptfault.cli.options import (
    Commands,
    add_cache,
    add_recordings,
    add_trust,
    command,
    emit,
    open_reported,
    read_diagnosis,
    report_range,
    say,
)
from adaptfault.cli.paths import Read, Written

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.data.recordings import Opened
    from diagnostics import Diagnosis

_EXAMPLE = """\
  adaptfault view today/ --reference healthy/ --mcap today.mcap
      open it in Foxglove
  adaptfault view today/ --diagnosis diagnosis.json --rrd today.rrd
      open it with: rerun today.rrd
      without --bundle, --reference or --diagnosis the log is diagnosed as adaptfault diagnose
      does it"""

_ENDINGS = {"mcap": ".mcap", "rrd": ".rrd"}


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "view", "write recordings and verdicts for Foxglove or Rerun", _EXAMPLE
    )
    add_recordings(parser, labels=False)
    given = parser.add_mutually_exclusive_group()
    given.add_argument(
        "--bundle", type=Read, metavar="BUNDLE", help="the robot's bundle, to diagnose with"
    )
    add_reference(given)
    given.add_argument(
        "--diagnosis",
        type=Read,
        metavar="FILE",
        help="a diagnosis written by adaptfault diagnose --out",
    )
    parser.add_argument(
        "--mcap", type=Written, metavar="FILE", help="write an MCAP file, for Foxglove"
    )
    parser.add_argument("--rrd", type=Written, metavar="FILE", help="write an RRD file, for Rerun")
    add_cache(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Diagnose, and write what was asked for."""
    from adaptfault.viewers.mcap_file import write_mcap
    from adaptfault.viewers.rerun_file import write_rrd
    from adaptfault.viewers.timed_log import TimedLog

    _check_outputs(args)
    log, diagnosis, bundle, notes = _diagnosed(args)
    version = None if bundle is None else bundle.active()

    def pieces() -> Iterator[NDArray[Any]]:
        for piece in log.pieces():
            yield piece if version is None else version.undo(piece)

    timed = TimedLog(diagnosis, log.names, log.lengths, pieces)
    writers = {"mcap": write_mcap, "rrd": write_rrd}
    written = {name: getattr(args, name) for name in writers if getattr(args, name)}
    for name, path in written.items():
        say(args, f"writing {path}")
        writers[name](path, timed)
    report_range(log)
    result = {
        "schema": "adaptfault.view/1",
        **written,
        "recordings": len(log),
        "frames": sum(log.lengths),
        "seconds": timed.seconds,
        "fault_set": list(diagnosis.fault_set),
        "notes": notes,
    }
    cells = int(log.layout.present.sum())
    text = (
        f"{len(log)} recordings, {timed.seconds:.4g} s, {len(diagnosis.fault_set)} of {cells}"
        f" cells faulty: {', '.join(written.values())}"
    )
    emit(args, result, "\n".join([text, *notes]))
    return 0


def _check_outputs(args: argparse.Namespace) -> None:
    """Raise ValueError unless an output is named, with the ending of its format."""
    if args.mcap is None and args.rrd is None:
        raise ValueError(
            "no output is named; give --mcap FILE.mcap for Foxglove, or --rrd FILE.rrd"
        )
    for name, ending in _ENDINGS.items():
        path = getattr(args, name)
        if path is not None and Path(path).suffix.lower() != ending:
            raise ValueError(f"--{name} {path}: expected a name that ends in {ending}")


def _diagnosed(
    args: argparse.Namespace,
) -> tuple[Opened, Diagnosis, Bundle | None, list[str]]:
    """Return the log, its diagnosis, the bundle that it was made with, and what else was found."""
    if args.diagnosis is not None:
        if args.trust:
            raise ValueError("--trust needs a bundle: --bundle BUNDLE")
        diagnosis = read_diagnosis(Path(args.diagnosis))
        log = open_reported(args, args.recordings, diagnosis.layout)
        return log, diagnosis, None, []
    if args.bundle is not None:
        args.reference = [args.bundle]
    inspected = inspect_log(args)
    notes = [reason.text for reason in inspected.reasons(0) if reason.text]
    return inspected.log, inspected.inspection.diagnosis, inspected.bundle, notes
