"""adaptfault view: recordings and their diagnosis as a file for Foxglove or Rerun."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import option
from adaptfault.cli.diagnoses import read_diagnosis
from adaptfault.cli.inspecting import Inspecting, inspect_log
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.reading import report_range
from adaptfault.cli.shared_options import cache_option, reference_option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.data.recordings import Opened
    from diagnostics import Diagnosis


_ENDINGS = {"mcap": ".mcap", "rrd": ".rrd"}


class View(Inspecting):
    """Write recordings and verdicts for Foxglove or Rerun."""

    takes_labels = False
    example = """\
  adaptfault view today/ --reference healthy/ --mcap today.mcap
      open it in Foxglove
  adaptfault view today/ --diagnosis diagnosis.json --rrd today.rrd
      open it with: rerun today.rrd
      without --bundle, --reference or --diagnosis the log is diagnosed as adaptfault diagnose
      does it"""
    one_of = ("bundle", "reference", "diagnosis")

    bundle: Read | None = option("the robot's bundle, to diagnose with", "BUNDLE")
    reference: list[Read] | None = reference_option()
    diagnosis: Read | None = option("a diagnosis written by adaptfault diagnose --out", "FILE")
    mcap: Written | None = option("write an MCAP file, for Foxglove", "FILE")
    rrd: Written | None = option("write an RRD file, for Rerun", "FILE")
    no_cache: bool = cache_option()

    def run(self) -> int:
        """Diagnose, and write what was asked for."""
        from adaptfault.viewers.mcap_file import write_mcap
        from adaptfault.viewers.rerun_file import write_rrd
        from adaptfault.viewers.timed_log import TimedLog

        _check_outputs(self)
        log, diagnosis, bundle, notes = _diagnosed(self)
        version = None if bundle is None else bundle.active()

        def pieces() -> Iterator[NDArray[Any]]:
            for piece in log.pieces():
                yield piece if version is None else version.undo(piece)

        timed = TimedLog(diagnosis, log.names, log.lengths, pieces)
        writers = {"mcap": write_mcap, "rrd": write_rrd}
        written = {name: getattr(self, name) for name in writers if getattr(self, name)}
        for name, path in written.items():
            self.say(f"writing {path}")
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
        self.emit(result, "\n".join([text, *notes]))
        return 0


add = View.add


def _check_outputs(args: View) -> None:
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
    args: View,
) -> tuple[Opened, Diagnosis, Bundle | None, list[str]]:
    """Return the log, its diagnosis, the bundle that it was made with, and what else was found."""
    if args.diagnosis is not None:
        if args.trust:
            raise ValueError("--trust needs a bundle: --bundle BUNDLE")
        diagnosis = read_diagnosis(Path(args.diagnosis))
        log = args.open(args.recordings, diagnosis.layout)
        return log, diagnosis, None, []
    if args.bundle is not None:
        args.reference = [args.bundle]
    inspected = inspect_log(args)
    notes = [reason.text for reason in inspected.reasons(0) if reason.text]
    return inspected.log, inspected.inspection.diagnosis, inspected.bundle, notes
