from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diagnostics import Fault, FaultKind, FaultSet, Line
from diagnostics.faults import KindName


def test_fault_kinds_are_strings():
    assert FaultKind.OPEN == "open"
    assert f"{FaultKind.STUCK}" == "stuck"
    assert FaultKind("alias") is FaultKind.ALIAS


def test_a_fault_set_is_a_set():
    f = FaultSet((5, 1, 5), 10)
    g = FaultSet((1, 2), 10)
    assert list(f) == [1, 5]
    assert len(f) == 2
    assert 5 in f
    assert 2 not in f
    assert np.int64(5) in f
    assert f | g == FaultSet((1, 2, 5), 10)
    assert f & g == FaultSet((1,), 10)
    assert f - g == FaultSet((5,), 10)
    assert f | [7] == {1, 5, 7}
    assert f != FaultSet((1, 5), 11)
    assert len({f, FaultSet((1, 5), 10)}) == 1


def test_mask_and_healthy_part_the_array():
    f = FaultSet((0, 3), 5)
    assert f.mask.tolist() == [True, False, False, True, False]
    assert f.healthy.tolist() == [1, 2, 4]
    assert FaultSet((), 5).healthy.tolist() == [0, 1, 2, 3, 4]
    assert FaultSet(range(5), 5).healthy.tolist() == []


@pytest.mark.parametrize("cells", [(220,), (-1,), (0.5,)])
def test_a_cell_that_the_array_lacks_is_named(cells):
    with pytest.raises(ValueError, match=r"numbered 0 to 219|whole numbers"):
        FaultSet(cells, 220)


def test_sets_over_different_arrays_do_not_mix():
    with pytest.raises(ValueError, match="10 and 11 cells"):
        FaultSet((1,), 10) | FaultSet((1,), 11)


def test_a_fault_survives_json():
    fault = Fault(
        FaultKind.SHORT, np.array([4, 2]), line=Line(1, "row", 3), value=5.0, onset=7, reason="why"
    )
    assert fault.cells == (2, 4)
    assert Fault.from_dict(fault.to_dict()) == fault
    with pytest.raises(ValueError, match="at least one cell"):
        Fault(FaultKind.OPEN, ())


def test_every_kind_may_be_given_by_its_name():
    assert set(get_args(KindName)) == {str(kind) for kind in FaultKind}


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_a_mask_is_taken_as_the_cells_that_it_marks(mask):
    cells = [i for i, is_faulty in enumerate(mask) if is_faulty]
    n = len(mask)
    for form in (mask, np.array(mask), tuple(mask)):
        assert FaultSet.of(form, n) == FaultSet(form, n) == FaultSet(cells, n)
    if cells:
        assert Fault("open", np.array(mask)).cells == tuple(cells)
    with pytest.raises(ValueError, match=f"mask of {n} cells, expected {n + 1}"):
        FaultSet.of(mask, n + 1)
