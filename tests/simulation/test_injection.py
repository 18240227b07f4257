import numpy as np
import pytest

from diagnostics import Fault, FaultKind, FaultSet, Line, SensorLayout, inject, line_fault
from diagnostics.simulation.injection import bridge, freeze_stream, lose_frames

LAYOUT = SensorLayout(2, 11, 10)


@pytest.fixture
def recording() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 3, (50, LAYOUT.n_cells))


def test_no_fault_changes_nothing_bit_for_bit(recording):
    recording[3, 7] = 9.0  # out of range, but not ours to mend
    np.testing.assert_array_equal(inject(recording, [], LAYOUT), recording)


@pytest.mark.parametrize(
    ("kind", "value", "reads"),
    [("open", None, 0.0), ("short", None, 5.0), ("stuck", 2.2, 2.2), ("open", 0.1, 0.1)],
)
def test_a_dead_cell_reads_its_value_from_the_onset_on_and_nothing_else_changes(
    recording, kind, value, reads
):
    broken = inject(recording, [Fault(kind, (3, 150), value=value, onset=20)], LAYOUT)
    assert (broken[20:, [3, 150]] == reads).all()
    np.testing.assert_array_equal(broken[:20], recording[:20])
    others = np.setdiff1d(np.arange(220), [3, 150])
    np.testing.assert_array_equal(broken[:, others], recording[:, others])


def test_the_recording_given_is_not_changed(recording):
    before = recording.copy()
    inject(recording, [Fault("short", (1,))], LAYOUT)
    np.testing.assert_array_equal(recording, before)


def test_dither_stays_within_its_share_of_full_scale_and_moves(recording):
    broken = inject(recording, [Fault("stuck", (1,), value=2.5)], LAYOUT, seed=0, dither=0.004)
    assert 0.01 < np.abs(broken[:, 1] - 2.5).max() <= 0.02


@pytest.mark.parametrize(("level", "row", "read"), [(0, 6, 2), (1, 2, 6)])
def test_a_stuck_address_bit_makes_rows_exact_copies(recording, level, row, read):
    bit = Line(1, "row_address", 2)
    fault = line_fault(LAYOUT, bit, FaultKind.ALIAS, value=level)
    assert line_fault(LAYOUT, bit, "alias", value=level) == fault
    grid = LAYOUT.grid(inject(recording, [fault], LAYOUT))
    np.testing.assert_array_equal(grid[:, 1, row], LAYOUT.grid(recording)[:, 1, read])
    np.testing.assert_array_equal(grid[:, 1, read], LAYOUT.grid(recording)[:, 1, read])
    np.testing.assert_array_equal(grid[:, 0], LAYOUT.grid(recording)[:, 0])


def test_an_address_with_nothing_connected_reads_zero(recording):
    fault = line_fault(LAYOUT, Line(0, "row_address", 2), FaultKind.ALIAS, value=1)
    assert (
        LAYOUT.grid(inject(recording, [fault], LAYOUT))[:, 0, 8:] == 0
    ).all()  # rows 8..10 would be 12..14


def test_cells_alone_are_open(recording):
    broken = inject(recording, FaultSet((3, 7), LAYOUT.n_cells), LAYOUT)
    assert (broken[:, [3, 7]] == 0).all()
    assert np.array_equal(broken, inject(recording, [7, np.int64(3)], LAYOUT))
    with pytest.raises(ValueError, match="a fault needs at least one cell index"):
        inject(recording, ["3"], LAYOUT)


def test_an_alias_may_name_a_row_or_a_cell(recording):
    by_row = Fault("alias", LAYOUT.cells_on(Line(0, "row", 1)), line=Line(0, "row", 1), value=4)
    grid = LAYOUT.grid(inject(recording, [by_row], LAYOUT))
    np.testing.assert_array_equal(grid[:, 0, 1], LAYOUT.grid(recording)[:, 0, 4])
    np.testing.assert_array_equal(
        inject(recording, [Fault("alias", (1,), value=9)], LAYOUT)[:, 1], recording[:, 9]
    )


def test_an_intermittent_line_blinks_as_one_and_only_under_load(recording):
    cells = LAYOUT.cells_on(Line(0, "row", 1))
    recording[:, cells[0]] = 0.0
    broken = inject(recording, [Fault("intermittent", cells, value=5.0)], LAYOUT, seed=1)
    blinks = broken[:, cells[1:]] == 5.0
    assert 0.1 < blinks.mean() < 0.7
    assert (blinks == blinks[:, :1]).all()
    assert (broken[:, cells[0]] == 0).all()


def test_noise_has_the_given_spread_and_drift_the_given_rate(recording):
    recording[:] = 2.0
    noisy = inject(recording, [Fault("noisy", range(50), value=0.2)], LAYOUT, seed=0)[:, :50]
    assert np.std(noisy) == pytest.approx(0.2, rel=0.05)
    drifting = inject(recording, [Fault("drift", (0,), value=0.5, onset=10)], LAYOUT)
    assert drifting[-1, 0] - drifting[9, 0] == pytest.approx(0.5 * 40 / LAYOUT.rate)


def test_a_floating_cell_moves_within_its_range_whatever_touches_it(recording):
    fault = Fault("floating", (0, 7), value=1.0)
    floating = inject(recording, [fault], LAYOUT, seed=0)[:, [0, 7]]
    lowest = recording[:, [0, 7]].min(axis=0)
    assert (floating >= lowest).all()
    assert (floating <= lowest + 1.0).all()
    assert (np.ptp(floating, axis=0) > 0.3).all()
    np.testing.assert_array_equal(inject(recording, [fault], LAYOUT, seed=0)[:, [0, 7]], floating)


def test_a_late_cell_reads_what_it_read_before(recording):
    late = inject(recording, [Fault("late", (4,), value=6)], LAYOUT)[:, 4]
    np.testing.assert_array_equal(late[6:], recording[:-6, 4])
    assert (late[:6] == recording[0, 4]).all()


def test_a_copying_cell_reads_another_cell_or_the_mean_of_those_beside_it(recording):
    copied = inject(recording, [Fault("copy", (15,), value=3), Fault("copy", (0,))], LAYOUT)
    np.testing.assert_array_equal(copied[:, 15], recording[:, 3])
    np.testing.assert_allclose(copied[:, 0], recording[:, [1, 10, 11]].mean(axis=1))


def test_a_clamped_cell_reads_at_most_its_limit_and_a_weak_one_a_share_of_its_load(recording):
    limited = inject(recording, [Fault("clamped", (2,), value=1.0)], LAYOUT)[:, 2]
    np.testing.assert_array_equal(limited, np.minimum(recording[:, 2], 1.0))
    weak = inject(recording, [Fault("weak", (2,), value=0.25)], LAYOUT)[:, 2]
    lowest = recording[:, 2].min()
    np.testing.assert_allclose(weak - lowest, 0.25 * (recording[:, 2] - lowest))


def test_missing_readings_stay_missing(recording):
    recording[5] = np.nan
    broken = inject(recording, [Fault("short", (1,))], LAYOUT)
    assert np.isnan(broken[5]).all()
    assert broken[6, 1] == 5


def test_impossible_faults_are_refused_with_a_reason():
    frames = np.zeros((3, 220))
    with pytest.raises(ValueError, match="names cell 220"):
        inject(frames, [Fault("open", (220,))], LAYOUT)
    with pytest.raises(ValueError, match="needs a value"):
        inject(frames, [Fault("stuck", (2,))], LAYOUT)
    with pytest.raises(ValueError, match="needs a value"):
        inject(frames, [Fault("alias", (2,))], LAYOUT)
    with pytest.raises(IndexError, match="cell 400"):
        inject(frames, [Fault("alias", (2,), value=400)], LAYOUT)


def test_a_fault_that_starts_after_the_end_changes_nothing(recording):
    np.testing.assert_array_equal(
        inject(recording, [Fault("short", (2,), onset=99)], LAYOUT), recording
    )


@pytest.mark.parametrize("kind", sorted(set(FaultKind) - {FaultKind.SHORT}))
def test_faults_end_before_the_frame_until_and_the_cells_recover(recording, kind):
    fault = Fault(kind, (3, 150), value=1.0, onset=20)
    broken = inject(recording, [fault], LAYOUT, seed=0, until=30)
    np.testing.assert_array_equal(broken[30:], recording[30:])
    np.testing.assert_array_equal(broken[:20], recording[:20])
    assert (broken[20:30] != recording[20:30]).any()
    np.testing.assert_array_equal(inject(recording, [fault], LAYOUT, seed=0, until=10), recording)


def test_drift_gains_or_loses_a_share_of_the_reading_each_second(recording):
    recording[:] = 2.0
    drift = Fault("drift", (0,), value=0.0)
    loses = inject(recording, [drift], LAYOUT, gain=-0.1)
    np.testing.assert_allclose(loses[:, 0], 2.0 * (1 - 0.1 * np.arange(1, 51) / LAYOUT.rate))
    both = inject(recording, [Fault("drift", (0,), value=0.5)], LAYOUT, gain=-0.1)
    np.testing.assert_allclose(both - loses, (both - loses)[:, :1] * (np.arange(220) == 0))
    assert both[-1, 0] - loses[-1, 0] == pytest.approx(0.5 * 50 / LAYOUT.rate)
    np.testing.assert_array_equal(
        inject(recording, [Fault("open", (0,))], LAYOUT, gain=-0.1)[:, 1:], recording[:, 1:]
    )


@pytest.mark.parametrize(
    ("line", "driven_from", "dead"),
    [
        (Line(1, "row", 3), "first", [(1, 3, col) for col in range(6, 10)]),
        (Line(1, "row", 3), "last", [(1, 3, col) for col in range(6)]),
        (Line(0, "column", 9), "first", [(0, row, 9) for row in range(6, 11)]),
        (Line(0, "column", 9), "last", [(0, row, 9) for row in range(6)]),
    ],
)
def test_a_broken_line_loses_the_cells_beyond_the_break_seen_from_its_driven_end(
    recording, line, driven_from, dead
):
    fault = line_fault(LAYOUT, line, FaultKind.OPEN, break_at=6, driven_from=driven_from, onset=4)
    assert [LAYOUT.position(cell) for cell in fault.cells] == dead
    assert (fault.line, fault.onset) == (line, 4)
    assert (inject(recording, [fault], LAYOUT)[4:] == 0).any(0).sum() == len(dead)


def test_the_reason_of_a_break_names_its_position():
    first = line_fault(LAYOUT, Line(0, "row", 3), FaultKind.OPEN, break_at=5)
    last = line_fault(LAYOUT, Line(0, "column", 3), FaultKind.SHORT, break_at=5, driven_from="last")
    assert first.reason == "pad 0, row 3 is open from column 5 on"
    assert last.reason == "pad 0, column 3 is short up to row 4"


def test_a_break_at_the_driven_end_takes_the_whole_line():
    row = Line(0, "row", 3)
    assert (
        line_fault(LAYOUT, row, FaultKind.OPEN, break_at=0).cells
        == line_fault(LAYOUT, row, FaultKind.OPEN).cells
    )


def test_a_break_that_cannot_be_is_refused():
    present = np.ones(LAYOUT.shape, bool)
    present[0, 3, 8:] = False
    masked = SensorLayout(2, 11, 10, present=present)
    row = Line(0, "row", 3)
    with pytest.raises(ValueError, match="outside pad 0, row 3: use 0 to 10"):
        line_fault(LAYOUT, row, FaultKind.OPEN, break_at=11)
    with pytest.raises(ValueError, match="has no positions"):
        line_fault(LAYOUT, Line(0, "converter", 0), FaultKind.OPEN, break_at=1)
    with pytest.raises(ValueError, match="no cell behind a break at 10"):
        line_fault(LAYOUT, row, FaultKind.OPEN, break_at=10)
    with pytest.raises(ValueError, match="no cell behind a break at 8"):
        line_fault(masked, row, FaultKind.OPEN, break_at=8)
    with pytest.raises(ValueError, match="not with an alias"):
        line_fault(LAYOUT, row, FaultKind.ALIAS, value=2, break_at=5)
    with pytest.raises(ValueError, match="'first' or 'last'"):
        line_fault(LAYOUT, row, FaultKind.OPEN, break_at=5, driven_from="left")
    with pytest.raises(IndexError, match="not a wire"):
        line_fault(LAYOUT, Line(2, "row", 0), FaultKind.OPEN, break_at=5)


@pytest.mark.parametrize("kind", ["row", "column"])
def test_bridged_lines_both_read_the_sum_of_the_two_up_to_full_scale(recording, kind):
    fault = bridge(LAYOUT, Line(1, kind, 4), onset=10)
    pad = LAYOUT.grid(recording)[:, 1].swapaxes(1, 2 if kind == "column" else 1)
    read = LAYOUT.grid(inject(recording, [fault], LAYOUT))[:, 1].swapaxes(
        1, 2 if kind == "column" else 1
    )
    np.testing.assert_array_equal(read[10:, 4], np.minimum(pad[10:, 4] + pad[10:, 5], 5))
    np.testing.assert_array_equal(read[:, 4][10:], read[:, 5][10:])
    np.testing.assert_array_equal(np.delete(read, [4, 5], 1), np.delete(pad, [4, 5], 1))
    np.testing.assert_array_equal(read[:10], pad[:10])
    assert (read[10:, 4] == 5).any()


def test_a_cell_bridged_with_an_absent_one_reads_itself(recording):
    present = np.ones(LAYOUT.shape, bool)
    present[0, 4, 0] = present[0, 5, 1] = False
    masked = SensorLayout(2, 11, 10, present=present)
    read = masked.grid(inject(recording, [bridge(masked, Line(0, "row", 4))], masked))[:, 0]
    given = masked.grid(recording)[:, 0]
    np.testing.assert_array_equal(read[:, 5, 0], given[:, 5, 0])
    np.testing.assert_array_equal(read[:, 4, 1], given[:, 4, 1])


def test_a_bridge_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="last row"):
        bridge(LAYOUT, Line(0, "row", 10))
    with pytest.raises(ValueError, match="has none"):
        bridge(LAYOUT, Line(0, "row_address", 0))


def test_a_frozen_stream_repeats_one_frame_until_it_runs_again(recording):
    frozen = freeze_stream(recording, 20, until=30)
    assert (frozen[20:30] == recording[20]).all()
    np.testing.assert_array_equal(
        np.delete(frozen, range(20, 30), 0), np.delete(recording, range(20, 30), 0)
    )
    assert (freeze_stream(recording, 20)[20:] == recording[20]).all()
    np.testing.assert_array_equal(freeze_stream(recording, 99), recording)


def test_lost_frames_are_missing_as_a_whole_and_the_seed_chooses_them(recording):
    lost = lose_frames(recording, 0.3, seed=0)
    missing = np.isnan(lost)
    assert missing.all(1).sum() == missing.any(1).sum() == 15
    np.testing.assert_array_equal(lost[~missing], recording[~missing])
    np.testing.assert_array_equal(lost, lose_frames(recording, 0.3, seed=0))
    assert (np.isnan(lose_frames(recording, 0.3, seed=1)) != missing).any()
    np.testing.assert_array_equal(lose_frames(recording, 0.0), recording)


def test_times_and_shares_out_of_range_are_refused(recording):
    with pytest.raises(ValueError, match="until"):
        inject(recording, [], LAYOUT, until=-1)
    with pytest.raises(ValueError, match="numbered from 0"):
        freeze_stream(recording, -1)
    with pytest.raises(ValueError, match="part of the frames"):
        lose_frames(recording, 1.5)
