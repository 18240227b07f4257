import tracemalloc

import numpy as np
import pytest
from conftest import fit_of

from diagnostics import (
    Fault,
    FaultKind,
    Line,
    Monitor,
    SelfDiagnosis,
    SensorLayout,
    inject,
    line_fault,
)
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import HALO, TILE, tiles
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.scale import Scale
from diagnostics.simulation.injection import bridge

SKIN = SensorLayout(2, 16, 16, rate=20.0)  # more cells than one tile has


def log(
    layout: SensorLayout, frames: int, seed: int, rows_touched: tuple[float, float] | None = None
) -> np.ndarray:
    """Readings ``[T, D]``: presses with sharp edges come and go, each in its own time, for every
    100 cells."""
    rng = np.random.default_rng(seed)
    out = np.zeros((frames, *layout.shape), np.float32)
    rows, cols = np.mgrid[: layout.rows, : layout.cols]
    low, high = rows_touched or (0, layout.rows)
    for _ in range(max(1, round(layout.pads * (high - low) * layout.cols * frames / 10000))):
        first = int(rng.integers(-10, frames - 10))
        lasts = int(rng.integers(20, 40))
        when = np.arange(max(first, 0), min(first + lasts, frames))
        r = rng.uniform(low, high)
        c = rng.uniform(0, layout.cols)
        size = rng.uniform(2, 4)
        shape = np.maximum(0, 1 - ((rows - r) ** 2 + (cols - c) ** 2) / size**2)
        force = rng.uniform(1, 3) * np.sin(np.pi * (when - first + 1) / (lasts + 1))
        out[when, int(rng.integers(layout.pads))] += force[:, None, None] * shape
    out *= np.random.default_rng(1).uniform(0.8, 1.2, layout.shape)  # no two cells are alike
    step = layout.full_scale / 4095
    return (
        np.round(np.clip(np.where(out < 0.05, 0, out), 0, layout.full_scale) / step) * step
    ).reshape(frames, -1)


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    with fit_of(200, 8):  # a rougher one alarms
        return SelfDiagnosis(SKIN).fit([log(SKIN, 199, seed) for seed in range(7)])


def test_each_cell_is_an_output_of_one_tile_with_all_cells_near_it_on_its_pad_as_inputs():
    present = np.ones((2, 30, 21), bool)
    present[0, :9, :9] = False
    layout = SensorLayout(2, 30, 21, present=present)
    every = tiles(layout)
    outputs = np.sort(np.concatenate([tile.outputs for tile in every]))
    np.testing.assert_array_equal(outputs, np.flatnonzero(present))
    for tile in every:
        near = set(tile.inputs.tolist())
        assert len(tile.outputs) <= TILE**2
        for pad, r, c in map(layout.position, tile.outputs.tolist()):
            block = np.zeros(layout.shape, bool)
            block[pad, max(0, r - HALO) : r + HALO + 1, max(0, c - HALO) : c + HALO + 1] = True
            assert set(np.flatnonzero(block & present).tolist()) <= near


def test_an_array_of_a_few_hundred_cells_is_one_tile():
    assert len(tiles(SensorLayout.paper())) == 1
    assert len(tiles(SensorLayout(2, 13, 6))) == 1


def test_a_tile_in_which_nothing_moves_is_not_processed():
    events = TiledEvents.begin(tiles(SKIN))
    still = np.ones(SKIN.n_cells, bool)
    numbers = np.arange(32)
    still[SKIN.cell(1, 12, 12)] = False
    frames = np.zeros((32, SKIN.n_cells))
    frames[:, ~still] = np.linspace(0, 2, 32)[:, None]
    scale = Scale(np.zeros(SKIN.n_cells), 0.05, 5.0)
    start = np.where(still, 0, 31)
    after = events.extend(scale.root_load(frames), numbers, scale.root_near, start)
    changed = {i for i, tile in enumerate(events.tiles) if not still[tile.inputs].all()}
    assert {
        i for i, (a, b) in enumerate(zip(events.of, after.of, strict=True)) if a is not b
    } == changed
    assert 0 < len(changed) < len(events.tiles)


def test_dead_cells_rows_and_a_bridge_are_found_and_hardly_a_healthy_cell_is_reported(fitted):
    rng = np.random.default_rng(0)
    faults = [
        Fault(FaultKind.SHORT, (int(c),)) for c in rng.choice(SKIN.n_cells // 2, 12, replace=False)
    ]
    faults += [
        line_fault(SKIN, Line(0, "row", 10), FaultKind.OPEN),
        bridge(SKIN, Line(1, "column", 10)),
    ]
    diagnosis = fitted.diagnose([inject(log(SKIN, 200, 50 + i), faults, SKIN) for i in range(4)])
    broken = {cell for fault in faults for cell in fault.cells}
    assert {f.line for f in diagnosis.faults[:2]} == {Line(0, "row", 10), Line(1, "column", 10)}
    assert broken <= set(diagnosis.fault_set)
    assert len(diagnosis.fault_set) <= 1.06 * len(broken)


def test_a_stuck_address_bit_is_named_even_where_cells_of_its_lines_are_dead(fitted):
    dead = [Fault(FaultKind.SHORT, (SKIN.cell(1, row, 3 * row % 16),)) for row in range(0, 16, 3)]
    fault = line_fault(SKIN, Line(1, "row_address", 1), FaultKind.ALIAS, value=1)
    found = fitted.diagnose(
        [inject(log(SKIN, 200, 60 + i), [fault, *dead], SKIN) for i in range(3)]
    ).faults
    assert found[0].line == fault.line


def test_a_healthy_log_raises_no_alarm(fitted):
    assert not fitted.diagnose([log(SKIN, 300, 70), log(SKIN, 300, 71)]).faults


def test_a_short_without_any_contact_is_found_and_an_object_at_rest_there_is_no_fault(fitted):
    frames = log(SKIN, 400, 80)
    frames.reshape(400, *SKIN.shape)[:, 1] = 0.0  # no contact on pad 1
    short = SKIN.cell(1, 12, 12)
    found = fitted.diagnose(inject(frames, [Fault(FaultKind.SHORT, (short,))], SKIN)).fault_set
    assert found == {short}
    rows, cols = np.mgrid[:16, :16]
    thing = np.clip(3 - 0.3 * ((rows - 5) ** 2 + (cols - 11) ** 2), 0, None)
    for begin in (0, 33):
        lies = frames.copy()
        lies.reshape(400, *SKIN.shape)[begin:, 1] = thing
        assert not fitted.diagnose(lies).fault_set


def test_monitor_and_diagnosis_agree(fitted):
    fault = line_fault(SKIN, Line(0, "column", 9), FaultKind.SHORT, onset=40)
    frames = inject(log(SKIN, 200, 80), [fault], SKIN)
    monitor = Monitor(fitted, wait=True)
    news = [fault for frame in frames for fault in monitor.update(frame)]
    assert any(n.line == fault.line for n in news)
    assert monitor.diagnosis().to_dict() == fitted.diagnose(frames).to_dict()


def test_dropped_events_leave_their_evidence(monkeypatch):
    monkeypatch.setattr("diagnostics.evidence.cold_start.MAX_EVENTS", 3)
    monkeypatch.setattr("diagnostics.evidence.cold_start.KEPT_EVENTS", 2)
    diagnosis = SelfDiagnosis(SKIN)
    healthy = log(SKIN, 600, 90)
    stream = diagnosis.stream()
    dead = np.argsort((healthy > 0.5).sum(axis=0))[[-1, -100, -200]]  # often loaded
    frames = inject(healthy, [Fault(FaultKind.OPEN, (int(cell),)) for cell in dead], SKIN)
    stream.extend(frames)
    assert max(len(events.kept) for events in stream.cold.events.of) <= 5
    assert stream.cold.accumulated[dead].min() > 1
    frame_by_frame = diagnosis.stream()
    for frame in frames:
        frame_by_frame.extend(frame[None])
    np.testing.assert_array_equal(
        frame_by_frame.complete().cold.accumulated, stream.complete().cold.accumulated
    )


def test_a_dead_row_of_an_array_of_10000_cells_is_found_without_a_reference():
    layout = SensorLayout(1, 100, 100, rate=20.0)
    fault = line_fault(layout, Line(0, "row", 50), FaultKind.SHORT)
    found = SelfDiagnosis(layout).diagnose(inject(log(layout, 120, 0, (46, 54)), [fault], layout))
    assert [f.line for f in found.faults if f.line] == [fault.line]
    assert set(fault.cells) <= set(found.fault_set)


@pytest.mark.slow
def test_memory_per_cell_does_not_grow_with_the_array_in_fitting_or_diagnosing():
    peaks = []
    for pads in (2, 6):
        layout = SensorLayout(pads, 16, 16)
        recordings = RecordingBlocks(
            [log(layout, 40, seed).astype(np.float32) for seed in range(2)]
        )
        diagnoser = SelfDiagnosis(layout)
        for work in (
            lambda: diagnoser.fit(list(recordings)),  # noqa: B023
            lambda: diagnoser.diagnose(list(recordings)),  # noqa: B023
        ):
            tracemalloc.start()
            work()
            peaks.append(tracemalloc.get_traced_memory()[1] / layout.n_cells)
            tracemalloc.stop()
    assert peaks[2] < 1.15 * peaks[0]
    assert peaks[3] < 1.15 * peaks[1]


def test_numbers_of_any_kind_are_converted_where_they_are_read_and_give_the_same():
    frames = log(SKIN, 40, 0)
    counts = np.round(frames / 5.0 * 4095).astype(np.uint16)
    layout = SensorLayout(2, 16, 16, full_scale=4095, unit="counts")
    cold = SelfDiagnosis(layout)
    assert cold.diagnose(counts).to_dict() == cold.diagnose(counts.astype(float)).to_dict()
    assert (
        cold.diagnose([counts.reshape(40, 2, 16, 16)]).to_dict() == cold.diagnose(counts).to_dict()
    )
