"""Positions with several readings each, as 3-axis magnetic taxels."""

from dataclasses import replace

import numpy as np
import pytest

from diagnostics import Diagnosis, FaultKind, Line, Monitor, SelfDiagnosis, SensorLayout, StaticLoad

TAXELS = SensorLayout(1, 6, 6, full_scale=1000, unit="count", axes=3)


def recordings(count: int, seed: int) -> list[np.ndarray]:
    """Return contacts on taxels that rest at 500 counts: pressure lowers axis 2, shear moves 0 and
    1 either way."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:6, :6]
    found = []
    for _ in range(count):
        frames = 500 + rng.normal(0, 1, (60, 6, 6, 3))
        for _ in range(2):
            (x, y), begin, angle = (
                rng.uniform(0, 6, 2),
                int(rng.integers(45)),
                rng.uniform(0, 2 * np.pi),
            )
            course = np.sin(np.linspace(0, np.pi, 15))[:, None, None] * rng.uniform(100, 400)
            force = course * np.exp(-((row - x) ** 2 + (col - y) ** 2) / 4)
            shear = np.array([np.cos(angle) / 2, np.sin(angle) / 2, -1])
            frames[begin : begin + 15] += force[..., None] * shear
        found.append(np.clip(np.round(frames), 0, 1000).reshape(60, -1))
    return found


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(TAXELS).fit(recordings(40, 0))


def test_the_axis_runs_last_and_each_position_is_a_wire():
    assert (TAXELS.n_cells, TAXELS.shape) == (108, (1, 6, 18))
    assert TAXELS.cell(0, 2, 3, axis=1) == 46
    assert TAXELS.position(46) == (0, 2, 3)
    assert TAXELS.place(46) == "pad 0, position 15, axis 1 (cell 46)"
    assert TAXELS.lines[15] == Line(0, "position", 15)
    assert TAXELS.cells_on(TAXELS.lines[15]).tolist() == [45, 46, 47]
    assert SensorLayout.from_dict(TAXELS.to_dict()) == TAXELS
    with pytest.raises(IndexError, match="axis 3 is outside"):
        TAXELS.cell(0, 0, 0, 3)


def test_a_mask_of_positions_holds_for_their_axes():
    present = np.ones((1, 6, 6), bool)
    present[0, 0, 0] = False
    layout = SensorLayout(1, 6, 6, axes=3, present=present)
    assert np.flatnonzero(~layout.present.ravel()).tolist() == [0, 1, 2]
    assert SensorLayout.from_dict(layout.to_dict()) == layout


def test_frames_may_come_as_positions_and_axes():
    frames = recordings(1, 1)[0]
    np.testing.assert_array_equal(TAXELS.check_recording(frames.reshape(60, 1, 6, 6, 3)), frames)


def test_the_neighbours_of_a_cell_are_those_of_its_axis():
    cell = TAXELS.cell(0, 2, 3, axis=1)
    around = [
        TAXELS.cell(0, row, col, axis=1)
        for row in (1, 2, 3)
        for col in (2, 3, 4)
        if (row, col) != (2, 3)
    ]
    assert TAXELS.beside[cell].tolist() == around
    corner = TAXELS.beside[TAXELS.cell(0, 0, 0, axis=2)]
    assert corner[corner >= 0].tolist() == [
        TAXELS.cell(0, row, col, axis=2) for row, col in ((0, 1), (1, 0), (1, 1))
    ]


def test_cells_beside_an_object_are_disturbed(fitted: SelfDiagnosis):
    load = StaticLoad((43, 46), 0.99, None, "")
    diagnosis = replace(fitted.diagnose(recordings(8, 7)), static_loads=(load,))
    assert diagnosis.disturbed == {*load.cells, *TAXELS.beside[list(load.cells)].ravel().tolist()}


def test_healthy_taxels_have_no_fault(fitted: SelfDiagnosis):
    diagnosis = fitted.diagnose(recordings(12, 5))
    assert not diagnosis.faults
    assert diagnosis.coverage.test_coverage > 0.9


def test_a_dead_axis_is_a_cell_and_a_dead_position_one_cause(fitted: SelfDiagnosis):
    log = recordings(12, 7)
    for frames in log:
        frames[:, 45:48] = 0
        frames[:, 21:24] = np.nan
        frames[:, 77] = 500
    diagnosis = fitted.diagnose(log)
    told = {fault.cells: fault for fault in diagnosis.faults}
    assert set(told) == {(45, 46, 47), (21, 22, 23), (77,)}
    assert told[45, 46, 47].line == Line(0, "position", 15)
    assert told[45, 46, 47].value == 0
    assert told[21, 22, 23].reason.endswith("pad 0, position 7: all 3 axes on it are silent")
    assert (told[77,].kind, told[77,].line, told[77,].value) == (FaultKind.STUCK, None, 500)
    assert "pad 0, position 25, axis 2" in told[77,].reason
    assert "row" not in "".join(fault.reason for fault in diagnosis.faults)
    assert Diagnosis.from_dict(diagnosis.to_dict()).faults == diagnosis.faults
    assert len(diagnosis.map().splitlines()) == 7
    monitor = Monitor(SelfDiagnosis.from_state(*fitted.state()), wait=True)
    for frame in np.concatenate(log):
        monitor.update(frame)
    assert monitor.diagnosis().faults == diagnosis.faults


def test_positions_are_within_declared_groups(fitted: SelfDiagnosis):
    layout = SensorLayout(
        1, 2, 4, axes=3, groups={"chip 0": list(range(12)), "chip 1": list(range(12, 24))}
    )
    assert [str(line) for line in layout.lines[-2:]] == ["chip 0", "chip 1"]
    assert len(layout.parts(layout.lines[-1])) == 4
    with pytest.raises(ValueError, match="'chip' and 'pad 0, position 1' overlap"):
        SensorLayout(1, 2, 4, axes=3, groups={"chip": [0, 1, 2, 3]})
