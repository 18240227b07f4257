"""An inspection with what a scan of the read-out says of each cell."""

from __future__ import annotations

from dataclasses import replace

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.result import OF_CELLS, Inspection, of_diagnosis
from diagnostics import FaultSet, ReadOut, Scan, judge_scan, with_scan


def inspection_with_scan(
    inspection: Inspection, scan: Scan, known: FaultSet | None = None
) -> tuple[Inspection, ReadOut]:
    """Return an inspection with the evidence of a scan, and what the scan says.

    Wires that answer in each other's place are put back in the scan, too.

    Args:
        inspection: of the log.
        scan: of the same array, in the same time.
        known: cells that were found faulty before; a crossing that conducts may still not feel, so
            that a scan does not show that they work again. None: none.

    Raises:
        ValueError: a scan of another array.
    """
    rewiring = inspection.rewiring
    if rewiring is not None and scan.readings.shape[1] == inspection.diagnosis.layout.n_cells:
        scan = replace(scan, readings=rewiring.undo(scan.readings))
    found = judge_scan(scan, inspection.diagnosis.layout)
    if known is not None:
        found = replace(found, alive=found.alive & ~known.mask)
    readings = _with_scan(inspection.readings, found)
    if readings.as_found is not None:
        readings = replace(readings, as_found=_with_scan(readings.as_found, found))
    others = [one for one in inspection.findings if one.name not in OF_CELLS]
    findings = (*others, *of_diagnosis(readings.diagnosis))
    return replace(inspection, readings=readings, findings=findings), found


def _with_scan(readings: ChangedReadings, found: ReadOut) -> ChangedReadings:
    return replace(readings, diagnosis=with_scan(readings.diagnosis, found))
