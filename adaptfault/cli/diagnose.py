"""adaptfault diagnose: recordings in; verdicts, root causes and untested cells out."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from adaptfault.cli.command import option
from adaptfault.cli.inspecting import Inspecting, inspect_log, text_of, write_page
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.reading import report_range
from adaptfault.cli.shared_options import (
    cache_option,
    count_from_option,
    reference_option,
    untested_code_option,
)

if TYPE_CHECKING:
    from diagnostics import Diagnosis


class Diagnose(Inspecting):
    """Find the faulty cells and wires in a log of recordings."""

    takes_labels = False
    example = """\
  adaptfault diagnose today/ --reference healthy/ --out diagnosis.json --html diagnosis.html
      without --reference the first half of 32 or more recordings is the reference; with fewer,
      each cell is compared with the cells around it
  adaptfault diagnose today/ --reference robot.bundle
      the healthy model of the bundle
      exit code: 0 nothing to do; 1 watch: single cells, faults that the bundle's version
      excludes, nothing tested, an object that lies still, a frozen stream, another gain or
      offset of the whole sensor or of a pad; 2 a person is needed: a wire, exchanged
      wires, or a tenth of the cells; 3 unusable input"""

    reference: list[Read] | None = reference_option()
    out: Written | None = option("write the diagnosis as JSON", "FILE")
    picture: Written | None = option("write the verdict map as PNG", "FILE")
    html: Written | None = option("write the technician's page", "FILE")
    count_from: int = count_from_option()
    no_cache: bool = cache_option()
    untested_code: int = untested_code_option()

    def run(self) -> int:
        """Diagnose; the exit code says who has to act, as that of maintain."""
        from adaptfault.inspection.severity import worst

        inspected = inspect_log(self)
        report_range(inspected.log)
        inspection = inspected.inspection
        diagnosis = inspection.diagnosis
        reasons = inspected.reasons(self.untested_code)
        code = worst(reasons)
        notes = [reason.text for reason in reasons if reason.text]
        _write(self, diagnosis, code, notes)
        found = {
            **diagnosis.to_dict(),
            **inspection.told,
            "findings": [finding.to_dict() for finding in inspection.findings],
        }
        self.emit(found, text_of(diagnosis, notes, self.count_from))
        return code


add = Diagnose.add


def _write(args: Diagnose, diagnosis: Diagnosis, code: int, notes: list[str]) -> None:
    """Write the files that the options ask for; the page says what the exit code and the notes
    say."""
    from adaptfault.data.atomic import atomic_figure, atomic_write

    if args.out:
        atomic_write(args.out, json.dumps(diagnosis.to_dict(), allow_nan=False).encode())
    if args.picture:
        atomic_figure(args.picture, diagnosis.plot(count_from=args.count_from), dpi=150)
    write_page(args, diagnosis, code, notes, compared=bool(args.reference))
