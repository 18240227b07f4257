"""A scan of the read-out is evidence of a maintenance run, like any other."""

from dataclasses import replace

import numpy as np
import pytest

from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.robot.maintenance import maintain
from adaptfault.robot.new_recordings import load_new_recordings
from diagnostics import Fault, FaultKind, FaultSet, Scan, Verdict
from diagnostics.simulation.circuit import Circuit, StuckCell
from diagnostics.simulation.scan import scan_circuit

OPEN = 33


def scan_of(layout, *faults) -> Scan:
    return scan_circuit(Circuit(layout, faults=faults), np.full(layout.n_cells, 0.01))


@pytest.fixture
def untouched(small_grasps):
    """Recordings in which nothing happens."""
    rng = np.random.default_rng(0)
    shape = small_grasps.frames[0].shape
    return [0.005 * rng.integers(0, 2, shape) for _ in range(3)]


def test_an_open_crossing_that_nobody_touches_is_found_by_the_scan_and_the_rest_is_alive(
    bundle, untouched
):
    report = maintain(
        bundle, untouched, dry_run=True, scan=scan_of(bundle.layout, StuckCell(OPEN, np.inf))
    )
    assert report.diagnosis.fault_set == FaultSet((OPEN,), 60)
    assert (report.diagnosis.verdicts == Verdict.UNTESTED).sum() == 0
    (told,) = [reason.text for reason in report.reasons if reason.text.startswith("scan:")]
    assert told == "scan: 60 of 60 cells tested"


def test_a_cell_that_is_known_to_be_faulty_does_not_recover_because_it_conducts(bundle, untouched):
    known = KnownFaults(60, (Fault(FaultKind.STUCK, (7,), value=1.0),))
    adaptation = bundle.parts.adapter().adapt(known.fault_set, method="fill")
    bundle.deploy(bundle.write_version(adaptation, {"knowledge": known.to_dict()}).number)
    scan = replace(scan_of(bundle.layout), holds_lines=True)
    report = maintain(bundle, untouched, dry_run=True, scan=scan)
    alive = report.diagnosis.verdicts == Verdict.ALIVE
    assert np.flatnonzero(~alive).tolist() == [7]
    assert report.fault_set == known.fault_set


def test_a_scan_that_does_not_tell_whether_lines_are_held_is_told(bundle, untouched):
    report = maintain(bundle, untouched, dry_run=True, scan=scan_of(bundle.layout))
    assert (report.diagnosis.verdicts == Verdict.ALIVE).sum() == 0
    (told,) = [one for one in report.reasons if one.text.startswith("scan: 0 of 60")]
    assert told.severity == 1
    assert "they stay untested" in told.text


def test_a_scan_of_another_array_is_refused_before_anything_is_done(bundle, untouched):
    with pytest.raises(ValueError, match="a scan of 4 cells, but the array has 60"):
        maintain(bundle, untouched, scan=Scan(np.zeros(5), np.zeros((5, 4))))


def test_the_scan_among_recordings_reaches_the_run(bundle, small_grasps, tmp_path):
    scan = scan_of(bundle.layout, StuckCell(OPEN, np.inf))
    frames = np.concatenate([small_grasps.frames[0], scan.readings]).astype(np.float32)
    levels = np.concatenate([np.full(len(small_grasps.frames[0]), np.nan), scan.levels])
    np.savez(tmp_path / "log.npz", frames=frames, scan=levels)
    incoming = load_new_recordings(bundle, [tmp_path / "log.npz"])
    assert [len(one) for one in incoming.frames] == [len(small_grasps.frames[0])]
    np.testing.assert_allclose(incoming.scan.readings, scan.readings, atol=1e-6)
