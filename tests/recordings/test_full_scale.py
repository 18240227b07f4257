"""A full scale that is stated too high changes no verdict: fractions refer to the range seen in the
reference."""

from dataclasses import replace

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, SelfDiagnosis, inject


def check_verdicts(factor: float, small_grasps: Recordings) -> None:
    frames = [np.asarray(f, dtype=float) for f in small_grasps.frames]
    dead = [Fault("stuck", (cell,), value=1.3) for cell in (7, 40)] + [
        Fault("open", (cell,)) for cell in (18, 22, 52)
    ]
    log = inject(np.concatenate(frames[1:61:2]), dead, small_grasps.layout)
    stated = replace(small_grasps.layout, full_scale=factor * small_grasps.layout.full_scale)
    first, second = (
        SelfDiagnosis(layout).fit(frames[::2]).diagnose(log)
        for layout in (small_grasps.layout, stated)
    )
    assert first.fault_set
    assert (first.verdicts == second.verdicts).all()
    np.testing.assert_array_equal(first.probability, second.probability)


def test_verdicts_are_the_same_with_a_full_scale_stated_too_high(small_grasps: Recordings):
    check_verdicts(10.0, small_grasps)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2.5, 10.0])
def test_verdicts_and_calibration_are_the_same_with_a_full_scale_stated_too_high(
    factor: float, small_grasps: Recordings
):
    check_verdicts(factor, small_grasps)
