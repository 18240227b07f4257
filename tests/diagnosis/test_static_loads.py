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


@pytest.mark.usefixtures("seldom_evaluated")
@pytest.mark.usefixtures("seldom_evaluated")
def test_a_monitor_tells_of_the_same_object(fitted, log, object_):
    frames = np.concatenate(lying(log[:12], object_))
    monitor = Monitor(fitted, wait=True)
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


def test_a_cell_at_full_scale_is_no_part_of_an_object(fitted, log, object_):
    short = int(np.flatnonzero(object_)[4])
    found = fitted.diagnose(
        [inject(r, [Fault("short", (short,))], LAYOUT) for r in lying(log, object_)]
    )
    assert set(found.fault_set) == {short}
    assert all(short not in load.cells for load in found.static_loads)


PADS = SensorLayout(2, 6, 4, full_scale=512.0, unit="count", rate=25.0)


def sagging(seed: int, recordings: int, idle: int = 0) -> list[np.ndarray]:
    """Return presses on two pads that rest at 140 counts, and in most recordings 25 lower: their
    supply sags. In the last ``idle`` ones it does not, and nothing touches the first pad."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((6, 4)))
    time = np.arange(60)[:, None] * np.pi / 60
    log = []
    for k in range(recordings):
        last = k >= recordings - idle
        loads = np.zeros((60, 2, 24))
        for pad in range(last, 2):
            apart = ((places - rng.uniform(0, (5, 3))) ** 2).sum(axis=1)
            press = np.exp(-apart / (2 * rng.uniform(0.8, 1.4) ** 2))
            loads[:, pad] = rng.uniform(100, 300) * np.clip(np.sin(time * (1 + 2 * last)), 0, None)
            loads[:, pad] *= press
        rest = 140 - 25 * (rng.random() < 0.7 and not last)
        noise = rng.normal(0, 0.7, (60, 48))
        log.append(np.clip(np.rint(rest + loads.reshape(60, 48) + noise), 0, 512))
    return log


@pytest.fixture(scope="module")
def of_pads() -> SelfDiagnosis:
    return SelfDiagnosis(PADS).fit(sagging(1, 40))


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_pad_whose_supply_sags_is_no_object_nor_stuck_and_its_shorts_are_found(of_pads, seed):
    log = sagging(seed, 12, idle=4)
    for frames in log:
        frames[:, [3, 9]] = 512
    found = of_pads.diagnose(log)
    assert {3, 9} <= set(found.fault_set)
    assert not found.static_loads
    assert FaultKind.STUCK not in {fault.kind for fault in found.faults}


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


def test_a_pose_that_is_held_for_long_blames_nobody_whatever_its_highest_cell_reads(
    fitted, grasps: Recordings
):
    rng = np.random.default_rng(0)
    highest = max(frames.max() for frames in grasps.frames[::2])
    heavy = sorted(grasps.frames[1::2], key=lambda frames: -frames[len(frames) // 2].sum())[:6]
    for number in range(6):
        seen = []
        for i, frames in enumerate(heavy):
            pose = frames[len(frames) // 2].copy()
            if i == number:
                pose[pose.argmax()] = highest
            jitter = LAYOUT.full_scale / 4095 * rng.integers(-1, 2, (300, len(pose))) * (pose > 0)
            seen.append(np.concatenate([frames[: len(frames) // 2], pose + jitter]))
        assert not fitted.diagnose(seen).fault_set
