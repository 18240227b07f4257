import json

import numpy as np

from adaptfault.bundle.known_faults import KnownFaults
from diagnostics import Diagnosis, Fault, FaultKind, Line, SensorLayout

LAYOUT = SensorLayout(1, 3, 4)
D = LAYOUT.n_cells
ROW = Fault(FaultKind.OPEN, (0, 1, 2, 3), line=Line(0, "row", 0))
BLINKING = Fault(FaultKind.INTERMITTENT, (7,))


def log(*faults: Fault, untested: tuple[int, ...] = ()) -> Diagnosis:
    """What a diagnosis says of a log with these faults; all other cells were seen alive."""
    tested = np.ones(D, bool)
    tested[list(untested)] = False
    return Diagnosis(LAYOUT, faults, np.zeros(D), tested, n_frames=100, n_recordings=1)


def test_new_faults_count_at_once_and_add_to_the_old():
    known = KnownFaults(D).merged(log(ROW)).merged(log(BLINKING, untested=(0, 1, 2, 3)))
    assert known.fault_set == {0, 1, 2, 3, 7}
    assert known.faults == (BLINKING, ROW)


def test_a_dead_cell_stays_dead_until_three_logs_show_it_alive():
    known = KnownFaults(D).merged(log(ROW))
    for _ in range(2):
        known = known.merged(log())
        assert known.fault_set == {0, 1, 2, 3}
    assert known.merged(log()).fault_set == set()


def test_an_intermittent_cell_needs_twice_the_proof():
    known = KnownFaults(D).merged(log(BLINKING))
    for _ in range(5):
        known = known.merged(log())
        assert known.fault_set == {7}
    assert known.merged(log()).fault_set == set()


def test_logs_that_do_not_test_a_cell_prove_nothing():
    known = KnownFaults(D).merged(log(ROW))
    for _ in range(10):
        known = known.merged(log(untested=(0, 1, 2, 3)))
    assert known.fault_set == {0, 1, 2, 3}


def test_being_found_faulty_again_takes_all_proofs_away():
    known = (
        KnownFaults(D)
        .merged(log(ROW))
        .merged(log())
        .merged(log())
        .merged(log(ROW))
        .merged(log())
        .merged(log())
    )
    assert known.fault_set == {0, 1, 2, 3}


def test_cells_of_one_wire_recover_one_by_one():
    known = KnownFaults(D).merged(log(ROW))
    for _ in range(3):
        known = known.merged(log(untested=(2, 3)))
    assert known.fault_set == {2, 3}
    assert known.faults[0].line == ROW.line


def test_a_cell_whose_wire_is_found_to_be_the_cause_is_named_once():
    known = KnownFaults(D).merged(log(Fault(FaultKind.OPEN, (1,)))).merged(log(ROW))
    assert known.faults == (ROW,)


def test_knowledge_survives_json():
    known = KnownFaults(D).merged(log(ROW, BLINKING)).merged(log(untested=(0,)))
    again = KnownFaults.from_dict(json.loads(json.dumps(known.to_dict(), allow_nan=False)))
    assert (again.faults, dict(again.proofs), again.fault_set) == (
        known.faults,
        dict(known.proofs),
        known.fault_set,
    )
