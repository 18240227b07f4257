"""A fault that shows in all recordings of some classes and in no other is told with them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.inspection.coincidence import coinciding
from diagnostics import Diagnosis, Fault, SensorLayout, Verdict

LAYOUT = SensorLayout(1, 4, 4)
CLASSES = np.repeat(["cup", "ball", "pen"], 8)


def diagnosis(shown: np.ndarray) -> Diagnosis:
    """Return a diagnosis in which cell 5 is faulty in some recordings, bool ``[n]``."""
    states = np.full((len(shown), 16), int(Verdict.ALIVE), np.uint8)
    states[shown, 5] = int(Verdict.FAULTY)
    return Diagnosis(
        layout=LAYOUT,
        faults=(Fault("open", [5]),),
        probability=np.zeros(16),
        tested=np.ones(16, bool),
        n_frames=10 * len(shown),
        n_recordings=len(shown),
        states=states,
    )


@settings(max_examples=20)
@given(order=st.permutations(range(24)), broken=st.sampled_from([("cup",), ("pen", "ball")]))
def test_a_fault_of_some_classes_only_is_told_with_them_in_any_order(order, broken):
    classes = CLASSES[list(order)]
    (said,) = coinciding(diagnosis(np.isin(classes, broken)), classes)
    assert "pad 0, row 1, column 1 coincides with class" in said
    assert ", ".join(sorted(broken)) in said


@pytest.mark.parametrize(
    "shown", [np.arange(24) >= 12, np.arange(24) % 2 == 0, np.ones(24, bool), np.zeros(24, bool)]
)
def test_a_fault_in_part_of_a_class_or_in_all_classes_coincides_with_none(shown):
    assert coinciding(diagnosis(shown), CLASSES) == []
