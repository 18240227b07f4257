"""Readings that no converter gives (infinite, or far outside its range) count as missing, and are
counted.

Readings of positions without a cell count as missing too.
"""

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from adaptfault.data.simulated_grasps import simulate
from diagnostics import Diagnosis, Fault, Monitor, SelfDiagnosis, SensorLayout, inject

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
def test_one_impossible_reading_counts_as_missing(
    value: float, fitted: SelfDiagnosis, log: np.ndarray
):
    found = fitted.diagnose(with_one(log, value))
    missing = fitted.diagnose(with_one(log, np.nan))
    assert 57 in found.fault_set
    assert (found.probability == missing.probability).all()
    assert [fault.kind for fault in found.transport] == ["invalid"]
    assert found.transport[0].onset == 90
    assert found.transport[0].frames == 1
    assert Diagnosis.from_dict(found.to_dict()).transport == found.transport


@pytest.mark.usefixtures("seldom_evaluated")
def test_the_monitor_still_finds_faults_after_one(fitted: SelfDiagnosis, log: np.ndarray):
    monitor = Monitor(fitted, wait=True)
    news = [fault for frame in with_one(log, np.inf) for fault in monitor.update(frame)]
    assert any(57 in fault.cells for fault in news)
    assert monitor.diagnosis().to_dict() == fitted.diagnose(with_one(log, np.inf)).to_dict()


def test_many_impossible_readings_blame_no_other_cell(fitted: SelfDiagnosis, log: np.ndarray):
    rng = np.random.default_rng(0)
    seen = np.where(rng.random(log.shape) < 0.05, rng.choice(IMPOSSIBLE, log.shape), log)
    assert set(fitted.diagnose(seen).fault_set) <= {57, 163}


def test_a_reference_with_impossible_readings_is_fitted_as_one_with_missing_readings(
    small_grasps: Recordings,
):
    frames = [np.array(f, dtype=float) for f in small_grasps.frames[:12]]
    spoiled = frames[3].copy()
    missing = frames[3].copy()
    spoiled[10, 4] = np.inf
    missing[10, 4] = np.nan
    fits = [
        SelfDiagnosis(small_grasps.layout).fit([*frames[:3], r, *frames[4:]])
        for r in (spoiled, missing)
    ]
    first, second = (fit.diagnose(small_grasps.frames[20]).probability for fit in fits)
    assert (first == second).all()


def read_there(frames: np.ndarray, layout: SensorLayout, what: str) -> np.ndarray:
    """Return ``frames`` ``[T, D]`` with readings at the positions without a cell."""
    absent = ~layout.present.ravel()
    seen = frames.copy()
    rng = np.random.default_rng(len(frames))
    value = {
        "a copy of all": 2 * frames[:, ~absent].mean(axis=1, keepdims=True),
        "noise": rng.uniform(0, layout.full_scale, (len(frames), int(absent.sum()))),
        "too much": np.inf,
    }[what]
    seen[:, absent] = value
    return seen


@pytest.mark.parametrize("what", ["a copy of all", "noise", "too much"])
def test_what_a_position_without_a_cell_reads_changes_nothing(what: str):
    present = np.ones((1, 6, 7), bool)
    present[0, :2, :3] = False
    layout = SensorLayout(1, 6, 7, present=present)
    plain = [
        np.where(present.ravel(), r, 0.0) for r in simulate(6, layout, n_frames=40, seed=4).frames
    ]
    log = [inject(r, [Fault("short", (25,)), Fault("open", (31,))], layout) for r in plain[::7]]
    floating = [read_there(r, layout, what) for r in plain]
    expected = SelfDiagnosis(layout).fit(plain[1::2]).diagnose(log).to_dict()
    found = (
        SelfDiagnosis(layout)
        .fit(floating[1::2])
        .diagnose([read_there(r, layout, what) for r in log])
    )
    assert found.to_dict() == expected
    cold = SelfDiagnosis(layout)
    assert (
        cold.diagnose([read_there(r, layout, what) for r in log]).to_dict()
        == cold.diagnose(log).to_dict()
    )
