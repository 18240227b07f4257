"""An inspection with what a scan of the read-out says of each cell."""

from __future__ import annotations

from dataclasses import replace

from adaptfault.inspection.result import OF_CELLS, Inspection, of_diagnosis
from diagnostics import ReadOut, Scan, judge_scan, with_scan


def inspection_with_scan(inspection: Inspection, scan: Scan) -> tuple[Inspection, ReadOut]:
    """Return an inspection with the evidence of a scan, and what the scan says.

    Wires that answer in each other's place are put back in the scan, too.

    Raises:
        ValueError: a scan of another array.
    """
    rewiring = inspection.rewiring
    if rewiring is not None and scan.readings.shape[1] == inspection.diagnosis.layout.n_cells:
        scan = replace(scan, readings=rewiring.undo(scan.readings))
    found = judge_scan(scan, inspection.diagnosis.layout)
    diagnosis = with_scan(inspection.diagnosis, found)
    others = [one for one in inspection.findings if one.name not in OF_CELLS]
    return (
        replace(
            inspection,
            readings=replace(inspection.readings, diagnosis=diagnosis),
            findings=(*others, *of_diagnosis(diagnosis)),
        ),
        found,
    )
