import numpy as np
import pytest

from diagnostics import Line, SensorLayout


def test_cells_run_pad_then_row_then_column():
    layout = SensorLayout(2, 11, 10)
    grid = np.arange(layout.n_cells).reshape(layout.shape)
    for position in [(0, 0, 0), (0, 10, 9), (1, 0, 0), (1, 3, 7)]:
        assert layout.cell(*position) == grid[position]
        assert layout.position(int(grid[position])) == position


def test_the_paper_has_two_pads_of_11_by_10_at_10_hz_up_to_5_newton():
    layout = SensorLayout.paper()
    assert (layout.shape, layout.n_cells, layout.full_scale, layout.rate, layout.unit) == (
        (2, 11, 10),
        220,
        5,
        10,
        "N",
    )


def test_the_paper_has_four_address_bits_for_rows_and_four_for_columns():
    bits = [line for line in SensorLayout.paper().lines if line.kind.endswith("address")]
    assert len(bits) == 2 * (4 + 4)


def test_each_cell_is_on_one_row_one_column_and_one_converter():
    layout = SensorLayout(2, 3, 4)
    for kind in ("row", "column", "converter"):
        served = np.concatenate(
            [layout.cells_on(line) for line in layout.lines if line.kind == kind]
        )
        assert sorted(served) == list(range(layout.n_cells))


def test_masked_positions_keep_their_index_and_lie_on_no_line():
    present = np.ones((1, 2, 3), bool)
    present[0, 0, 0] = False
    layout = SensorLayout(1, 2, 3, present=present)
    assert layout.n_cells == 6
    assert all(0 not in layout.cells_on(line) for line in layout.lines)


@pytest.mark.parametrize("level", [0, 1])
def test_a_stuck_address_bit_sends_rows_to_the_row_with_that_bit_forced(level: int):
    layout = SensorLayout(1, 11, 10)
    cells, sources = layout.misaddressed(Line(0, "row_address", 2), level)
    for cell, source in zip(cells, sources, strict=True):
        _, row, column = layout.position(int(cell))
        forced = row | 4 if level else row & ~4
        assert forced != row
        assert source == (layout.cell(0, forced, column) if forced < 11 else -1)
    moved = {layout.position(int(c))[1] for c in cells}
    assert moved == {row for row in range(11) if (row >> 2) % 2 != level}


def test_a_layout_survives_json():
    present = np.ones((2, 3, 4), bool)
    present[1, 2] = False
    layout = SensorLayout(2, 3, 4, full_scale=4095, unit="count", rate=31.25, present=present)
    assert SensorLayout.from_dict(layout.to_dict()) == layout
    assert hash(SensorLayout.from_dict(layout.to_dict())) == hash(layout)
    assert SensorLayout(2, 3, 4) != layout


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorLayout(0, 3, 4), "pads >= 1"),
        (lambda: SensorLayout(2, 3.5, 4), "rows >= 1"),
        (lambda: SensorLayout(2, 3, 4, full_scale=0), "full_scale > 0"),
        (lambda: SensorLayout(2, 3, 4, rate=float("nan")), "rate > 0"),
        (lambda: SensorLayout(2, 3, 4, unit="N\n\x1b[31m"), "name of a unit"),
        (lambda: SensorLayout(2, 3, 4, present=np.ones(23, bool)), "one bool for each position"),
        (lambda: SensorLayout(2, 3, 4, present=np.zeros(24, bool)), "at least one cell"),
        (lambda: SensorLayout.from_dict({"pads": 2, "rows": 3}), "needs the field 'cols'"),
        (
            lambda: SensorLayout.from_dict({"pads": 2, "rows": 3, "cols": 4, "colour": 1}),
            "no field 'colour'",
        ),
        (
            lambda: SensorLayout.from_dict({"pads": 2, "rows": 3, "cols": 4, "rate": []}),
            "wrong kind",
        ),
        (lambda: SensorLayout(2, 3, 4).check_recording(np.zeros((5, 23))), r"expected \[T, 24\]"),
        (lambda: SensorLayout(2, 3, 4).check_recording([["a"] * 24]), "expected numbers"),
        (lambda: Line(0, "diagonal", 1), "unknown kind of line"),
    ],
)
def test_a_bad_layout_is_refused_in_one_line(make, message: str):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_a_place_outside_the_layout_is_an_index_error():
    layout = SensorLayout(2, 3, 4)
    for ask in (
        lambda: layout.cell(0, 3, 0),
        lambda: layout.position(24),
        lambda: layout.position(-1),
        lambda: layout.cells_on(Line(0, "row", 3)),
        lambda: layout.misaddressed(Line(0, "row", 1), 0),
    ):
        with pytest.raises(IndexError):
            ask()


def test_the_cells_beside_one_lie_on_its_pad_and_exist():
    layout = SensorLayout(2, 3, 3, present=np.arange(18).reshape(2, 3, 3) != 1)
    assert layout.beside[4].tolist() == [0, -1, 2, 3, 5, 6, 7, 8]
    assert layout.beside[9].tolist() == [-1, -1, -1, -1, 10, -1, 12, 13]
    for cell in (0, 4, 8, 13):
        assert all(cell in layout.beside[other] for other in layout.beside[cell] if other >= 0)


ONE_PAD = SensorLayout(1, 3, 4)


@pytest.mark.parametrize("shape", [(12,), (3, 4), (1, 3, 4)])
def test_recordings_of_one_pad_may_have_its_rows_and_columns_alone(shape):
    flat = np.arange(2 * 5 * 12.0).reshape(2, 5, 12)
    several = flat.reshape(2, 5, *shape)
    one = flat[0].reshape(5, *shape)
    np.testing.assert_array_equal(ONE_PAD.check_recording(one), flat[0])
    np.testing.assert_array_equal(ONE_PAD.check_frame(one[2]), flat[0, 2])
    for given, wanted in (
        (one, flat[:1]),
        (several, flat),
        (list(several), flat),
        (tuple(several), flat),
    ):
        np.testing.assert_array_equal(
            [ONE_PAD.check_recording(r) for r in ONE_PAD.recordings(given)], wanted
        )


def test_rows_and_columns_alone_are_no_frame_of_several_pads():
    with pytest.raises(ValueError, match=r"expected \[T, 24\] or \[T, 2, 3, 4\], got \[5, 3, 4\]"):
        SensorLayout(2, 3, 4).check_recording(np.zeros((5, 3, 4)))
    with pytest.raises(ValueError, match=r"expected a frame \[24\] or \[2, 3, 4\], got \[3, 4\]"):
        SensorLayout(2, 3, 4).check_frame(np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"or \[T, 3, 4\], got \[5, 4, 3\]"):
        ONE_PAD.check_recording(np.zeros((5, 4, 3)))
