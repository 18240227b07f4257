"""The model on grasps that hardly ever let go: most cells rest in few recordings only."""

from collections.abc import Sequence

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    Line,
    SelfDiagnosis,
    SensorLayout,
    bridge,
    inject,
    line_fault,
)


@pytest.fixture(scope="module")
def layout(small_grasps: Recordings) -> SensorLayout:
    return small_grasps.layout


@pytest.fixture(scope="module")
def fitted(small_grasps: Recordings) -> SelfDiagnosis:
    return SelfDiagnosis(small_grasps.layout).fit(small_grasps.frames[::2])


@pytest.fixture(scope="module")
def log(small_grasps: Recordings) -> list[np.ndarray]:
    """Recordings that the reference does not hold."""
    return [small_grasps.frames[i].astype(float) for i in range(1, 90, 6)]


@pytest.fixture(scope="module")
def often(log: list[np.ndarray]) -> list[int]:
    """The cells that carry most load, the most loaded first."""
    return np.argsort(-np.mean([r.max(axis=0) for r in log], axis=0), kind="stable").tolist()


def broken(log: Sequence[np.ndarray], faults: list[Fault], layout: SensorLayout, **how: float):
    return [inject(r, faults, layout, seed=i, **how) for i, r in enumerate(log)]


def told(diagnosis: Diagnosis) -> list[tuple[FaultKind, Line | None, tuple[int, ...]]]:
    return [(fault.kind, fault.line, fault.cells) for fault in diagnosis.faults]


def test_cells_rest_at_the_lowest_that_they_read_in_a_few_recordings(fitted):
    rest = fitted._model.symbols.rest
    assert rest.level.max() <= 0.002 * rest.full


def test_of_a_healthy_log_nobody_is_blamed_and_no_pad_is_disturbed(fitted, log):
    stream = fitted.stream()
    for recording in log:
        stream.begin_recording()
        stream.extend(recording)
    assert not fitted._model.log_of_record(stream.complete().record()).disturbed.any()
    assert told(fitted.diagnose(log)) == []


@pytest.mark.parametrize("beside", [False, True])
def test_a_grasp_that_is_held_blames_nobody(fitted, log, beside):
    rng = np.random.default_rng(0)
    shape = (200, log[0].shape[1])
    noise = 0.002 * rng.normal(size=(200, 1)) + 0.005 * rng.normal(size=shape)
    hold = log[3][30:31] * (1 + noise)
    assert told(fitted.diagnose([*log, hold] if beside else [hold])) == []


def test_a_short_with_the_dither_of_its_converter_is_a_short(fitted, log, often, layout):
    faults = [Fault("short", (often[3],))]
    found = fitted.diagnose(broken(log, faults, layout, dither=0.004))
    assert told(found) == [(FaultKind.SHORT, None, (often[3],))]


def test_a_shorted_row_is_one_fault(fitted, log, layout):
    row = line_fault(layout, Line(0, "row", 2), "short")
    assert told(fitted.diagnose(broken(log, [row], layout, dither=0.004))) == [
        (FaultKind.SHORT, Line(0, "row", 2), row.cells)
    ]


def test_bridged_rows_are_named_and_their_copies_mislead_nobody(fitted, log, layout):
    (fault,) = fitted.diagnose(broken(log, [bridge(layout, Line(0, "row", 2))], layout)).faults
    assert (fault.kind, fault.line, fault.value) == (FaultKind.ALIAS, Line(0, "row", 2), 3)


def test_a_cell_that_reads_a_part_of_its_load_is_weak_with_its_gain(fitted, log, often):
    cell = often[4]
    for recording in (worn := [r.copy() for r in log]):
        recording[:, cell] *= 0.15
    (fault,) = fitted.diagnose(worn).faults
    assert (fault.kind, fault.cells) == (FaultKind.WEAK, (cell,))
    assert fault.value == pytest.approx(0.15, abs=0.06)


def test_a_cell_that_no_longer_comes_to_rest_is_found(fitted, log, often, layout):
    whole = np.concatenate(log)
    ramp = [Fault("drift", (often[6],), value=0.03, onset=100)]
    drifts = np.split(inject(whole, ramp, layout), len(log))
    assert fitted.diagnose(drifts).fault_set == {often[6]}


def test_a_cell_that_was_dead_in_the_reference_is_faulty_until_it_moves(small_grasps, log, layout):
    cell = 22
    dead = [np.where(np.arange(layout.n_cells) == cell, 2.0, r) for r in small_grasps.frames[::2]]
    fitted = SelfDiagnosis(layout).fit(dead)
    stuck = [np.where(np.arange(layout.n_cells) == cell, 2.0, r) for r in log]
    assert told(fitted.diagnose(stuck)) == [(FaultKind.STUCK, None, (cell,))]
    assert told(fitted.diagnose(log)) == []
