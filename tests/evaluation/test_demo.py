import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from adaptfault.evaluation.demo import default_faults, run_demo
from diagnostics import FaultKind, SensorLayout


def test_the_default_faults_are_a_row_a_short_an_open_and_a_stuck_cell_where_there_is_contact(
    grasps,
):
    layout = grasps.layout
    for seed in range(5):
        row, *cells = default_faults(grasps.frames, layout, np.random.default_rng(seed))
        assert row.kind is FaultKind.OPEN
        assert row.line.kind == "row"
        assert [fault.kind for fault in cells] == [FaultKind.SHORT, FaultKind.OPEN, FaultKind.STUCK]
        every = [c for fault in (row, *cells) for c in fault.cells]
        assert len(every) == len(set(every)) == layout.cols + 3
        loaded = np.mean([r.max(axis=0) > 0 for r in grasps.frames], axis=0)
        assert loaded[every].mean() > 0.4


def test_an_array_with_hardly_any_cells_gets_the_faults_that_fit():
    layout = SensorLayout(1, 1, 3)
    faults = default_faults([np.ones((5, 3))], layout, np.random.default_rng(0))
    assert [fault.kind for fault in faults] == [FaultKind.OPEN]


def test_the_demo_needs_labels():
    layout = SensorLayout(1, 2, 2)
    with pytest.raises(ValueError, match="no labels"):
        run_demo(Recordings((np.zeros((20, 4)),), layout))
