"""Readings that no converter gives (infinite, or far outside its range) count as missing, and are counted."""

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import Diagnosis, Fault, Monitor, SelfDiagnosis, inject

IMPOSSIBLE = [np.inf, -np.inf, 1e308, 1e30, -1e30]


@pytest.fixture(scope="module")
def log(grasps: Recordings) -> np.ndarray:
    frames = np.concatenate([grasps.frames[i] for i in range(21, 140, 15)]).astype(float)
    return inject(frames, [Fault("short", (57,)), Fault("open", (163,))], grasps.layout)


def with_one(log: np.ndarray, value: float) -> np.ndarray:
    seen = log.copy()
    seen[90, 30] = value
    return seen


@pytest.mark.parametrize("value", IMPOSSIBLE)
def test_one_impossible_reading_counts_as_missing(value: float, fitted: SelfDiagnosis, log: np.ndarray):
    found, missing = fitted.diagnose(with_one(log, value)), fitted.diagnose(with_one(log, np.nan))
    assert 57 in found.fault_set
    assert (found.probability == missing.probability).all()
    assert [fault.kind for fault in found.transport] == ["invalid"]
    assert found.transport[0].onset == 90
    assert found.transport[0].frames == 1
    assert Diagnosis.from_dict(found.to_dict()).transport == found.transport


def test_the_monitor_still_finds_faults_after_one(fitted: SelfDiagnosis, log: np.ndarray):
    monitor = Monitor(fitted)
    news = [fault for frame in with_one(log, np.inf) for fault in monitor.update(frame)]
    assert any(57 in fault.cells for fault in news)
    assert monitor.diagnosis().to_dict() == fitted.diagnose(with_one(log, np.inf)).to_dict()


def test_many_impossible_readings_blame_no_other_cell(fitted: SelfDiagnosis, log: np.ndarray):
    rng = np.random.default_rng(0)
    seen = np.where(rng.random(log.shape) < 0.05, rng.choice(IMPOSSIBLE, log.shape), log)
    assert set(fitted.diagnose(seen).fault_set) <= {57, 163}


@pytest.mark.usefixtures("uncalibrated")
def test_a_reference_with_impossible_readings_is_fitted_as_one_with_missing_readings(small_grasps: Recordings):
    frames = [np.array(f, dtype=float) for f in small_grasps.frames[:12]]
    spoiled, missing = frames[3].copy(), frames[3].copy()
    spoiled[10, 4], missing[10, 4] = np.inf, np.nan
    fits = [SelfDiagnosis(small_grasps.layout).fit([*frames[:3], r, *frames[4:]]) for r in (spoiled, missing)]
    first, second = (fit.diagnose(small_grasps.frames[20]).probability for fit in fits)
    assert (first == second).all()
