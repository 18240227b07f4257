"""Positions are counted from 0, or as a technician counts them."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.pages.html_diagnosis import write_diagnosis
from diagnostics import Diagnosis, Fault, Line, SensorLayout
from diagnostics.decision.coverage import where
from diagnostics.decision.numbering import Numbering

MATRIX = SensorLayout(2, 11, 10)
BUS = SensorLayout(3, 4, 4, wiring="bus")
AXES = SensorLayout(2, 3, 4, axes=3)
GROUPS = SensorLayout(1, 1, 20, groups={"row 3": list(range(10)), "row": list(range(10, 20))})


@given(st.sampled_from([MATRIX, BUS, AXES]), st.data())
def test_every_number_of_a_place_rises_by_one(layout, data):
    place = layout.place(data.draw(st.integers(0, layout.n_cells - 1)))
    counted = Numbering.from_layout(layout, 1).text(f"check {place}; its load is 3 N")
    from_0 = [int(number) for number in re.findall(r"\d+", place)]
    from_1 = [int(number) for number in re.findall(r"\d+", counted)]
    assert from_1 == [*(number + 1 for number in from_0), 3]
    assert re.sub(r"\d", "", counted) == re.sub(r"\d", "", f"check {place}; its load is 3 N")


@given(st.sets(st.integers(0, 109), min_size=1))
def test_the_region_around_cells_is_counted_from_1_at_both_ends(cells):
    region = where(np.array(sorted(cells)), MATRIX)
    counted = Numbering.from_layout(MATRIX, 1).text(region)
    ends = [int(number) for number in re.findall(r"\d+", region)]
    assert [int(number) - 1 for number in re.findall(r"\d+", counted)] == ends


@pytest.mark.parametrize(
    ("from_0", "from_1"),
    [
        ("rows 3 and 4 of pad 0 are exchanged", "rows 4 and 5 of pad 1 are exchanged"),
        ("Pads 0, 2 read otherwise", "Pads 1, 3 read otherwise"),
        ("row 1 reads row 3, column 0 nothing", "row 2 reads row 4, column 1 nothing"),
        ("pad 0, row address bit 0 is stuck at 1", "pad 1, row address bit 0 is stuck at 1"),
        ("each of 5 cells reads 0 V from frame 7 on", "each of 5 cells reads 0 V from frame 7 on"),
        ("2 x 3 x 4 cells, 0..5 N", "2 x 3 x 4 cells, 0..5 N"),
        ("handled: version 2 of data/pad 1/row 0.bundle", None),
    ],
)
def test_wires_are_counted_and_nothing_else(from_0, from_1):
    assert Numbering(1).text(from_0) == (from_1 or from_0)
    assert Numbering(0).text(from_0) == from_0


def test_the_name_of_a_group_keeps_its_number():
    assert Numbering.from_layout(GROUPS, 1).text(GROUPS.place(3)) == "row 3, cell 4"


def test_the_diagnosis_counts_alike_in_map_causes_figure_and_page(tmp_path):
    row = Line(1, "row", 10)
    cells = tuple(MATRIX.cells_on(row).tolist())
    reason = "pad 1, row 10 is open: each of 10 cells on it reads 0 N; check the row wire"
    fault = Fault("open", cells, line=row, probability=0.99, reason=reason)
    faulty = np.isin(np.arange(MATRIX.n_cells), cells)
    diagnosis = Diagnosis(MATRIX, (fault,), faulty * 0.99, faulty, 60, 2)
    text = diagnosis.text(1)
    assert "pad 2, row 11 is open: each of 10 cells on it reads 0 N" in text
    assert "pad 1                 pad 2" in text
    assert text.splitlines()[12].startswith("  11 ")
    assert diagnosis.text() == str(diagnosis)
    assert "pad 1, row 10 is open" in diagnosis.to_dict()["faults"][0]["reason"]
    axes = diagnosis.plot(count_from=1).axes
    assert [ax.get_title() for ax in axes] == ["pad 1", "pad 2"]
    assert axes[0].get_xticklabels()[0].get_text() == "1"
    path = tmp_path / "page.html"
    write_diagnosis(path, diagnosis, name="row 0", reference=True, count_from=1)
    page = path.read_text()
    assert "pad 2, row 11 is open" in page
    assert "press pad 1, rows 1-11, columns 1-10" in page
    assert "Pads, rows and columns count from 1." in page
    assert "<title>Call a technician: row 0</title>" in page
