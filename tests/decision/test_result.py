import base64
import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest

from adaptfault.pages.html_diagnosis import write_diagnosis
from diagnostics import Diagnosis, Fault, FaultKind, Line, SensorLayout, TransportFault, Verdict

LAYOUT = SensorLayout(2, 4, 5)
ROW = Fault(
    "open",
    LAYOUT.cells_on(Line(0, "row", 1)),
    line=Line(0, "row", 1),
    alternatives=("its address",),
)
CELL = Fault(
    "short", (30,), value=5.0, onset=12, probability=0.97, reason="cell 30 is short", evidence=4
)
LOST = TransportFault("lost", 5, 3, "3 frames were lost")


def diagnosed(*faults: Fault, layout: SensorLayout = LAYOUT, **more: object) -> Diagnosis:
    tested = np.arange(40) % 7 != 0
    return Diagnosis(
        layout, faults, np.full(40, 0.01), tested, n_frames=100, n_recordings=2, **more
    )


def test_the_map_wraps_wide_pads_and_its_legend_explains_the_letters():
    layout = SensorLayout(5, 1, 12)
    short = Fault("short", tuple(range(12, 24)))
    figure = Diagnosis(
        layout, (short,), np.zeros(60), np.ones(60, bool), n_frames=9, n_recordings=1
    ).plot()
    assert figure.get_figwidth() <= 10
    assert [ax.get_title() for ax in figure.axes if ax.get_visible()] == [
        f"pad {pad}" for pad in range(5)
    ]
    assert [text.get_text() for text in figure.axes[1].texts] == ["S"] * 12
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "alive",
        "faulty: S short",
        "untested",
    ]


@pytest.mark.parametrize(
    "shape",
    [
        (1, 10, 10),
        (2, 13, 6),
        (5, 1, 12),
        (1, 2, 3),
        (2, 33, 15),
        (1, 64, 64),
        (1, 40, 4),
        (2, 4, 5),
    ],
)
def test_nothing_on_the_map_is_cut_off_or_covered(shape):
    layout = SensorLayout(*shape)
    cells = layout.n_cells
    short = Fault("short", (1,))
    figure = Diagnosis(
        layout, (short,), np.zeros(cells), np.ones(cells, bool), n_frames=9, n_recordings=1
    ).plot()
    figure.draw_without_rendering()
    legend = figure.legends[0].get_window_extent()
    for box in [legend, *(ax.get_tightbbox() for ax in figure.axes if ax.get_visible())]:
        assert box.x0 >= -1
        assert box.y0 >= -1
        assert box.x1 <= figure.bbox.x1 + 1
        assert box.y1 <= figure.bbox.y1 + 1
        assert box is legend or box.y0 >= legend.y1 - 1


def test_a_page_without_a_fault_says_how_many_cells_were_not_tested(tmp_path):
    page = write_diagnosis(
        tmp_path / "page.html", diagnosed(), name="log", reference=True
    ).read_text()
    assert (
        "No faulty cell was found. 6 cells were not tested: a fault there would not be found."
        in page
    )
    assert "<b>85%</b><span>of the cells tested; 6 cells were not</span>" in page


@pytest.mark.parametrize(
    ("faults", "code", "note", "headline"),
    [
        ((ROW,), 1, "handled: version 2 runs", "Watch: the running version handles the faults"),
        ((), 1, "the sensor changed", "No fault found, but see the reason"),
        ((), 2, "rows 1 and 2 are exchanged", "Call a technician"),
        ((CELL,), None, "", "Watch: single cells are faulty"),
    ],
)
def test_the_page_says_what_the_exit_code_and_the_notes_say(tmp_path, faults, code, note, headline):
    notes = [note] if note else []
    page = write_diagnosis(
        tmp_path / "page.html",
        diagnosed(*faults),
        name="log",
        reference=True,
        code=code,
        notes=notes,
    ).read_text()
    assert f">{headline}</h1>" in page
    assert note[1:] in page.split("<h2>")[0]


def test_on_a_narrow_screen_the_pads_of_a_page_are_below_each_other(tmp_path):
    def sizes(pads: int) -> list[tuple[int, int]]:
        layout = SensorLayout(pads, 30, 12)
        cells = pads * 360
        of = Diagnosis(
            layout, (), np.zeros(cells), np.ones(cells, bool), n_frames=9, n_recordings=1
        )
        page = write_diagnosis(tmp_path / "page.html", of, name="log", reference=True).read_text()
        pictures = re.findall(
            r'(?:<source media="\(max-width: 40rem\)" srcset|<img class="" src)="data:.*?,(.*?)"',
            page,
        )
        # in the head of a PNG
        return [struct.unpack(">II", base64.b64decode(picture)[16:24]) for picture in pictures]

    (narrow, high), (wide, low) = sizes(2)
    assert narrow < 0.6 * wide
    assert high > 1.8 * low
    assert len(sizes(1)) == 1


def test_the_fault_set_holds_the_cells_of_all_faults():
    assert diagnosed(ROW, CELL).fault_set == {5, 6, 7, 8, 9, 30}
    assert len(diagnosed().fault_set) == 0


def test_suspects_are_f_and_the_tested_cells_that_are_likely_enough():
    diagnosis = diagnosed(CELL)
    diagnosis.probability[[1, 2, 7]] = 0.1, 0.03, 0.9  # 7 was not tested
    assert diagnosis.suspects() == {1, 2, 30}
    assert diagnosis.suspects(0.05) == {1, 30}
    assert diagnosis.suspects(1.0) == diagnosis.fault_set


def test_the_table_has_a_row_for_each_cell_that_exists():
    table = diagnosed(ROW, CELL).to_dataframe()
    assert table["cell"].tolist() == list(range(40))
    assert table.loc[30].to_dict() == {
        "cell": 30,
        "pad": 1,
        "row": 2,
        "column": 0,
        "verdict": "FAULTY",
        "probability": 0.01,
        "kind": "short",
        "line": "",
    }
    assert table.groupby("line")["cell"].count()["pad 0, row 1"] == 5
    present = np.ones(LAYOUT.shape, bool)
    present[0, 0, 1] = False
    masked = diagnosed(layout=SensorLayout(2, 4, 5, present=present)).to_dataframe()
    assert 1 not in set(masked["cell"])
    axes = SensorLayout(2, 2, 5, axes=2)
    assert diagnosed(layout=axes).to_dataframe()["axis"].tolist()[:3] == [0, 1, 0]


def test_the_share_of_false_cells_is_a_bound_by_the_probabilities_of_the_causes():
    assert diagnosed().false_share == 0
    assert diagnosed(Fault("open", (3,))).false_share == 0  # known, not inferred
    cells = [Fault("open", (c,), probability=0.9) for c in range(20)]
    drawn = np.random.default_rng(0).binomial(20, 0.1, 100_000) / 20
    assert diagnosed(*cells).false_share == np.quantile(drawn, 0.95)
    wire = replace(ROW, probability=0.9)  # all of its cells are wrong together
    assert diagnosed(wire, CELL).false_share == 5 / 6


def test_each_cell_is_alive_faulty_or_untested():
    diagnosis = diagnosed(ROW, CELL)
    assert np.flatnonzero(diagnosis.verdicts == Verdict.FAULTY).tolist() == [5, 6, 7, 8, 9, 30]
    assert np.flatnonzero(diagnosis.verdicts == Verdict.UNTESTED).tolist() == [0, 14, 21, 28, 35]
    assert (diagnosis.verdicts == Verdict.ALIVE).sum() == 29
    assert isinstance(diagnosis.verdicts[0], Verdict)


def test_a_position_without_a_cell_is_untested():
    present = np.ones(LAYOUT.shape, bool)
    present[0, 0, 1] = False
    diagnosis = diagnosed(layout=SensorLayout(2, 4, 5, present=present))
    assert diagnosis.verdicts[1] is Verdict.UNTESTED
    assert 1 not in diagnosis.coverage.untested


def test_the_exit_code_distinguishes_no_fault_single_cells_and_faults_of_wires():
    assert diagnosed().exit_code == 0
    assert diagnosed(transport=(LOST,)).exit_code == 0
    assert diagnosed(transport=(LOST, TransportFault("frozen", 50, 40, "it froze"))).exit_code == 1
    assert diagnosed(CELL).exit_code == 1
    assert diagnosed(CELL, ROW).exit_code == 2
    assert diagnosed(*(Fault("open", (c,)) for c in range(4))).exit_code == 2


@pytest.mark.parametrize("faults", [(), (ROW,), (CELL, ROW)])
def test_a_diagnosis_survives_json_with_transport_faults_and_alternatives(faults):
    diagnosis = diagnosed(
        *faults, transport=(LOST, TransportFault("frozen", 50, 40, "it froze")), possible=(ROW,)
    )
    d = json.loads(json.dumps(diagnosis.to_dict(), allow_nan=False))
    again = Diagnosis.from_dict(d)
    assert again.faults == faults
    assert again.transport == diagnosis.transport
    assert again.possible == (ROW,)
    assert again.layout == LAYOUT
    assert (again.n_frames, again.n_recordings) == (100, 2)
    assert (again.verdicts == diagnosis.verdicts).all()
    np.testing.assert_array_equal(again.probability, diagnosis.probability)
    assert again.to_dict() == d


def test_another_version_is_refused():
    with pytest.raises(ValueError, match="expected a diagnosis with schema"):
        Diagnosis.from_dict({**diagnosed().to_dict(), "schema": "adaptfault.diagnosis/99"})


def test_it_prints_the_map_and_every_reason():
    text = str(diagnosed(CELL, transport=(LOST,)))
    assert "1 faulty cell in 2 recordings (100 frames)" in text
    assert "cell 30 is short" in text
    assert "3 frames were lost" in text
    assert diagnosed(CELL).map() in text


def test_the_map_has_a_letter_for_every_kind_of_fault():
    letters = {diagnosed(Fault(kind, (1,))).map().splitlines()[1].split()[2] for kind in FaultKind}
    assert len(letters) == len(FaultKind)
    assert not letters & {".", "?"}


def test_the_axes_of_the_map_are_named_and_the_page_says_from_where_they_count(tmp_path):
    of = diagnosed(ROW)
    names = {(ax.get_xlabel(), ax.get_ylabel()) for ax in of.plot().axes if ax.get_visible()}
    assert names == {("column", "row")}
    page = write_diagnosis(tmp_path / "page.html", of, name="log", reference=True).read_text()
    assert page.count("Pads, rows and columns count from 0.") == 1
    bus = SensorLayout(2, 4, 5, wiring="bus")
    assert {ax.get_xlabel() for ax in diagnosed(layout=bus).plot().axes} == {""}
