"""Single faults in a named group are told as the group."""

from adaptfault.pages.html_diagnosis import write_diagnosis
from diagnostics import Diagnosis, Fault, FaultKind, Line, SensorLayout
from diagnostics.decision.grouped_faults import by_group

SKIN = SensorLayout(
    1,
    2,
    10,
    groups={"triangle 0": list(range(10)), "triangle 1": list(range(10, 20))},
    unit="count",
)


def stuck(cell: int, value: float, probability: float = 0.99) -> Fault:
    return Fault("stuck", (cell,), value=value, probability=probability, reason=f"cell {cell}")


def test_several_cells_of_one_kind_in_a_group_are_one_sentence_with_what_each_reads():
    faults = [stuck(3, 40.0), stuck(5, 41.0, 0.9), Fault("noisy", (4,)), stuck(12, 7.0)]
    together, *others = by_group(faults, SKIN)
    assert together.reason == (
        "triangle 0: 2 of its 10 cells are stuck (cell 3: 40 count, cell 5: 41 count);"
        " check the solder joints and the supply of triangle 0"
    )
    assert (together.kind, together.cells, together.probability) == (FaultKind.STUCK, (3, 5), 0.9)
    assert others == [faults[2], faults[3]]


def test_wires_and_cells_without_a_group_stay_as_they_are():
    whole = Fault("open", tuple(range(10)), line=SKIN.lines[0])
    assert by_group([whole, stuck(12, 7.0)], SKIN) == [whole, stuck(12, 7.0)]
    matrix = SensorLayout(1, 2, 10)
    faults = [stuck(3, 4.0), stuck(4, 4.0), Fault("open", (10, 11), line=Line(0, "row", 1))]
    assert by_group(faults, matrix) == faults


def test_cells_that_drift_in_a_group_drift():
    (fault,) = by_group([Fault("drift", (1,)), Fault("drift", (2,))], SKIN)
    assert fault.reason.startswith("triangle 0: 2 of its 10 cells drift (cell 1, cell 2)")


def test_the_page_tells_the_group_once(tmp_path):
    faults = (stuck(3, 40.0), stuck(5, 41.0))
    diagnosis = Diagnosis(
        SKIN, faults, SKIN.present.ravel() * 0.01, SKIN.present.ravel(), n_frames=9, n_recordings=1
    )
    page = write_diagnosis(tmp_path / "page.html", diagnosis, name="log", reference=True)
    assert page.read_text().count("<li>") == 1
    assert "2 of its 10 cells are stuck" in page.read_text()
    assert "Pads and cells count from 0." in page.read_text()
