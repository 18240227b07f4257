import numpy as np
import pytest

from diagnostics import Fault, FaultKind, Line, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 11, 10)


@pytest.fixture
def recording() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 3, (50, LAYOUT.n_cells))


def test_no_fault_changes_nothing_bit_for_bit(recording):
    recording[3, 7] = 9.0  # out of range, but not ours to mend
    np.testing.assert_array_equal(inject(recording, [], LAYOUT), recording)


@pytest.mark.parametrize(
    ("kind", "value", "reads"), [("open", None, 0.0), ("short", None, 5.0), ("stuck", 2.2, 2.2), ("open", 0.1, 0.1)]
)
def test_a_dead_cell_reads_its_value_from_the_onset_on_and_nothing_else_changes(recording, kind, value, reads):
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
    fault = line_fault(LAYOUT, Line(1, "row_address", 2), FaultKind.ALIAS, value=level)
    grid = LAYOUT.grid(inject(recording, [fault], LAYOUT))
    np.testing.assert_array_equal(grid[:, 1, row], LAYOUT.grid(recording)[:, 1, read])
    np.testing.assert_array_equal(grid[:, 1, read], LAYOUT.grid(recording)[:, 1, read])
    np.testing.assert_array_equal(grid[:, 0], LAYOUT.grid(recording)[:, 0])


def test_an_address_with_nothing_connected_reads_zero(recording):
    fault = line_fault(LAYOUT, Line(0, "row_address", 2), FaultKind.ALIAS, value=1)
    assert (LAYOUT.grid(inject(recording, [fault], LAYOUT))[:, 0, 8:] == 0).all()  # rows 8..10 would be 12..14


def test_an_alias_may_name_a_row_or_a_cell(recording):
    by_row = Fault("alias", LAYOUT.cells_on(Line(0, "row", 1)), line=Line(0, "row", 1), value=4)
    grid = LAYOUT.grid(inject(recording, [by_row], LAYOUT))
    np.testing.assert_array_equal(grid[:, 0, 1], LAYOUT.grid(recording)[:, 0, 4])
    np.testing.assert_array_equal(inject(recording, [Fault("alias", (1,), value=9)], LAYOUT)[:, 1], recording[:, 9])


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


def test_missing_readings_stay_missing(recording):
    recording[5] = np.nan
    broken = inject(recording, [Fault("short", (1,))], LAYOUT)
    assert np.isnan(broken[5]).all()
    assert broken[6, 1] == 5


def test_what_cannot_be_injected_is_said():
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
    np.testing.assert_array_equal(inject(recording, [Fault("short", (2,), onset=99)], LAYOUT), recording)
