"""Calibration: counts become newtons by a table a cell."""

import numpy as np
import pytest

from adaptfault.data.calibration import Calibration
from adaptfault.data.recordings import InputError
from diagnostics import SensorLayout


def random_tables(seed, cells=7, most=9):
    """Return tables of random lengths, padded with NaN."""
    rng = np.random.default_rng(seed)
    raw, force = np.full((2, cells, most), np.nan)
    for cell in range(cells):
        points = rng.integers(2, most + 1)
        raw[cell, :points] = np.sort(rng.choice(4096, points, replace=False))
        force[cell, :points] = np.sort(rng.uniform(0, 5, points))
    return Calibration(raw, force)


@pytest.mark.parametrize("seed", range(5))
def test_apply_agrees_with_interpolation_of_each_cell(seed):
    tables = random_tables(seed)
    # more than one block
    counts = np.random.default_rng(seed).uniform(-100, 4200, (5000, tables.n_cells))
    newtons, out = tables.apply(counts)
    assert newtons.dtype == np.float32
    for cell in range(tables.n_cells):
        points = ~np.isnan(tables.raw[cell])
        raw = tables.raw[cell, points]
        force = tables.force[cell, points]
        np.testing.assert_array_equal(
            newtons[:, cell], np.interp(counts[:, cell], raw, force).astype(np.float32)
        )
        assert out.below[cell] == (counts[:, cell] < raw[0]).sum()
        assert out.above[cell] == (counts[:, cell] > raw[-1]).sum()
    assert out.total == out.below.sum() + out.above.sum()


@pytest.mark.parametrize("seed", range(5))
def test_at_the_points_of_the_tables_the_force_is_exact(seed):
    tables = random_tables(seed)
    newtons, out = tables.apply(tables.raw.T)
    np.testing.assert_array_equal(newtons, tables.force.T.astype(np.float32))
    assert out.total == 0


@pytest.mark.parametrize("seed", range(5))
def test_more_counts_never_mean_less_force(seed):
    tables = random_tables(seed)
    newtons, _ = tables.apply(np.repeat(np.arange(4200.0)[:, None], tables.n_cells, axis=1))
    assert (np.diff(newtons, axis=0) >= 0).all()


def test_readings_outside_a_table_are_clamped_and_counted_and_nan_stays():
    tables = Calibration([[10, 20], [0, 100]], [[1, 2], [0, 5]])
    newtons, out = tables.apply([[5, -1], [25, 101], [np.nan, 50], [15, 200]])
    np.testing.assert_array_equal(newtons, [[1, 0], [2, 5], [np.nan, 2.5], [1.5, 5]])
    assert (out.below.tolist(), out.above.tolist(), out.total) == ([1, 1], [1, 2], 5)


def test_a_single_frame_and_whole_numbers_are_taken():
    newtons, _ = Calibration([[0, 4]], [[0, 1]]).apply(np.array([1], np.uint16))
    assert newtons.tolist() == [0.25]


def test_a_position_without_a_table_reads_zero_and_only_masked_ones_may():
    tables = Calibration([[0, 10], [np.nan, np.nan]], [[0, 1], [np.nan, np.nan]])
    assert tables.apply([[5, 5]])[0].tolist() == [[0.5, 0.0]]
    tables.check(SensorLayout(1, 1, 2, present=[True, False]))
    with pytest.raises(ValueError, match="cell 1 has no table"):
        tables.check(SensorLayout(1, 1, 2))
    with pytest.raises(ValueError, match="2 cells, but the layout has 3"):
        tables.check(SensorLayout(1, 1, 3))


def test_counts_of_another_width_are_refused():
    with pytest.raises(ValueError, match=r"expected counts \[T, 7\] or \[7\], got \[3, 6\]"):
        random_tables(0).apply(np.zeros((3, 6)))


@pytest.mark.parametrize(
    ("raw", "force", "expected"),
    [
        (
            [[0, 1], [5, 5]],
            [[0, 1], [0, 1]],
            "cell 1: raw must increase from point to point, but 5 comes after 5",
        ),
        ([[0, 1], [6, 5]], [[0, 1], [0, 1]], "cell 1: raw must increase"),
        ([[0, 1, 2]], [[0, 2, 1]], "cell 0: force falls from 2 to 1 while raw rises from 1 to 2"),
        ([[0, np.inf]], [[0, 1]], "cell 0: a point is infinite"),
        ([[0, np.nan, 2]], [[0, np.nan, 2]], "cell 0: NaN in raw may only pad the end"),
        ([[0, 1]], [[0, np.nan]], "cell 0: NaN in force may only pad the end"),
        ([[0, np.nan]], [[0, np.nan]], "cell 0: 1 point; a table needs at least 2"),
        ([[0, 1]], [[0, 1, 2]], r"expected raw and force of one shape"),
        ([0, 1], [0, 1], r"expected raw and force of one shape \[D, P\]"),
    ],
)
def test_a_table_that_is_none_is_refused_with_the_cell(raw, force, expected):
    with pytest.raises(ValueError, match=expected):
        Calibration(raw, force)


def test_the_tables_cannot_be_changed_by_accident():
    raw = np.array([[0.0, 1.0]])
    tables = Calibration(raw, raw)
    raw[0, 0] = 9
    assert tables.raw[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        tables.raw[0, 0] = 9


def test_what_is_written_is_read_back_exactly(tmp_path):
    tables = random_tables(3)
    tables.write(tmp_path / "tables.csv")
    again = Calibration.read(tmp_path / "tables.csv")
    width = again.raw.shape[1]
    np.testing.assert_array_equal(again.raw, tables.raw[:, :width])
    np.testing.assert_array_equal(again.force, tables.force[:, :width])
    assert [p.name for p in tmp_path.iterdir()] == ["tables.csv"]


def test_the_lines_of_a_table_may_come_in_any_order(tmp_path):
    path = tmp_path / "tables.csv"
    path.write_text(
        "\ufeffCell,Raw,Force\r\n1,50,2\r\n0,0,0\r\n1,0,0\r\n\r\n0,10,1\r\n", newline=""
    )
    tables = Calibration.read(path, SensorLayout(1, 1, 2))
    assert tables.raw.tolist() == [[0, 10], [0, 50]]
    assert tables.force.tolist() == [[0, 1], [0, 2]]
    masked = SensorLayout(1, 1, 3, present=[True, True, False])
    assert Calibration.read(path, masked).calibrated.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "is empty"),
        ("\n", "line 1: expected a first line 'cell,raw,force'"),
        ("0,1,2\n", "line 1: expected a first line 'cell,raw,force'"),
        ("cell;raw;force\n", "line 1: expected a first line 'cell,raw,force', separated by commas"),
        ("cell,raw,force\n", "holds no points"),
        ("cell,raw,force\n0,1\n", "line 2: 2 values, expected 3"),
        ("cell,raw,force\n0,1,2\n0,x,3\n", "line 3: expected three numbers"),
        ("cell,raw,force\n0.5,1,2\n", "line 2: expected three numbers: cell (whole)"),
        ("cell,raw,force\n0,nan,2\n", "line 2: raw and force must be finite"),
        ("cell,raw,force\n-1,1,2\n", "line 2: cell -1: cells are numbered from 0"),
        ("cell,raw,force\n99999999999,1,2\n", "line 2: cell 99999999999"),
        (
            "cell,raw,force\n0,0,0\n0,5,1\n1,0,0\n",
            "line 4: cell 1 has 1 point; a table needs at least 2",
        ),
        (
            "cell,raw,force\n0,0,0\n0,5,1\n2,0,0\n2,1,1\n",
            "cell 1 has no points (1 cells have none)",
        ),
        (
            "cell,raw,force\n0,0,0\n0,5,1\n0,5,2\n",
            "line 4: cell 0: raw must increase from point to point",
        ),
        (
            "cell,raw,force\n0,5,1\n0,0,2\n",
            "line 3: cell 0: force falls from 2 to 1 while raw rises from 0 to 5 (line 2)",
        ),
        (
            "cell,raw,force\n0,0,0\n0,5,1\n3,0,0\n3,1,1\n",
            "line 4: cell 3, but the layout has 3 cells",
        ),
    ],
)
def test_a_bad_table_is_refused_with_its_line_and_cell(tmp_path, content, expected):
    path = tmp_path / "tables.csv"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        Calibration.read(path, SensorLayout(1, 1, 3))
    assert str(caught.value).startswith(str(path))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tables_that_cannot_be_read_or_written_are_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        Calibration.read(tmp_path / "gone.csv")
    with pytest.raises(FileNotFoundError):
        random_tables(0).write(tmp_path / "gone/tables.csv")
