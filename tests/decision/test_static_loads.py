from collections.abc import Sequence

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    Line,
    Monitor,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    inject,
    line_fault,
)

LAYOUT = SensorLayout.paper()


@pytest.fixture(scope="module")
def log(grasps: Recordings) -> list[np.ndarray]:
    """Twenty grasps that the reference does not hold."""
    return [grasps.frames[i] for i in range(1, 140, 7)]


@pytest.fixture(scope="module")
def object_(grasps: Recordings) -> np.ndarray:
    """The loads of an object that lies still: nine cells cut out of a grasp, in a corner."""
    pressed = (
        LAYOUT.grid(grasp[grasp.sum(axis=1).argmax()])[0, 3:6, 3:6] for grasp in grasps.frames[::2]
    )
    load = np.zeros(LAYOUT.shape)
    load[0, :3, :3] = next(patch for patch in pressed if (patch > 0.2).all())
    return load.ravel()


def lying(
    log: Sequence[np.ndarray], load: np.ndarray, onset: int = 0, noise: float = 0.0
) -> list[np.ndarray]:
    """The log with an object on the array from recording ``onset`` on."""
    rng = np.random.default_rng(0)
    top = LAYOUT.full_scale
    held = [load + noise * rng.standard_normal(r.shape) * (load > 0) for r in log]
    return [
        np.clip(r + (h if i >= onset else 0), 0, top)
        for i, (r, h) in enumerate(zip(log, held, strict=True))
    ]


@pytest.mark.parametrize(("onset", "noise"), [(0, 0.0), (8, 0.0), (0, 0.01)])
def test_an_object_that_lies_still_is_told_and_no_cell_is_blamed(
    fitted, log, object_, onset, noise
):
    found = fitted.diagnose(lying(log, object_, onset, noise))
    assert not found.fault_set
    (load,) = found.static_loads
    # the corner, which the noise moves
    assert len(set(np.flatnonzero(object_).tolist()) - set(load.cells)) <= 1
    assert len(load.cells) <= 10
    assert (found.verdicts[list(found.statically_loaded)] == Verdict.UNTESTED).all()
    assert found.exit_code == 1
    assert "something lies still on pad 0, rows 0-" in str(found)
    assert (load.onset or 0) == pytest.approx(100 * onset, abs=50)
    assert Diagnosis.from_dict(found.to_dict()).static_loads == found.static_loads


@pytest.mark.usefixtures("uncalibrated")
def test_cells_that_hold_the_loads_of_an_object_without_their_noise_are_stuck(
    small_grasps: Recordings,
):
    layout = small_grasps.layout
    rng = np.random.default_rng(0)
    noisy = [
        np.clip(r + 0.3 + 0.02 * rng.standard_normal(r.shape), 0, 5) for r in small_grasps.frames
    ]
    cells = [layout.cell(0, r, c) for r in range(3) for c in range(3)]
    load = np.zeros(layout.n_cells)
    load[cells] = 0.5 * max(noisy, key=np.sum).max(axis=0)[cells]
    diagnoser = SelfDiagnosis(layout).fit(noisy[::2])
    stuck = diagnoser.diagnose([np.where(load > 0, 0.3 + load, r) for r in noisy[31:90:4]])
    assert stuck.fault_set == set(cells)
    assert not stuck.static_loads


def test_a_monitor_tells_of_the_same_object(fitted, log, object_):
    frames = np.concatenate(lying(log[:12], object_))
    monitor = Monitor(fitted)
    for frame in frames:
        monitor.update(frame)
    assert monitor.diagnosis().static_loads == fitted.diagnose(frames).static_loads != ()


def test_stuck_cells_beside_an_object_are_found(fitted, log, object_):
    cells = [LAYOUT.cell(1, 5, 5), LAYOUT.cell(0, 8, 7), LAYOUT.cell(1, 2, 6)]
    kinds = [FaultKind.STUCK, FaultKind.SHORT, FaultKind.OPEN]
    faults = [
        Fault(k, (c,), value=1.5 if k == "stuck" else None)
        for k, c in zip(kinds, cells, strict=True)
    ]
    found = fitted.diagnose([inject(r, faults, LAYOUT) for r in lying(log, object_)])
    assert set(found.fault_set) == set(cells)
    assert found.static_loads


def test_a_wire_that_holds_a_value_is_no_object(fitted, log):
    line = Line(0, "row", 4)
    for fault in (
        line_fault(LAYOUT, line, "short"),
        Fault(FaultKind.STUCK, tuple(LAYOUT.cells_on(line)), value=1.5),
    ):
        found = fitted.diagnose(
            [inject(r, [fault], LAYOUT, seed=i, dither=0.002) for i, r in enumerate(log)]
        )
        assert [f.line for f in found.faults] == [line]
        assert not found.static_loads


def test_single_stuck_cells_are_no_objects(fitted, log):
    cells = [LAYOUT.cell(pad, row, col) for pad in (0, 1) for row in (2, 5, 8) for col in (2, 5, 8)]
    faults = [Fault(FaultKind.STUCK, (cell,), value=0.5 + 0.2 * i) for i, cell in enumerate(cells)]
    found = fitted.diagnose([inject(r, faults, LAYOUT) for r in log])
    assert set(cells) <= set(found.fault_set)
    assert not found.static_loads


@pytest.mark.parametrize("seed", [10, 11, 14, 23, 25])
def test_faults_in_grasps_that_never_let_go_are_no_objects(fitted, grasps: Recordings, seed: int):
    """Cells that each grasp presses to its last frame return to about the same load by chance."""
    rng = np.random.default_rng(seed)
    middle = [
        LAYOUT.cell(pad, row, col) for pad in range(2) for row in range(3, 8) for col in range(3, 7)
    ]
    cells = rng.choice(middle, 3, replace=False).tolist()
    kinds = (FaultKind.SHORT, FaultKind.OPEN, FaultKind.STUCK)
    faults = [
        Fault(kind, (cell,), value=2.5 * (kind == "stuck"))
        for kind, cell in zip(kinds, cells, strict=True)
    ]
    assert grasps.labels is not None
    # class 0: nothing is grasped
    pressed = [i for i in range(1, len(grasps), 2) if grasps.labels[i]]
    order = np.insert(rng.choice(pressed, 19, replace=False), 6, 1)
    found = fitted.diagnose([inject(grasps.frames[i], faults, LAYOUT) for i in order])
    assert not found.static_loads
    assert set(found.fault_set) == set(cells)
