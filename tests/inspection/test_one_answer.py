"""Whoever asks, the same recordings get the same verdicts."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.inspection.guard import GuardError, guard
from adaptfault.inspection.inspection import inspect
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject

LAYOUT = SensorLayout(1, 6, 6, full_scale=3.3, unit="V", rate=20.0)

pytestmark = [
    pytest.mark.filterwarnings("ignore:touch readings"),  # of the guard
]


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    frames = simulate(6, LAYOUT, n_frames=40, seed=2).frames
    order = np.random.default_rng(0).permutation(len(frames))
    return [np.asarray(frames[i], dtype=np.float32) for i in order]


def broken(grasps: list[np.ndarray], kind: str, cell: int, since: int) -> list[np.ndarray]:
    """Return recordings in which a cell is faulty from one of them on."""
    fault = Fault(kind, (cell,), value=1.3 if kind == "stuck" else None)
    log = [inject(one, [fault], LAYOUT, seed=0).astype(np.float32) for one in grasps[since:]]
    return [*grasps[:since], *log]


@settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    n=st.sampled_from([3, 16, 24, 36]),
    kind=st.sampled_from(["open", "stuck", "short", "intermittent", "floating"]),
    cell=st.integers(0, 35),
    share=st.sampled_from([0.0, 0.5, 0.75]),
)
def test_diagnose_inspect_guard_and_check_say_the_same(n, kind, cell, share, grasps, tmp_path):
    log = broken(grasps[:n], kind, cell, int(share * n))
    alone = SelfDiagnosis(LAYOUT).diagnose(log)
    inspected = inspect(log, SelfDiagnosis(LAYOUT)).diagnosis
    assert inspected.to_dict() == alone.to_dict()
    try:
        findings = guard(Recordings(tuple(log), LAYOUT), on="never")
    except GuardError as error:  # too little was tested
        findings = error.findings
    faults = [sorted(one.fault.cells) for one in findings if one.fault is not None]
    assert faults == [sorted(one.cells) for one in alone.faults]
    path = tmp_path / "log.npz"
    save_npz(path, Recordings(tuple(log), LAYOUT))
    out = tmp_path / "check.json"
    main(["check", str(path), "--no-cache", "--quiet", "--out", str(out)])
    told = json.loads(out.read_text())["inspection"]["diagnosis"]
    expected = alone.to_dict()
    for name in ("verdicts", "probability", "n_recordings"):
        assert told[name] == expected[name]
    assert [one["cells"] for one in told["faults"]] == [one["cells"] for one in expected["faults"]]
